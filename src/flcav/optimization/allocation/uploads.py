"""Division of stage I's samples over the vehicles, by what they hold or what their uplinks carry; measured uplinks."""

from collections.abc import Mapping
from dataclasses import dataclass

from flcav.config import parse_config
from flcav.network.radio.measured import Throughput
from flcav.optimization.allocation.allocate import TaskAllocation
from flcav.optimization.allocation.vehicles import split_plan
from flcav.optimization.curves.curves import Additive
from flcav.optimization.problem import AllocationTask, Budgets, Limits, Problem, Uplink

LEAST_MBPS = 1e-3  # rate of a vehicle that is never in coverage: it uploads last


def measure_links(problem: Problem, measured: Throughput) -> Problem:
    """Return the problem with the uplinks of its vehicles as measured: the mean of each rate over time.

    Vehicles that a task does not name are all of the measured ones, in their order. Wirelines that were not measured
    stay. Raises `InputError` where a vehicle was not measured, or their number is not that of the edge groups.
    """
    tasks = []
    for task in problem.tasks:
        links = {}
        for name in task.vehicles or tuple(measured.rates["wireless"]):
            before = None if task.uplink_mbps is None else task.uplink_mbps[name].wireline
            known = {name, name.rpartition("/")[2]} & {*measured.rates["wireline"]}
            wired = max(measured.mean_mbps(name, "wireline"), LEAST_MBPS) if known else before
            links[name] = Uplink(wireless=max(measured.mean_mbps(name), LEAST_MBPS), wireline=wired)
        tasks.append({**task.model_dump(), "uplink_mbps": {name: each.model_dump() for name, each in links.items()}})
    return parse_config(Problem, {**problem.model_dump(), "tasks": tasks}, measured.path)


@dataclass(frozen=True)
class UploadDemand:
    """The samples of stage I of a task, and how many each vehicle holds."""

    samples: int
    sample_mb: float  # size of a sample
    held: Mapping[str, int]  # by vehicle


def share_by_held(asked: UploadDemand) -> dict[str, int]:
    """Return the vehicles' numbers of samples, in proportion to what they hold, by the method of largest remainders.

    Ties go to the vehicle that is named first.
    """
    total = sum(asked.held.values())
    shares = {name: asked.samples * count // total for name, count in asked.held.items()}
    rest = sorted(shares, key=lambda name: -(asked.samples * asked.held[name] % total))
    for name in rest[: asked.samples - sum(shares.values())]:
        shares[name] += 1
    return shares


def share_by_links(tasks: Mapping[str, UploadDemand], mbps: Mapping[str, float]) -> dict[str, dict[str, int]]:
    """Return the vehicles' numbers of samples, by task, with which the last sample arrives earliest: see `split_plan`.

    `mbps` is the wireless uplink rate of every vehicle [Mbit/s]. A vehicle sends the samples of all tasks one after
    another.
    """
    units, plans = [], []
    for name, demand in tasks.items():
        links = {vehicle: Uplink(wireless=max(mbps[vehicle], LEAST_MBPS)) for vehicle in demand.held}
        limits = Limits(samples=(demand.samples, demand.samples), edge_rounds=(0, 0), cloud_rounds=(0, 0))
        units.append(
            AllocationTask(
                name=name,
                sample_mb=demand.sample_mb,
                model_mb=1.0,  # no round is planned, so that any size will do
                edge_groups=(len(demand.held),),
                uplink_mbps=links,
                samples_held=demand.held,
                limits=limits,
                curve=Additive(),
            )
        )
        plans.append(TaskAllocation(name, demand.samples, 0, 0, 0.0, 0.0, 0.0))
    shares = split_plan(Problem(budgets_mb=Budgets(wireless=1.0, wireline=1.0), tasks=tuple(units)), plans)
    return {name: {share.vehicle: share.samples for share in task_shares} for name, task_shares in shares.items()}

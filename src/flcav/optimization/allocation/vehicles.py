"""Split of a plan over the vehicles of a fleet: a lexicographic mixed-integer program under every vehicle's time.

A plan gives the number of samples and rounds of each task for the whole fleet. The split has integers x (samples) and y
(rounds) for every task and vehicle, with

- sum(x) = the planned samples of the task, and x at most the samples that the vehicle holds;
- at least one vehicle of each edge group in every round;
- within the horizon, every vehicle's training in its rounds and all its uplink messages, one after another, over all
  tasks; on its edge server's wireline all samples sent on its behalf.

The objectives, in this order: most rounds joined (a straggler drops out of rounds only where its time is too short for
them); samples of most worth; both weighted by data quality; then the earliest end of stage I, when all samples have
arrived. For IID data all samples have the same worth, and throughput decides. Each objective is a program for HiGHS,
solved to optimality for small fleets; for large ones the search ends after `NODES` nodes rather than after a time, so
that the result does not depend on the machine's speed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array, csr_array

from flcav.geometry.arrays import Array
from flcav.interface.wording import plural
from flcav.optimization.allocation.allocate import TaskAllocation
from flcav.optimization.problem import BITS_PER_BYTE, AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible

TIE = 1e-7  # relative: how much an earlier objective may lose to a later one, against rounding
GAP = 1e-6  # relative optimality gap for rounds and samples
END_GAP = 1e-4  # relative optimality gap for times
NODES = 100  # most nodes of a branch-and-bound search


class TooSlow(Infeasible):
    """The vehicles cannot send, and train, what the plan asks for within the horizon."""


@dataclass(frozen=True)
class VehicleShare:
    """A vehicle's share of a task's plan: samples to upload, rounds to join, their size, and the time they take."""

    vehicle: str
    samples: int  # uploaded in stage I
    rounds: tuple[int, ...]  # joined, of 1 ... edge_rounds + k * cloud_rounds, in the order of the run
    wireless_mb: float  # uplink
    busy_s: float  # time to send them on the vehicle's link, as far as that is known, and to train in the rounds


Shares = dict[str, tuple[VehicleShare, ...]]  # by task


@dataclass(frozen=True)
class _TaskOnVehicle:
    """A task on a vehicle: two consecutive variables of the program, samples and rounds."""

    task: AllocationTask
    group: int  # index of its edge group
    vehicle: str
    wireline: float | None  # rate [Mbit/s]; None: not limited
    sample_s: float  # time to send a sample
    round_s: float  # time to train in a round and to send the update
    held: int  # most samples
    rounds: int  # most rounds
    quality: float


def trains(problem: Problem) -> bool:
    """Return whether the time to train is known for a vehicle of any task, so that a horizon limits it."""
    return any(task.train_s > 0 or any(task.vehicle_train_s.values()) for task in problem.tasks)


def split_plan(problem: Problem, plans: Sequence[TaskAllocation]) -> Shares:
    """Return the split of `plans` (one per task, in their order) over the vehicles: by task, a share per vehicle.

    Tasks without named vehicles are left out. Raises `Infeasible` where the vehicles hold too few samples, and
    `TooSlow` where they need longer than `horizon_s`.
    """
    planned = [(task, plan) for task, plan in zip(problem.tasks, plans, strict=True) if task.vehicles]
    if not planned:
        return {}
    for task, plan in planned:
        held = sum(_held(task, plan, vehicle) for vehicle in task.vehicles)
        if held < plan.samples:
            raise Infeasible(
                f"task {task.name!r}: its vehicles hold {plural(held, 'sample')} (samples_held), and the plan uploads "
                f"{plan.samples}"
            )
    parts = [part for task, plan in planned for part in _parts(problem, task, plan)]
    subject = "the vehicles" if trains(problem) else "the vehicles' own links"
    counts = _split(parts, [plan for _, plan in planned], problem.horizon_s, subject)
    shares: Shares = {}
    for task, plan in planned:
        labelled_mb = (plan.edge_rounds + (plan.cloud_rounds > 0)) * (task.labels_mb or 0.0)
        rows = [(part, row) for part, row in zip(parts, counts) if part.task is task]
        joined = _rounds([part.group for part, _ in rows], [int(row[1]) for _, row in rows], rows[0][0].rounds)
        shares[task.name] = tuple(
            VehicleShare(
                *(part.vehicle, int(row[0]), rounds),
                wireless_mb=float(
                    row[0] * task.sample_mb + len(rounds) * (task.exchange_mb or task.model_mb) + labelled_mb
                ),
                busy_s=float(row[0] * part.sample_s + len(rounds) * part.round_s),
            )
            for (part, row), rounds in zip(rows, joined)
        )
    return shares


def sum_busy(shares: Shares) -> dict[str, float]:
    """Return the time [s] that every vehicle needs for its shares of all tasks."""
    busy: dict[str, float] = {}
    for share in chain.from_iterable(shares.values()):
        busy[share.vehicle] = busy.get(share.vehicle, 0.0) + share.busy_s
    return busy


def _held(task: AllocationTask, plan: TaskAllocation, vehicle: str) -> int:
    return min(task.samples_held.get(vehicle, plan.samples), plan.samples)


def _parts(problem: Problem, task: AllocationTask, plan: TaskAllocation) -> list[_TaskOnVehicle]:
    groups = np.repeat(np.arange(len(task.edge_groups)), task.edge_groups)
    rounds = plan.edge_rounds + problem.edge_rounds_per_cloud_round * plan.cloud_rounds
    return [
        _TaskOnVehicle(
            *(task, int(group), name, None if task.uplink_mbps is None else task.uplink_mbps[name].wireline),
            *(task.sample_s(name), task.round_s(name)),
            *(_held(task, plan, name), rounds, float(task.data_quality.get(name, 1.0))),
        )
        for group, name in zip(groups, task.vehicles, strict=True)
    ]


def _split(
    parts: Sequence[_TaskOnVehicle], plans: Sequence[TaskAllocation], horizon_s: float | None, subject: str
) -> Array:
    """Return the samples and rounds (P, 2) of all parts; raises `TooSlow` of `subject` where none fits the horizon."""
    size = 2 * len(parts) + 1  # the last variable is a time [s]: the end of stage I, or of the plan
    needs, least = _needs(parts, plans)
    joined_by_all = LinearConstraint(needs, least[:, 0], least[:, 1])  # pyright: ignore[reportArgumentType]
    high = np.array([count for part in parts for count in (part.held, part.rounds)] + [np.inf])
    end = np.r_[np.zeros(size - 1), 1.0]
    busy = LinearConstraint(_busy(parts, with_rounds=True), ub=np.inf if horizon_s is None else horizon_s)
    stage_one = LinearConstraint(_busy(parts, with_rounds=False, less_last=True), ub=0.0)  # pyright: ignore[reportArgumentType]
    quality = np.array([part.quality for part in parts])
    joined = np.zeros(size)
    worth = np.zeros(size)
    joined[1:-1:2], worth[0:-1:2] = -quality, -quality
    fixed = [joined_by_all, busy, stage_one]
    # Lexicographic: every optimum, less a tolerance, becomes a constraint of the programs that follow.
    found = None
    for aim, gap in ((joined, GAP), (worth, GAP), (end, END_GAP)):
        better = _least(aim, fixed, high, gap)
        if better is None and found is not None:
            break  # no better split among the nodes that were searched
        found = better
        if found is None:
            until = LinearConstraint(_busy(parts, with_rounds=True, less_last=True), ub=0.0)  # pyright: ignore[reportArgumentType]
            raise _too_slow(_least(end, [joined_by_all, until], high, END_GAP), horizon_s, subject)
        value = float(aim @ found)
        fixed.append(LinearConstraint(csr_array(aim[None]), ub=value + TIE * max(abs(value), 1.0)))  # pyright: ignore[reportArgumentType]
    assert found is not None
    return np.round(found[:-1]).reshape(-1, 2)


def _needs(parts: Sequence[_TaskOnVehicle], plans: Sequence[TaskAllocation]) -> tuple[csr_array, Array]:
    """Return constraint rows and their bounds (rows, 2) for the samples of each task and the rounds of each group.

    All planned samples are uploaded; the vehicles of a group together join at least as many rounds as the task has.
    """
    wanted = {plan.name: plan.samples for plan in plans}
    names: dict[tuple[str, int], int] = {}
    rows, columns, bounds = [], [], []
    for number, part in enumerate(parts):
        for row_of, column, bound in (
            ((part.task.name, -1), 2 * number, (wanted[part.task.name],) * 2),
            ((part.task.name, part.group), 2 * number + 1, (part.rounds, np.inf)),
        ):
            if row_of not in names:
                names[row_of] = len(names)
                bounds.append(bound)
            rows.append(names[row_of])
            columns.append(column)
    shape = (len(names), 2 * len(parts) + 1)
    return csr_array(coo_array((np.ones(len(rows)), (rows, columns)), shape=shape)), np.array(bounds, dtype=np.float64)


def _busy(parts: Sequence[_TaskOnVehicle], *, with_rounds: bool, less_last: bool = False) -> csr_array:
    """Return the time of vehicles and their wirelines [s], one row each; with `less_last`, minus the last variable."""
    lines: dict[tuple[str, str], Array] = {}
    for number, part in enumerate(parts):
        times = {"own": (part.sample_s, part.round_s)}
        if part.wireline is not None:
            times["wireline"] = (BITS_PER_BYTE * part.task.sample_mb / part.wireline, 0.0)
        for whose, (sample_s, round_s) in times.items():
            line = lines.setdefault((part.vehicle, whose), np.r_[np.zeros(2 * len(parts)), -float(less_last)])
            line[2 * number : 2 * number + 2] = sample_s, round_s * with_rounds
    return csr_array(np.stack(list(lines.values())))


def _least(aim: Array, constraints: Sequence[LinearConstraint], high: Array, gap: float) -> Array | None:
    """Return the variables that minimise `aim`, None where none satisfy the constraints or none were found."""
    whole = np.r_[np.ones(len(high) - 1), 0.0]
    result = milp(
        aim,
        integrality=whole,
        bounds=Bounds(0.0, high),  # pyright: ignore[reportArgumentType]
        constraints=constraints,
        options={"mip_rel_gap": gap, "node_limit": NODES},
    )
    return result.x


def _too_slow(soonest: Array | None, horizon_s: float | None, subject: str) -> TooSlow:
    assert soonest is not None
    assert horizon_s is not None
    return TooSlow(
        f"{subject} need {soonest[-1]:.6g} s for the plan even if stragglers leave out rounds, "
        f"{soonest[-1] - horizon_s:.6g} s more than horizon_s = {horizon_s:g}"
    )


def _rounds(groups: Sequence[int], counts: Sequence[int], rounds: int) -> list[tuple[int, ...]]:
    """Return the rounds that each vehicle joins, round robin: a vehicle starts where its predecessor in a group ended.

    `counts` are the vehicles' numbers of rounds. In this way every round of a group is joined, and the numbers of
    vehicles in its rounds differ by at most one.
    """
    ends = np.cumsum(counts, dtype=np.int64) - np.array(
        [sum(c for c, h in zip(counts, groups) if h < g) for g in groups]
    )
    return [
        tuple(sorted((start + i) % rounds + 1 for i in range(count)))
        for count, start in zip(counts, (int(end) - count for end, count in zip(ends, counts)))
    ]

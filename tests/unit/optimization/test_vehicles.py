from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import pytest

from flcav.config import parse_config
from flcav.optimization.allocation.allocate import TaskAllocation
from flcav.optimization.allocation.vehicles import VehicleShare, split_plan
from flcav.optimization.problem import AllocationTask, Problem
from flcav.optimization.solvers.instance import Infeasible


def problem(tasks: list[dict[str, Any]], horizon_s: float | None = None, k: int = 1) -> Problem:
    filled = [
        {
            "name": "objects",
            "sample_mb": 2.0,
            "model_mb": 5.0,
            "edge_groups": [2, 1],
            "limits": {"samples": [1, 100], "edge_rounds": [0, 9], "cloud_rounds": [0, 9]},
            "curve": {"model": "additive", "pretrain": {"a": 1.0, "b": 0.5}},
            **task,
        }
        for task in tasks
    ]
    values = {
        "budgets_mb": {"wireless": 1e4, "wireline": 1e4},
        "edge_rounds_per_cloud_round": k,
        "horizon_s": horizon_s,
        "tasks": filled,
    }
    return parse_config(Problem, values, "test")


def plan(samples: int, edge_rounds: int = 0, cloud_rounds: int = 0, name: str = "objects") -> TaskAllocation:
    return TaskAllocation(name, samples, edge_rounds, cloud_rounds, 0.1, 0.0, 0.0)


def links(*mbps: float) -> dict[str, dict[str, float]]:
    return {f"cav{i}": {"wireless": each} for i, each in enumerate(mbps)}


def busy_s(asked: Problem, shares: dict[str, tuple[VehicleShare, ...]], with_rounds: bool = True) -> dict[str, float]:
    """Return how long each vehicle's wireless link is busy with samples, and with rounds."""
    spent: dict[str, float] = {}
    for task in asked.tasks:
        for share in shares[task.name]:
            mbps = (task.uplink_mbps or {})[share.vehicle].wireless
            sent = share.wireless_mb if with_rounds else share.samples * task.sample_mb
            trained = len(share.rounds) * train_s(task, share.vehicle) if with_rounds else 0.0
            spent[share.vehicle] = spent.get(share.vehicle, 0.0) + 8 * sent / mbps + trained
    return spent


def train_s(task: AllocationTask, vehicle: str) -> float:
    return task.vehicle_train_s.get(vehicle, task.train_s)


def values(asked: Problem, shares: dict[str, tuple[VehicleShare, ...]]) -> tuple[float, float, float]:
    """Return the three aims of a split: rounds joined, worth of samples (both by quality), minus the end of stage I."""
    joined = worth = 0.0
    for task in asked.tasks:
        for share in shares[task.name]:
            quality = task.data_quality.get(share.vehicle, 1.0)
            joined += quality * len(share.rounds)
            worth += quality * share.samples
    return joined, worth, -max(busy_s(asked, shares, with_rounds=False).values())


def every_split(asked: Problem, plans: list[TaskAllocation]) -> Iterator[tuple[float, float, float]]:
    """Yield the aims of every split that is allowed, by trying all numbers."""

    def own(task: AllocationTask, each: TaskAllocation) -> list[list[tuple[int, int]]]:
        names = list(task.uplink_mbps or {})
        rounds = each.edge_rounds + asked.edge_rounds_per_cloud_round * each.cloud_rounds
        groups = np.repeat(np.arange(len(task.edge_groups)), task.edge_groups)
        held = [task.samples_held.get(name, each.samples) for name in names]
        splits = []
        for samples in product(*(range(min(most, each.samples) + 1) for most in held)):
            if sum(samples) != each.samples:
                continue
            for joined in product(range(rounds + 1), repeat=len(names)):
                if all(sum(np.array(joined)[groups == g]) >= rounds for g in set(groups)):
                    splits.append(list(zip(samples, joined)))
        return splits

    for choice in product(*(own(task, each) for task, each in zip(asked.tasks, plans))):
        joined = worth = 0.0
        busy: dict[str, float] = {}
        uploading: dict[str, float] = {}
        for task, parts in zip(asked.tasks, choice):
            for (name, link), (samples, rounds) in zip((task.uplink_mbps or {}).items(), parts):
                quality = task.data_quality.get(name, 1.0)
                joined, worth = joined + quality * rounds, worth + quality * samples
                sent = samples * task.sample_mb + rounds * task.model_mb
                trained = rounds * train_s(task, name)
                busy[name] = busy.get(name, 0.0) + 8 * sent / link.wireless + trained
                uploading[name] = uploading.get(name, 0.0) + 8 * samples * task.sample_mb / link.wireless
        if max(busy.values()) <= (asked.horizon_s or np.inf) * (1 + 1e-9):
            yield joined, worth, -max(uploading.values())


@pytest.mark.parametrize("seed", range(20))
def test_no_split_is_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mbps = rng.uniform(1, 8, 3)
    tasks, plans = [], []
    for name in ("objects", "signs")[: 1 + seed % 2]:
        tasks.append(
            {
                "name": name,
                "sample_mb": float(rng.uniform(0.5, 3)),
                "model_mb": float(rng.uniform(1, 4)),
                "uplink_mbps": links(*mbps),
                "samples_held": {"cav0": int(rng.integers(1, 4))},
                "data_quality": {"cav1": float(rng.uniform(0.3, 1))} if seed % 3 else {},
            }
            | ({"train_s": float(rng.uniform(0, 6)), "vehicle_train_s": {"cav2": 3.0}} if seed >= 12 else {})
        )
        plans.append(plan(int(rng.integers(2, 5)), 1, int(rng.integers(0, 2)), name))
    asked = problem(tasks, horizon_s=float(rng.uniform(5, 30)))
    best = max(every_split(asked, plans), default=None)
    if best is None:
        with pytest.raises(Infeasible, match="horizon_s"):
            split_plan(asked, plans)
        return
    shares = split_plan(asked, plans)
    joined, worth, end = values(asked, shares)
    busy = busy_s(asked, shares)
    assert max(busy.values()) <= (asked.horizon_s or 0) * (1 + 1e-6)
    told = {name: sum(s.busy_s for own in shares.values() for s in own if s.vehicle == name) for name in busy}
    assert told == pytest.approx(busy)
    assert (joined, worth) == pytest.approx(best[:2], rel=1e-6)
    assert end == pytest.approx(best[2], rel=2e-4)


def test_without_a_horizon_all_join_and_throughput_alone_decides_who_uploads() -> None:
    asked = problem([{"uplink_mbps": links(10, 20, 40)}])
    shares = split_plan(asked, [plan(70, 2, 1)])["objects"]
    assert [share.rounds for share in shares] == [(1, 2, 3)] * 3
    assert sum(share.samples for share in shares) == 70
    busy = busy_s(asked, {"objects": shares}, with_rounds=False).values()
    assert max(busy) - min(busy) <= 8 * 2.0 / 10  # all are through within one sample of each other


def test_quality_beats_throughput_up_to_what_is_held() -> None:
    quality = {"cav0": 0.5, "cav1": 0.9, "cav2": 0.5}
    task = {"uplink_mbps": links(50, 5, 50), "samples_held": {"cav1": 8}, "data_quality": quality}
    shares = split_plan(problem([task]), [plan(20)])["objects"]
    assert shares[1].samples == 8


def test_a_straggler_leaves_out_rounds_and_every_round_is_still_joined() -> None:
    asked = problem([{"edge_groups": [3], "uplink_mbps": links(20, 2, 2)}], horizon_s=100.0, k=2)
    shares = split_plan(asked, [plan(1, 4, 3)])["objects"]
    assert len(shares[0].rounds) == 10
    assert [len(share.rounds) for share in shares[1:]] == [5, 5]  # 200 Mbit each: 5 models of 40 Mbit
    assert {number for share in shares[1:] for number in share.rounds} == set(range(1, 11))
    assert max(busy_s(asked, {"objects": shares}).values()) <= 100


def test_full_participation_costs_what_the_plan_costs() -> None:
    asked = problem([{"uplink_mbps": links(10, 20, 40)}])
    shares = split_plan(asked, [plan(30, 2, 3)])["objects"]
    assert sum(share.wireless_mb for share in shares) == pytest.approx(30 * 2.0 + 5 * 3 * 5.0)


def test_wireline_limits_what_is_passed_on() -> None:
    task = {"edge_groups": [2], "uplink_mbps": {"a": {"wireless": 100, "wireline": 1.6}, "b": {"wireless": 2}}}
    shares = split_plan(problem([task], horizon_s=100.0), [plan(20)])["objects"]
    assert shares[0].samples <= 10  # 160 Mbit of 16 Mbit each


def test_infeasible_is_one_sentence() -> None:
    held = {"uplink_mbps": links(10, 10, 10), "samples_held": {"cav0": 3, "cav1": 4, "cav2": 5}}
    with pytest.raises(Infeasible, match=r"'objects': its vehicles hold 12 samples .* the plan uploads 13"):
        split_plan(problem([held]), [plan(13)])
    slow = problem([{"edge_groups": [1], "uplink_mbps": links(8)}], horizon_s=20)
    with pytest.raises(Infeasible, match=r"need 30 s .* 10 s more than horizon_s = 20"):
        split_plan(slow, [plan(10, 2)])


def test_tasks_without_links_have_no_shares() -> None:
    assert split_plan(problem([{}]), [plan(5)]) == {}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"uplink_mbps": links(1, 2)}, "names 2 vehicles, edge_groups have 3"),
        ({"uplink_mbps": links(1, 2, 0)}, "greater than 0"),
        ({"uplink_mbps": links(1, 2, float("nan"))}, "finite"),
        ({"uplink_mbps": links(1, 2, 3), "samples_held": {"tram": 4}}, "names 'tram'"),
        ({"uplink_mbps": links(1, 2, 3), "data_quality": {"cav0": 0}}, "greater than 0"),
        ({"uplink_mbps": links(1, 2, 3), "vehicle_train_s": {"tram": 4}}, "names 'tram', which uplink_mbps does not"),
        ({"vehicle_train_s": {"cav0": 4}}, "vehicle_train_s of task 'objects' names 1 vehicles, edge_groups have 3"),
        ({"train_s": -1}, "greater than or equal to 0"),
    ],
)
def test_bad_vehicles_are_named(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        problem([change])


def test_a_vehicle_has_one_link() -> None:
    tasks = [{"name": "a", "uplink_mbps": links(1, 2, 3)}, {"name": "b", "uplink_mbps": links(1, 2, 4)}]
    with pytest.raises(ValueError, match="'cav2' another link"):
        problem(tasks)

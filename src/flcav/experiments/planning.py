"""The plan: how many samples and rounds both uplink budgets buy, by what earlier runs learned."""

import csv
from dataclasses import asdict
from importlib import resources
from typing import Any

import numpy as np
from flwr.app import ArrayRecord, MetricRecord, RecordDict

from flcav.config import parse_config
from flcav.experiments.protocol import TASK, Protocol
from flcav.experiments.recording import opened
from flcav.experiments.steps import Work
from flcav.federation.records import ARRAYS, METRICS
from flcav.federation.records import to_arrays as to_record
from flcav.federation.runtimes.embedded import wire_bytes
from flcav.files import write_json
from flcav.optimization.allocation import allocate
from flcav.optimization.learning_curve import Fit, fit_additive
from flcav.optimization.problem import Problem
from flcav.perception.objects.model import second_tiny
from flcav.perception.weights import to_arrays

COLUMNS = ("samples", "edge_rounds", "cloud_rounds", "accuracy")
HISTORY = resources.files("flcav.experiments") / "data" / "history.csv"
PROBLEM = "problem.json"
LEAST_SAMPLES = 40


def plan(work: Work, protocol: dict[str, Any]) -> dict[str, Any]:
    """Choose samples, edge rounds and cloud rounds under both budgets; keep the problem beside the answer."""
    return asdict(allocate(run_problem(work, protocol)))


def run_problem(work: Work, protocol: dict[str, Any]) -> Problem:
    """Return the allocation problem of a run, which it also writes, sized by the frames it may upload."""
    setting = Protocol.model_validate(protocol)
    pool = opened(work, "suburb-pool")
    sample_mb = float(np.mean([pool.payload_bytes(i) for i in range(len(pool))])) / 1e6
    problem = problem_for(setting, sample_mb, update_mb(), len(pool), history_fit())
    write_json(work.folder / PROBLEM, problem)
    return parse_config(Problem, problem, "the run's allocation problem")


def fixed_plan(work: Work, samples: int, edge_rounds: int, cloud_rounds: int) -> dict[str, Any]:
    """Return a plan that was chosen by hand, in the form of `plan`: to make history, which plans are fitted to."""
    return {"tasks": [{"samples": samples, "edge_rounds": edge_rounds, "cloud_rounds": cloud_rounds}]}


def problem_for(setting: Protocol, sample_mb: float, model_mb: float, samples: int, fit: Fit) -> dict[str, Any]:
    """Return the allocation problem of a run, as `flcav allocate` reads it."""
    share = 1 - setting.headroom
    edge_rounds, cloud_rounds = setting.max_rounds
    return {
        "budgets_mb": {"wireless": share * setting.wireless_mb, "wireline": share * setting.wireline_mb},
        "edge_rounds_per_cloud_round": setting.edge_rounds_per_cloud_round,
        "tasks": [
            {
                "name": TASK,
                "weight": 1.0,
                "sample_mb": sample_mb,
                "model_mb": model_mb,
                "edge_groups": list(setting.vehicles.values()),
                "limits": {
                    "samples": [min(LEAST_SAMPLES, samples), samples],
                    "edge_rounds": [1, edge_rounds],
                    "cloud_rounds": [1, cloud_rounds],
                },
                "curve": fit.curve.model_dump(),
            }
        ],
    }


def update_mb() -> float:
    """Return the size of one model update on the wire, by a dry run of the message [MB]."""
    metrics = MetricRecord({"num-examples": 0, "loss": 0.0})
    arrays: ArrayRecord = to_record(to_arrays(second_tiny()))
    return wire_bytes(RecordDict({ARRAYS: arrays, METRICS: metrics})) / 1e6


def history_fit() -> Fit:
    """Return the curve fitted to the history of other seeds' runs that the package carries."""
    return fit_additive(*history_table().T)


def history_table() -> np.ndarray:
    """Return that history (n, 4): samples, edge rounds, cloud rounds, accuracy."""
    with HISTORY.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return np.array([[float(row[name]) for name in COLUMNS] for row in rows])

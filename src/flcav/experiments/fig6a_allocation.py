"""Proof by training of MLGRA (Wang et al., IEEE Network 37(3), 2023, Fig. 6a): equal stages against the joint plan.

Both plans have the demo's budgets, the same learning curve, and the same limits, wider than the demo's, so that budgets
and not time bind. In every seed both runs share their recorded frames; each places its own poles, as the errors of its
own pretrained network ask. What the curve predicts after each stage stands beside what training reached.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import parse_config
from flcav.dataset.layout import package_versions
from flcav.experiments.demo_arms import arms_protocol
from flcav.experiments.fig6a_findings import EQUAL, JOINT, TOWN, allocation_findings
from flcav.experiments.pipeline import cloud_step, edge_step, plan_step, shared_steps, test_step
from flcav.experiments.planning import PROBLEM, history_table, run_problem
from flcav.experiments.points import HISTORY_FILE, append_points, points_of
from flcav.experiments.pretraining import LEDGER
from flcav.experiments.protocol import REGIONS, Protocol
from flcav.experiments.steps import Notify, Step, Work, run_side_by_side
from flcav.experiments.testing import difference
from flcav.intervals import mean_over_seeds
from flcav.network.ledger import LINKS, Ledger
from flcav.optimization.baselines import baseline
from flcav.optimization.problem import Problem
from flcav.report import plans, style

PLANS = (EQUAL, JOINT)
STAGES = ("pretrain", "edge", "cloud")
COUNTS = ("samples", "edge_rounds", "cloud_rounds")
MAX_ROUNDS = (12, 8)


def allocation_protocol(seed: int, scale: str) -> Protocol:
    """Return the reproduction's size, as `arms_protocol`, with limits that leave the budgets to decide."""
    return arms_protocol(seed, scale).model_copy(update={"max_rounds": MAX_ROUNDS})


def equal_stages(work: Work, protocol: dict[str, Any]) -> dict[str, Any]:
    """Choose as many samples, edge rounds and cloud rounds as equal shares of each link's budget buy."""
    return asdict(baseline(run_problem(work, protocol), EQUAL))


def plan_steps(protocol: Protocol, name: str) -> list[Step]:
    """Return the steps of one plan's run."""
    planned = plan_step(protocol)
    if name == EQUAL:
        planned = Step("plan", equal_stages, planned.arguments, needs=planned.needs)
    steps = shared_steps(protocol, planned)
    steps += [*(edge_step(protocol, town, "chosen") for town in REGIONS), cloud_step(protocol)]
    return steps + [test_step(_arm(stage, town), town) for town in REGIONS for stage in STAGES]


def _arm(stage: str, town: str) -> str:
    return f"{town}-edge-chosen" if stage == "edge" else stage


def run_allocation(protocols: Sequence[Protocol], out: Path, *, jobs: int, notify: Notify) -> dict[str, Any]:
    """Run or finish both plans of each seed in folders below `out` and return the results."""
    recorded = {out / f"seed{each.seed}-frames": _recordings(each) for each in protocols}
    run_side_by_side(recorded, jobs=jobs, notify=notify)
    runs: dict[Path, list[Step]] = {}
    for protocol, (frames, recordings) in zip(protocols, recorded.items(), strict=True):
        for name in PLANS:
            folder = out / f"seed{protocol.seed}-{name}"
            _share(recordings, frames, folder)
            runs[folder] = plan_steps(protocol, name)
    values = run_side_by_side(runs, jobs=jobs, notify=notify)
    for folder, found in values.items():
        append_points(out / HISTORY_FILE, points_of(found, folder.name))
    return collect(protocols, out, values)


def _recordings(protocol: Protocol) -> list[Step]:
    """Return the steps that depend on no plan: frames recorded without poles."""
    return [step for step in plan_steps(protocol, JOINT) if not step.needs]


def _share(recordings: Sequence[Step], frames: Path, folder: Path) -> None:
    """Put links to finished recordings where the steps of `folder` look for their own."""
    folder.mkdir(parents=True, exist_ok=True)
    for step in recordings:
        link = folder / step.name
        if not link.exists():
            link.symlink_to(os.path.relpath(frames / step.name, folder), target_is_directory=True)


def collect(protocols: Sequence[Protocol], out: Path, values: Mapping[Path, dict[str, Any]]) -> dict[str, Any]:
    """Return the numbers of finished runs and what they say."""
    seeds = [_one_seed(protocol, out, values) for protocol in protocols]
    results = {
        "protocol": protocols[0].model_dump(mode="json", exclude={"seed"}),
        "history": _history_ranges(),
        "seeds": seeds,
        "summary": summarise(seeds),
        "versions": package_versions(),
        "note": "road labels come from an ideal road detector: AP after edge FL and cloud FL is an upper bound",
    }
    return results | {"findings": allocation_findings(results)}


def _one_seed(protocol: Protocol, out: Path, values: Mapping[Path, dict[str, Any]]) -> dict[str, Any]:
    folders = {name: out / f"seed{protocol.seed}-{name}" for name in PLANS}
    runs = {name: values[folder] for name, folder in folders.items()}
    return {
        "seed": protocol.seed,
        "plans": {name: run["plan"]["tasks"][0] for name, run in runs.items()},
        "predicted": {name: _predicted(folders[name], runs[name]) for name in PLANS},
        "realised": {
            town: {
                name: {stage: run[f"test-{_arm(stage, town)}-{town}"] for stage in STAGES} for name, run in runs.items()
            }
            for town in REGIONS
        },
        "differences": {
            town: {stage: difference(*_tests(folders, stage, town), seed=protocol.seed) for stage in STAGES}
            for town in REGIONS
        },
        "poles": {name: {town: run[f"{town}-place"]["chosen"] for town in REGIONS} for name, run in runs.items()},
        "ledger": {name: _ledger(folders[name], runs[name]) for name in PLANS},
    }


def _tests(folders: Mapping[str, Path], stage: str, town: str) -> tuple[Path, Path]:
    """Return where a stage's tests of equal stages and of the joint plan are."""
    step = f"test-{_arm(stage, town)}-{town}"
    return folders[EQUAL] / step, folders[JOINT] / step


def _predicted(folder: Path, run: Mapping[str, Any]) -> dict[str, float]:
    """Return the accuracy, at least 0, that the plan's own curve predicts after each stage."""
    problem = parse_config(Problem, json.loads((folder / "plan" / PROBLEM).read_text()), str(folder))
    curve, k = problem.tasks[0].curve, problem.edge_rounds_per_cloud_round
    samples, edge_rounds, cloud_rounds = (run["plan"]["tasks"][0][name] for name in COUNTS)
    counts = ((samples, 0, 0), (samples, edge_rounds, 0), (samples, edge_rounds, cloud_rounds))
    return {stage: max(1 - float(curve.error(*each, k)), 0.0) for stage, each in zip(STAGES, counts, strict=True)}


def _ledger(folder: Path, run: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    book, planned = Ledger.load(folder / "cloud" / LEDGER), run["plan"]["tasks"][0]
    return {
        link: {
            "budget_mb": getattr(book.budget, f"{link}_mb"),
            "planned_mb": planned[f"{link}_mb"],
            "used_mb": book.used_mb(link),
        }
        for link in LINKS
    }


def _history_ranges() -> dict[str, list[float]]:
    """Return the least and the most of each count in the history that both plans were predicted from."""
    table = history_table()
    return {name: [float(column.min()), float(column.max())] for name, column in zip(COUNTS, table.T[:3], strict=True)}


def summarise(seeds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return means over seeds with their 95 % intervals; differences are joint minus equal stages, paired by seed."""

    def realised(town: str, name: str, stage: str) -> list[float]:
        return [seed["realised"][town][name][stage]["ap50"] for seed in seeds]

    def predicted(name: str, stage: str) -> list[float]:
        return [seed["predicted"][name][stage] for seed in seeds]

    return {
        "predicted": {name: {stage: float(np.mean(predicted(name, stage))) for stage in STAGES} for name in PLANS},
        "realised": {
            town: {name: {stage: mean_over_seeds(realised(town, name, stage)) for stage in STAGES} for name in PLANS}
            for town in REGIONS
        },
        "predicted_difference": {
            stage: float(np.mean(np.subtract(predicted(JOINT, stage), predicted(EQUAL, stage)))) for stage in STAGES
        },
        "realised_difference": {
            town: {
                stage: mean_over_seeds(np.subtract(realised(town, JOINT, stage), realised(town, EQUAL, stage)).tolist())
                for stage in STAGES
            }
            for town in REGIONS
        },
    }


def draw_allocation(results: Mapping[str, Any]) -> bytes:
    """Return predicted and realised AP of both plans, and their paired differences, as a PNG."""
    return style.png(plans.predicted_and_realised(results, TOWN))

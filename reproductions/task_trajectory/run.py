"""Studies of the trajectory task, on rasters and through cameras: ADE, FDE and miss rate by slice and predictor."""

from collections.abc import Mapping, Sequence

import numpy as np

from flcav.experiments.study import SeedResult, Study, StudyResult, describe_limits, make_experiment
from flcav.perception.trajectory.evaluate import ALL, PathErrors, TrajectoryEvaluation
from flcav.perception.trajectory.task import TRAJECTORY, cameras_study
from flcav.report import style
from flcav.report.charts.studies import Bar, path_errors
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_bullets, format_table

WANTED = {"tiny": (0.7,), "tiny-cameras": (1.0, 0.7)}  # aims by network: most final error over constant velocity's
EFFECT = 0.05  # deviation from an aim that the study should detect
SLICE = "at junctions"
PREDICTORS = {
    "single path": ("single_ADE", "single_FDE", "miss_rate_single"),
    "likeliest mode": ("minADE_1", "minFDE_1", "miss_rate_1"),
    "best of six modes": ("minADE_K", "minFDE_K", "miss_rate_K"),
    "constant velocity": ("constant_velocity_ADE", "constant_velocity_FDE", "miss_rate_constant_velocity"),
}


def tables(results: StudyResult[TrajectoryEvaluation]) -> dict[str, str]:
    """Return Markdown by name: findings (a list), errors, training."""
    return {
        "findings": format_bullets(_findings(results)),
        "errors": format_table(
            (
                "test",
                "subset (samples)",
                "predictor",
                "average displacement error m",
                "final displacement error m",
                "miss rate (2 m)",
                "final error / that of constant velocity",
            ),
            [row for test, means in results.summary.items() for row in _errors(test, means)],
        ),
        "training": format_table(
            (
                "seed",
                "samples",
                "steps",
                "loss of the last epoch",
                "validation, final error m: likeliest mode, best of six",
            ),
            [_trained(seed) for seed in results.seeds],
        ),
    }


def _findings(results: StudyResult[TrajectoryEvaluation]) -> list[str]:
    aims, ends = {}, []
    for test, means in results.summary.items():
        best, plain = (means[f"{SLICE}, {key}"].mean for key in ("minFDE_K", "constant_velocity_FDE"))
        for wanted in WANTED[results.network]:
            aim = f"A final error of {wanted} times constant velocity's at junctions, {test}"
            aims[aim] = Claim(means[f"{SLICE}, ratio_single"], wanted, at_most=True)
            ends.append(f"Of six modes the best ends {best:.2f} m off, constant velocity {plain:.2f} m.")
    said = [f"{aim} {end}" for aim, end in zip(describe_aims(aims), ends, strict=True)]
    return [*said, *describe_limits(aims.values(), EFFECT)]


def _errors(test: str, means: Mapping[str, MeanOverSeeds]) -> list[list[str]]:
    rows = []
    for name in dict.fromkeys(key.rpartition(", ")[0] for key in means):
        count = round(means[f"{name}, samples"].mean)
        for who, (ade, fde, missed) in PREDICTORS.items():
            average, final, misses = (means[f"{name}, {key}"] for key in (ade, fde, missed))
            share = final.mean / means[f"{name}, constant_velocity_FDE"].mean
            shown = final.describe() if final.sd else f"{final.mean:.3f}"
            numbers = [f"{average.mean:.2f}", shown, f"{misses.mean:.1%}", f"{share:.2f}"]
            rows.append([test, f"{name} ({count})", who, *numbers])
    return rows


def _trained(seed: SeedResult[TrajectoryEvaluation]) -> list[str]:
    errors = TrajectoryEvaluation.from_json(seed.card.metrics, "card").slices[ALL]
    known = "" if errors is None else f"{errors.minFDE_1:.2f}, {errors.minFDE_K:.2f}"
    learning = seed.card.learning
    return [str(seed.seed), str(seed.card.samples), str(learning.steps), f"{learning.loss:.2f}", known]


def _draw(results: StudyResult[TrajectoryEvaluation]) -> bytes:
    """Return a PNG of the final displacement errors by test and slice."""
    panels = {}
    for test in results.summary:
        slices: dict[str, list[PathErrors]] = {}
        for tested in results.tested(test):
            for name, errors in tested.slices.items():
                slices.setdefault(name, []).extend([errors] if errors else [])
        panels[test] = {
            f"{name}\n({round(np.mean([errors.samples for errors in seeds]))})": [
                _bar("constant velocity", [errors.constant_velocity_FDE for errors in seeds]),
                _bar("single path", [errors.single_FDE for errors in seeds]),
                _bar("best of six modes", [errors.minFDE_K for errors in seeds]),
            ]
            for name, seeds in slices.items()
            if seeds
        }
    return style.png(path_errors(panels))


def _bar(name: str, seeds: Sequence[float | None]) -> Bar:
    known = [value for value in seeds if value is not None]
    return Bar(name, float(np.mean(known)), tuple(known))


def _is_share(name: str) -> bool:
    return "miss_rate" in name


STUDY = Study(TRAJECTORY, TRAJECTORY.study(), draw=_draw, is_share=_is_share)
CAMERAS = Study(TRAJECTORY, cameras_study(), draw=_draw, is_share=_is_share)

EXPERIMENT = make_experiment(STUDY, tables)

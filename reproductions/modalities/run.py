"""LiDAR with a radar, and with points painted by the camera's network, against LiDAR alone and late fusion.

Every arm is tested on the same frames and targets, with both sensors and with the second one failing. Each seed draws
its own weights and samples, and has test recordings of its own; the training recordings are shared. Networks are also
trained within fewer megabytes of uploads, for the plan that chooses between them (`plan.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flcav.config import InputError, Json
from flcav.experiments.comparison import average_arms, mean_difference, tabulate_verdicts
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.experiments.study import record_split
from flcav.report import style
from flcav.report.charts import figures
from flcav.reproductions.modalities.learning import (
    ALL,
    ARMS,
    BLACK,
    CONDITIONS,
    FAR,
    LATE,
    LIDAR,
    NETWORKS,
    NO_RADAR,
    PAINTED,
    PARTS,
    RADAR,
    Trained,
    test_arms,
    train_arm,
    validate_arm,
)
from flcav.reproductions.modalities.plan import Choice, PlanResult, plan_uploads
from flcav.runs.engine import Notify, Step, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.storage.markdown import format_table
from flcav.storage.records import LEFT_OUT, Record

RIG: Json = {
    "lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 32, "azimuth_steps": 900}}},
    "cameras": {"camera": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 416, "height": 192, "fov_deg": 70.0}}},
    "radars": {"radar": {"mount": {"x": 2.3, "z": 0.5}}},
}
COMMON: Mapping[str, Json] = {"vehicle_rig": RIG, "cavs": 2, "every_s": 3.0, "warmup_s": 40.0}
TOWNS = ("suburb", "arterial")
TRAIN: Mapping[str, Mapping[str, Json]] = {
    f"train-{town}": {**COMMON, "town": town, "seed": 72 + i, "scenes": 20, "spins_per_scene": 5}
    for i, town in enumerate(TOWNS)
}
VALIDATION: Mapping[str, Mapping[str, Json]] = {
    f"validation-{town}": {
        **COMMON,
        "town": town,
        "seed": 74 + i,
        "scenes": 20,
        "spins_per_scene": 2,
        "split": "validation",
    }
    for i, town in enumerate(TOWNS)
}
TESTS: Mapping[str, Mapping[str, Json]] = {
    f"test-{condition}": {
        **COMMON,
        "town": "suburb",
        "seed": 171 + i,
        "scenes": 10,
        "spins_per_scene": 4,
        "split": "test",
        "weather": {"classes": [condition]},
    }
    for i, condition in enumerate(CONDITIONS)
}
MOST_SEEDS, SCENES = 5, 2  # seeds, and scenes of each test recording for each of them
STEPS = 400  # of each training, of two samples
LITTLE_MB, SOME_MB = 45.0, 90.0  # uploads that the curves begin with, and those of the plan's budget
ALONE, MUCH = "all", None  # every sample of the recordings
Training = tuple[str, float | None, bool]  # arm, megabytes of samples, whether annotators are quick
GAINS = [(arm, part) for arm in (RADAR, PAINTED) for part in (ALL, "heavy_rain", "fog", "night", FAR)]
FAILING = {RADAR: NO_RADAR, PAINTED: BLACK}


@dataclass(frozen=True)
class Tested:
    """Tests of an arm in a seed."""

    ap50: Mapping[str, float]  # by part of the test frames
    velocity_m_s: Mapping[str, float | None]  # median velocity error of moving cars that are found [m/s], by part


@dataclass(frozen=True)
class SeedOfModalities:
    """Results of a seed."""

    tests: Mapping[str, Tested]  # by arm
    trained: Mapping[str, Trained]  # by network and megabytes
    validated: Mapping[str, float]  # AP50 on the validation frames, likewise


@dataclass(frozen=True)
class ModalitiesResult(Record):
    """Results of the comparison: by seed, and means over seeds."""

    seeds: Mapping[str, SeedOfModalities]
    ap50: Mapping[str, Mapping[str, MeanOverSeeds]]  # by part and arm
    velocity_m_s: Mapping[str, MeanOverSeeds]  # by arm, on all test frames
    gains: Mapping[str, Mapping[str, MeanOverSeeds]]  # claims that a difference in AP50 is positive: by arm and part
    kept: Mapping[str, MeanOverSeeds]  # gain with both sensors less loss without the second, in AP50, by arm
    over_late: MeanOverSeeds  # RADAR - LATE, AP50
    slower: Mapping[str, MeanOverSeeds]  # reduction of the velocity error by RADAR, by the other arm [m/s]
    provenance: Provenance
    plan: Annotated[PlanResult | None, LEFT_OUT] = None  # None: its trainings are missing

    def sentences(self) -> list[str]:
        """Return AP50 of every arm on all test frames, and what the plan chose, in words."""
        lines = [f"{arm}: AP50 {mean.describe()}" for arm, mean in self.ap50[ALL].items()]
        if self.plan is None:
            return lines
        return [*lines, f"The plan uploads {self.plan.chosen}; the best of the retrainings is {self.plan.best}."]


def list_steps(seeds: Sequence[int], quick: bool) -> list[Step]:
    """Return the steps: recordings, trainings, their validation, and the tests of each seed.

    Raises `InputError` for more seeds than have test scenes of their own.
    """
    if len(seeds) > MOST_SEEDS:
        raise InputError(f"modalities: {len(seeds)} seeds, and {MOST_SEEDS} at most have test scenes of their own")
    few: Mapping[str, Json] = {"scenes": 4, "spins_per_scene": 1} if quick else {}
    mixed: Mapping[str, Json] = {"weather": {"classes": [*CONDITIONS]}}
    recordings: dict[str, Mapping[str, Json]] = {
        **{name: {**fields, **mixed, **few} for name, fields in {**TRAIN, **VALIDATION}.items()},
        **TESTS,
    }
    steps = [Step(name, record_split, {"recipe": fields}) for name, fields in recordings.items()]
    for seed in seeds:
        full, _ = list_trainings()
        steps += [_train(seed, training, quick) for training in full]
        trained = {arm: name_step(seed, arm, MUCH, False) for arm in NETWORKS}
        asked = {"trained": trained, "tests": [*TESTS], "scenes": [SCENES * (seed - 1), SCENES * seed]}
        needs = (*trained.values(), *TESTS, *VALIDATION)
        steps.append(Step(f"tested-{seed}", test_arms, {**asked, "validate_on": [*VALIDATION]}, needs))
    for seed in seeds:
        full, less = list_trainings()
        steps += [_train(seed, training, quick) for training in less]
        for training in (*full, *less):
            name = name_step(seed, *training)
            validate = {"trained": name, "validate_on": [*VALIDATION]}
            steps.append(Step(f"{name}-validated", validate_arm, validate, (name, *VALIDATION)))
    return steps


def _train(seed: int, training: Training, quick: bool) -> Step:
    """Return the step of a training."""
    (arm, mb, careless), name = training, name_step(seed, *training)
    sent_mb = mb / 20 if quick and mb is not None else mb
    asked = {"arm": arm, "mb": sent_mb, "quick": careless, "seed": seed, "steps": 4 if quick else STEPS}
    return Step(name, train_arm, {**asked, "train_on": [*TRAIN]}, (*TRAIN,))


def list_trainings() -> tuple[list[Training], list[Training]]:
    """Return the trainings of every seed: on all samples, and those for the plan."""
    full: list[Training] = [(arm, MUCH, False) for arm in NETWORKS]
    less: list[Training] = [(arm, mb, False) for mb in (LITTLE_MB, SOME_MB) for arm in NETWORKS]
    return full, [*less, (LIDAR, MUCH, True)]


def name_training(arm: str, mb: float | None, careless: bool) -> str:
    """Return the name of a training in the results."""
    return f"{arm}, {ALONE if mb is None else f'{mb:g} MB'}{', quick annotators' if careless else ''}"


def name_step(seed: int, arm: str, mb: float | None, careless: bool) -> str:
    """Return the name of a training's step."""
    return f"{name_training(arm, mb, careless)}-{seed}".lower().replace(", ", "-").replace(" ", "-")


def compare(values: Mapping[str, Any], seeds: Sequence[int]) -> ModalitiesResult:
    """Return the results, of the values of the steps."""
    found: dict[str, SeedOfModalities] = {}
    every = [each for part in list_trainings() for each in part]
    for seed in seeds:
        steps = {name_training(*each): name_step(seed, *each) for each in every}
        found[str(seed)] = SeedOfModalities(
            {arm: Tested(**each) for arm, each in values[f"tested-{seed}"].items()},
            {name: Trained(**values[step]) for name, step in steps.items() if step in values},
            {name: values[each] for name, step in steps.items() if (each := f"{step}-validated") in values},
        )
    tests = {seed: each.tests for seed, each in found.items()}

    def velocity(tested: Tested) -> float:
        error = tested.velocity_m_s[ALL]
        assert error is not None
        return error

    known = all(len(each.validated) == len(every) for each in found.values())
    return ModalitiesResult(
        seeds=found,
        ap50={part: average_arms(tests, ARMS, lambda tested, part=part: tested.ap50[part]) for part in PARTS},
        velocity_m_s=average_arms(tests, ARMS, velocity, share=False),
        gains={
            arm: {
                part: mean_difference(tests, arm, LIDAR, lambda tested, part=part: tested.ap50[part])
                for each, part in GAINS
                if each == arm
            }
            for arm in (RADAR, PAINTED)
        },
        kept={
            arm: mean_over_seeds(
                [each[arm].ap50[ALL] + each[failing].ap50[ALL] - 2 * each[LIDAR].ap50[ALL] for each in tests.values()]
            )
            for arm, failing in FAILING.items()
        },
        over_late=mean_difference(tests, RADAR, LATE, lambda tested: tested.ap50[ALL]),
        slower={arm: mean_difference(tests, arm, RADAR, velocity) for arm in (LIDAR, LATE)},
        plan=plan_uploads(_choices(found), SOME_MB) if known else None,
        provenance=provenance(),
    )


def _choices(seeds: Mapping[str, SeedOfModalities]) -> dict[str, Choice]:
    """Return what the plan knows of every network, means over seeds, and what the retraining reached."""

    def mean(name: str, of: str, field: str = "") -> float:
        rows = [getattr(seed, of)[name] for seed in seeds.values()]
        return float(np.mean([getattr(row, field) if field else row for row in rows]))

    choices = {}
    for arm in NETWORKS:
        little, some, much = (name_training(arm, mb, False) for mb in (LITTLE_MB, SOME_MB, MUCH))
        few, all_ = ((mean(name, "trained", "samples"), 1 - mean(name, "validated")) for name in (little, much))
        careless = name_training(arm, MUCH, True)
        choices[arm] = Choice(
            sample_mb=mean(much, "trained", "sample_mb"),
            measured=(few, all_),
            retrained=1 - mean(some, "validated"),
            quick=1 - mean(careless, "validated") if arm == LIDAR else None,
        )
    return choices


def draw_gains(results: ModalitiesResult) -> bytes:
    """Return a forest plot of AP50 by part and arm as a PNG."""
    return style.png(figures.arms({part.replace("_", " "): dict(results.ap50[part]) for part in PARTS}))


def tables(results: ModalitiesResult) -> dict[str, str]:
    """Return Markdown by name: accuracy, velocities, claims, costs, plan, annotation."""
    rows = [[arm, *(results.ap50[part][arm].describe() for part in PARTS)] for arm in ARMS]
    claims: dict[tuple[str, ...], MeanOverSeeds] = {
        (f"{arm} - {LIDAR}", part.replace("_", " "), "AP50"): mean
        for arm, parts in results.gains.items()
        for part, mean in parts.items()
    }
    claims |= {(f"gain of {arm} - loss in {FAILING[arm]}", ALL, "AP50"): mean for arm, mean in results.kept.items()}
    claims[(f"{RADAR} - {LATE}", ALL, "AP50")] = results.over_late
    claims |= {(f"{arm} - {RADAR}", ALL, "velocity error, m/s"): mean for arm, mean in results.slower.items()}
    costs = []
    for arm in NETWORKS:
        name = name_training(arm, MUCH, False)
        trained = [seed.trained[name] for seed in results.seeds.values()]
        means = [
            float(np.mean([getattr(each, field) for each in trained]))
            for field in ("sample_mb", "packed_mb", "seconds")
        ]
        costs.append([arm, f"{means[0]:.3f}", f"{means[1]:.3f}", f"{means[2]:.0f}"])
    return {
        "accuracy": format_table(("arm", *(part.replace("_", " ") for part in PARTS)), rows),
        "velocities": format_table(
            ("arm", "median velocity error of moving cars that are found, m/s"),
            [[arm, results.velocity_m_s[arm].describe()] for arm in ARMS],
        ),
        "claims": tabulate_verdicts(("difference", "test frames", "measure"), "mean over seeds", claims),
        "costs": format_table(
            ("network", "sample, MB", "compressed, MB", f"CPU time of {STEPS} steps, s, mean over seeds"), costs
        ),
        **({} if results.plan is None else results.plan.tables()),
    }


def run_modalities(out: Path, seeds: Sequence[int], *, quick: bool, jobs: int, notify: Notify, stale: str, engine: str):
    """Run or finish the experiment in the folder `out`; `quick` is a trial of few frames and steps."""
    values = run_steps(list_steps(seeds, quick), out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    return compare(values, seeds)


def _run(out: Path, options: Options) -> Outcome[ModalitiesResult]:
    with options.show_steps(options.title) as notify:
        seeds = range(1, options.seeds + 1)
        results = run_modalities(out, seeds, quick=options.quick, **options.how(notify))
    return Outcome(results, {"arms.png": draw_gains(results)}, results.sentences())


EXPERIMENT = Experiment(ModalitiesResult, _run, tables, seeds=5)

"""Centralised training: stage I of a task, with its uploads, and training on ground truth in place of stage II.

The latter is a control that takes as many optimiser steps as stage II.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flcav.interface.progress import Report
from flcav.network.ledger import Ledger
from flcav.perception.ops.sparse import second_core
from flcav.perception.outcomes import score_network
from flcav.perception.task import Task
from flcav.perception.training import Checkpointing, Validation, train, train_steps
from flcav.perception.weights import save_network
from flcav.runs.arms import Setting
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.labels.pseudo_labels import fit_label_threshold
from flcav.runs.labels.tracks import fit_track_threshold
from flcav.runs.recipe import ALL, CENTRAL, EDGE, PRETRAIN, Budgets
from flcav.runs.results.plans import Plan
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.results.training import Pretrained, StageResult, Validated
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.planning import list_frames
from flcav.runs.stages.regions import load_uploads, select_group
from flcav.runs.stages.settings import (
    LearningSettings,
    RegionInputs,
    StepSettings,
    make_step,
    read_entries,
    share_plan_budget,
)
from flcav.runs.training.checkpoints import LAST
from flcav.runs.training.learning import Learning, StartingWeights, load_stage_network, load_start
from flcav.runs.training.messages import choose_planned_uploads, choose_uploads, upload_samples
from flcav.statistics.streams import derive_seed

CHECKPOINT, ROUND = "checkpoint.pt", LAST
COUNTED_MB = 1e9  # budget of a link whose traffic is counted but not limited [MB]
VALIDATIONS, APART = 10, 5  # number of validations during pretraining, and the least number of steps between them


def pretrain(
    learning: Learning,
    network: Any,
    samples: Sequence[Any],
    validation: Sequence[Frames],
    folder: Path,
    report: Report,
) -> tuple[Validated, ...]:
    """Pretrain a network with the task's learning-rate schedule; return the validations in between.

    Writes the weights of the last step to `folder`. An interrupted training resumes after its last validation.
    """
    task, steps = learning.task, learning.training.steps
    every = max(steps // VALIDATIONS, min(APART, steps))
    history = train(
        task,
        network,
        samples,
        steps=steps,
        batch=learning.batch,
        seed=derive_seed(learning.seed, PRETRAIN),
        checkpointing=Checkpointing(folder / CHECKPOINT, every),
        validation=Validation(lambda now: average_splits(task, now, validation), every),
        progress=report,
    )
    save_network(task, network, folder / WEIGHTS)
    (folder / CHECKPOINT).unlink()
    means = history.losses[: every * len(history.scores)].reshape(-1, every).mean(axis=1)
    return tuple(
        Validated(every * number, float(loss), float(score))
        for number, (loss, score) in enumerate(zip(means, history.scores, strict=True), start=1)
    )


def average_splits(task: Task, network: Any, splits: Sequence[Frames]) -> float:
    """Return the mean over `splits` of the task's measure on the vehicles' frames."""
    return float(np.mean([score_network(task, network, split.data, split.vehicles) for split in splits]))


def train_centrally(
    learning: Learning, network: Any, samples: Sequence[Any], rounds: int, clients: int, name: str
) -> tuple[float, ...]:
    """Train a network centrally for as many steps as a federation of `clients` takes in `rounds`, at the same rates.

    Changes the network in place; returns the mean loss by round.
    """
    schedule = learning.schedule(rounds, learning.training.local_steps * clients, "more", name)
    losses = []
    for round_ in range(1, rounds + 1):
        work = schedule.work(round_)
        losses.append(
            train_steps(
                learning.task,
                network,
                samples,
                steps=work.steps,
                batch=learning.batch,
                learning_rate=work.learning_rate,
                seed=work.seed,
            )
        )
    return tuple(losses)


class PretrainSettings(StepSettings):
    """Settings of stage I of a task."""

    learning: LearningSettings
    start: StartingWeights | None = None  # None: initial weights are drawn
    plan: str
    pools: Mapping[str, str]  # recordings of the candidates for upload, by region
    validation: tuple[str, ...]  # recordings of the validation frames
    budgets_mb: Budgets  # of the run
    upload_seed: int  # of the draw of uploads, the same in retrainings
    thresholded: bool  # whether detections serve as labels, so that a score threshold is needed
    tracked: bool = False  # whether tracks do

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (self.plan, *self.pools.values(), *self.validation)


def pretrain_step(work: Work, settings: PretrainSettings, processes: int = 1) -> None:
    """Run stage I of a task: upload the planned samples, train on them, fix the score threshold of pseudo-labels.

    With several `processes`, gradients are computed on two cores, with the same weights as the result.
    """
    task, learning = settings.learning.task, settings.learning.resolve()
    plan = Plan.load(work.inputs[settings.plan])
    opened = {region: Frames.open(work.inputs[step]) for region, step in settings.pools.items()}
    watched = [Frames.open(work.inputs[step]) for step in settings.validation]
    uploads = plan.tasks[task].uploads
    if uploads is None:
        pools = {region: split.vehicles for region, split in opened.items()}
        chosen = choose_uploads(pools, plan.tasks[task].samples, settings.upload_seed)
    else:
        held = {region: dict(list_frames(region, split)) for region, split in opened.items()}
        chosen = choose_planned_uploads(held, uploads, settings.upload_seed)
    network = learning.build_network() if settings.start is None else load_start(learning.task, settings.start)
    book = Ledger(share_plan_budget(plan, settings.budgets_mb, task))
    samples = list[Any]()
    for region, frames in chosen.items():
        if frames:
            received = upload_samples(book, learning.task, network.config, region, opened[region], frames)
            samples += [received[number] for number in range(len(received))]  # in memory: samples are drawn many times
    book.save(work.folder / LEDGER)
    validated = ()
    if samples:
        with second_core() if processes > 1 else contextlib.nullcontext():
            validated = pretrain(learning, network, samples, watched, work.folder, work.report)
    else:
        save_network(learning.task, network, work.folder / WEIGHTS)
    trained = load_stage_network(learning.task, work.folder)
    Pretrained(
        task=task,
        network=learning.network or next(iter(learning.task.configurations)),
        uploaded=chosen,
        validated=validated,
        steps=learning.training.steps if samples else 0,
        threshold=fit_label_threshold(trained, watched) if settings.thresholded else None,
        track_threshold=fit_track_threshold(trained, watched, work.report) if settings.tracked else None,
    ).save(work.folder)


def list_pretraining(outline: Outline, arm: Setting) -> Iterator[Step]:
    """Yield the steps of stage I of an arm, by task."""
    recipe, names = outline.recipe, outline.names
    for task in recipe.tasks:
        kinds = [LABEL_SOURCES[setting.labels[task]] for setting in outline.settings.values()]
        settings = PretrainSettings(
            learning=outline.learning(arm, task),
            start=outline.starts[task],
            plan=names.plan(arm.name),
            pools=outline.pools(task),
            validation=tuple(names.recording(region, "validation", task) for region in recipe.with_role("pretrain")),
            budgets_mb=recipe.budgets_mb,
            upload_seed=recipe.seed,
            thresholded=any(kind.from_detections for kind in kinds),
            tracked=outline.tracks(task),
        )
        yield make_step(names.pretrain(arm.name, task), pretrain_step, settings, workers=2)


class MoreSettings(StepSettings):
    """Settings of further pretraining, the same for all regions of an arm."""

    learning: LearningSettings
    plan: str  # whose number of edge rounds decides its length
    pretrain: str
    pools: Mapping[str, str]  # recordings of the candidates for upload, by region
    vehicles: int  # number of those whose local steps it takes: the largest region's

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (self.plan, self.pretrain, *self.pools.values())


class JointSettings(StepSettings):
    """Settings of centralised training on the samples of stage I and on the annotated frames of all vehicles."""

    learning: LearningSettings
    regions: Mapping[str, RegionInputs]  # regions whose vehicles' frames it trains on
    pools: Mapping[str, str]  # recordings of the candidates for upload, by region
    vehicles: int  # number of those whose local steps it takes: the largest region's

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (*self.pools.values(), *(step for inputs in self.regions.values() for step in inputs.needs))


class OracleSettings(StepSettings):
    """Settings of centralised training on the annotated frames of a region's vehicles."""

    learning: LearningSettings
    inputs: RegionInputs
    vehicles: int  # number of those whose local steps it takes: the region's
    uploads: int | None = None  # frames that the vehicles upload; None: all are available at no cost
    compressed: bool = False  # whether these are
    budgets_mb: Budgets  # of the run

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return self.inputs.needs


def more_step(work: Work, settings: MoreSettings) -> None:
    """Continue pretraining for as many optimiser steps as stage II takes in the largest region."""
    learning = settings.learning.resolve()
    trained = load_stage_network(learning.task, work.inputs[settings.pretrain])
    samples = load_uploads(work, learning, trained.config, settings.pretrain, settings.pools)
    _train_on(work, learning, trained, samples, settings.plan, settings.vehicles, None)


def joint_step(work: Work, settings: JointSettings) -> None:
    """Continue training centrally on ground truth of all regions, for as many steps as stage II in the largest."""
    learning, (first, *_) = settings.learning.resolve(), settings.regions.values()
    trained = load_stage_network(learning.task, work.inputs[first.pretrain])
    samples = load_uploads(work, learning, trained.config, first.pretrain, settings.pools)
    for inputs in settings.regions.values():
        split = Frames.open(work.inputs[inputs.frames])
        held = learning.task.samples(split.data, trained.config, select_group(work, split, inputs))
        samples += [held[number] for number in range(len(held))]
    _train_on(work, learning, trained, samples, first.plan, settings.vehicles, None)


def oracle_step(work: Work, settings: OracleSettings) -> None:
    """Continue training centrally on ground truth of a region, for as many optimiser steps as its stage II takes."""
    learning = settings.learning.resolve()
    inputs = settings.inputs
    trained = load_stage_network(learning.task, work.inputs[inputs.pretrain])
    split = Frames.open(work.inputs[inputs.frames])
    frames = select_group(work, split, inputs)
    if settings.uploads is None:
        held = learning.task.samples(split.data, trained.config, frames)
    else:
        share = share_plan_budget(Plan.load(work.inputs[inputs.plan]), settings.budgets_mb, learning.task.name)
        share = replace(share, wireline_mb=COUNTED_MB)  # the cloud rounds that it was planned for do not take place
        book = Ledger(share, read_entries(work, inputs.pretrain))
        before = len(book.entries)
        chosen = choose_uploads({inputs.region: frames}, settings.uploads, settings.learning.seed)[inputs.region]
        held = upload_samples(
            book, learning.task, trained.config, inputs.region, split, chosen, EDGE, settings.compressed
        )
        Ledger(share, book.entries[before:]).save(work.folder / LEDGER)
    samples = [held[number] for number in range(len(held))]  # in memory: samples are drawn many times
    _train_on(work, learning, trained, samples, inputs.plan, settings.vehicles, inputs.region)


def _train_on(
    work: Work, learning: Learning, network: Any, samples: Sequence[Any], plan: str, vehicles: int, region: str | None
) -> None:
    """Train a network centrally; write its weights and the result of the stage (`region` None: of all regions)."""
    task = learning.task.name
    rounds = Plan.load(work.inputs[plan]).tasks[task].edge_rounds
    losses = train_centrally(learning, network, samples, rounds, vehicles, PRETRAIN if region is None else "federate")
    save_network(learning.task, network, work.folder / WEIGHTS)
    StageResult(CENTRAL, task, region, rounds, len(samples), 1, (), losses).save(work.folder)


def list_central_steps(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield the steps of an arm's centralised training for a task: one for all of its regions, or one per region."""
    names, learning = outline.names, outline.learning(arm, task)
    if arm.central == PRETRAIN:
        settings = MoreSettings(
            learning=learning,
            plan=names.plan(arm.name, CENTRAL),
            pretrain=names.pretrain(arm.name, task),
            pools=outline.pools(task),
            vehicles=max(outline.vehicles[region] for region in arm.regions),
        )
        yield make_step(names.central(arm.name, arm.regions[0], task), more_step, settings)
        return
    if arm.central == ALL:
        settings = JointSettings(
            learning=learning,
            regions={region: outline.inputs(arm, region, task, CENTRAL) for region in arm.regions},
            pools=outline.pools(task),
            vehicles=max(outline.vehicles[region] for region in arm.regions),
        )
        yield make_step(names.central(arm.name, arm.regions[0], task), joint_step, settings)
        return
    for region in arm.regions:
        inputs = outline.inputs(arm, region, task, CENTRAL)
        settings = OracleSettings(
            learning=learning,
            inputs=inputs,
            vehicles=outline.vehicles[region],
            uploads=arm.uploads,
            compressed=arm.compressed,
            budgets_mb=outline.recipe.budgets_mb,
        )
        yield make_step(names.central(arm.name, region, task), oracle_step, settings)

"""Lifelong learning: in every condition a group trains a copy on request, which is deployed if it is better.

The rounds of a condition are those of stage II. They start at the deployed network instead of the pretrained one, and
their group forms on request.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from flcav.network.ledger import Ledger
from flcav.perception.tasks import task_named
from flcav.perception.weights import to_arrays
from flcav.runs.arms import Setting
from flcav.runs.engine import Step, Work
from flcav.runs.extras.groups.rows import Group
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.extras.lifelong.checks import find_requests
from flcav.runs.extras.lifelong.replay import NO_LIMIT, Memory, remember
from flcav.runs.extras.lifelong.settings import LEARNING, LIFELONG, REPLAY, Lifelong
from flcav.runs.frames import Frames
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN
from flcav.runs.results.saved import LEDGER, WEIGHTS, Saved
from flcav.runs.results.training import Pretrained, StageResult
from flcav.runs.stages.federating import EdgeSettings, federate_step
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.settings import RegionInputs, StepSettings, make_step
from flcav.runs.stages.testing import RoundsSettings, TestSettings, rounds_step, test_step
from flcav.runs.stages.tracking import TrackSettings, track_step
from flcav.runs.training.learning import load_stage_network
from flcav.runs.training.messages import send_region_network

DELIVERED = "delivered.parquet"  # ledger of sending the new network to the vehicles


class ReplaySettings(EdgeSettings):
    """Settings of a group's rounds in a condition, in which vehicles replay earlier ones from memory."""

    memory: Memory | None = None  # of earlier conditions

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (*super().needs, *(() if self.memory is None else self.memory.needs))


def learn_step(work: Work, settings: ReplaySettings, **means: Any) -> None:
    """Run the rounds of a condition like those of stage II, with the vehicles' memory joined to their samples."""
    memory = settings.memory
    recall = None if memory is None else partial(remember, work, settings, memory, settings.inputs.region)
    federate_step(work, settings, recall=recall, **means)


class DriveSettings(StepSettings):
    """Settings of the choice between the deployed network and the copy that a group has trained."""

    region: str  # condition
    before: str  # step of the deployed network: of the previous condition, or of pretraining
    learned: str  # step of the group's rounds
    frames: str  # recording of its vehicles' training frames

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (self.before, self.learned, self.frames)


@dataclass(frozen=True)
class Driving(Saved):
    """The network that drives after a condition: the group's copy, or the previously deployed one."""

    file: ClassVar[str] = "driving.json"
    replaced: bool  # whether the copy is deployed: its loss on the members' held-back frames is lower
    before: float | None  # mean loss on these frames with the previously deployed network; None: no group
    after: float | None  # mean loss on these frames with the copy
    recorded_s: float  # driving time in which the frames were recorded, by the clock of the traffic [s]


def drive_step(work: Work, settings: DriveSettings) -> None:
    """Deploy the group's copy if its loss is lower than the deployed network's, and send it to the vehicles.

    The folder then has the form of a pretraining, as the next condition's rounds need it: weights, score threshold of
    labels, and the ledger of stage I.
    """
    before, learned = work.inputs[settings.before], work.inputs[settings.learned]
    pretrained = Pretrained.load(before)
    result = StageResult.load(learned)
    split = Frames.open(work.inputs[settings.frames])
    losses = None if result.group is None else compare_copies(result.group)
    replaced = losses is not None and losses[1] < losses[0]
    shutil.copyfile((learned if replaced else before) / WEIGHTS, work.folder / WEIGHTS)
    shutil.copyfile(before / LEDGER, work.folder / LEDGER)
    pretrained.save(work.folder)
    book = Ledger(NO_LIMIT)
    if replaced:
        clients = [f"{settings.region}/{agent}" for agent in sorted({split.data.keys[i].agent for i in split.vehicles})]
        task = task_named(pretrained.task)
        send_region_network(book, task, to_arrays(load_stage_network(task, work.folder)), clients, EDGE)
    book.save(work.folder / DELIVERED)
    compared = (None, None) if losses is None else losses
    Driving(replaced, *compared, count_recorded_s(split)).save(work.folder)


def compare_copies(group: Group) -> tuple[float, float] | None:
    """Return the mean loss on the members' held-back samples: of the deployed network and of the copy.

    None without members that hold samples back.
    """
    pairs = [
        (check.before, check.after) for check in group.vehicles.values() if check.after is not None and check.held_back
    ]  # others have no copy
    if not pairs:
        return None
    before, after = np.mean(pairs, axis=0).tolist()
    return before, after


def count_recorded_s(split: Frames) -> float:
    """Return the driving time in which vehicles recorded their frames [s]: from first to last, summed over scenes."""
    times: dict[str, list[float]] = {}
    for i in split.vehicles:
        times.setdefault(split.data.keys[i].scene, []).append(split.data.keys[i].time_s)
    return float(sum(max(instants) - min(instants) for instants in times.values()))


def name_learning(condition: str, task: str, arm: str) -> str:
    """Return the name of the step of a group's rounds in a condition."""
    return f"{condition}-{LIFELONG}-{task}-{_file(arm)}"


def name_driving(condition: str, task: str, arm: str) -> str:
    """Return the name of the step that decides which network drives after a condition."""
    return f"{condition}-drives-{task}-{_file(arm)}"


def _file(arm: str) -> str:
    return arm.replace(" ", "-")


def list_lifelong_steps(outline: Outline) -> Iterator[Step]:
    """Yield the steps of lifelong learning, by task and learning arm; none where the recipe has none."""
    lifelong = outline.recipe.lifelong
    main = outline.settings[MAIN]
    if lifelong is not None:
        for task in outline.recipe.tasks:
            for arm in LEARNING:
                yield from _list_conditions(outline, lifelong, main, task, arm)


def _list_conditions(outline: Outline, lifelong: Lifelong, main: Setting, task: str, arm: str) -> Iterator[Step]:
    names, training = outline.names, main.training[task]
    requests = find_requests(outline.recipe)
    drives, passed = names.pretrain(MAIN, task), list[RegionInputs]()
    for number, condition in enumerate(lifelong.conditions):
        inputs = outline.inputs(main, condition, task, EDGE).model_copy(update={"pretrain": drives, "errors": None})
        if inputs.tracks is not None:
            inputs = inputs.model_copy(update={"tracks": f"{condition}-tracks-{task}-{_file(arm)}"})
            yield _track(outline, main, task, inputs)
        learned, frames = name_learning(condition, task, arm), names.recording(condition, EDGE, task)
        memory = Memory(conditions=tuple(passed), frames=lifelong.memory) if arm == REPLAY and passed else None
        settings = _federate(outline, main, task, requests, inputs, memory)
        yield make_step(learned, learn_step, settings, outline.vehicles[condition])
        about: dict[str, Any] = {"task": task, "start": drives, "averaged": training.average_rounds}
        for seen in lifelong.conditions[: number + 1]:
            about |= {"region": seen, "frames": names.recording(seen, "validation", task)}
            for trained, stage, share in ((drives, PRETRAIN, 0.0), (learned, EDGE, training.start_share)):
                rounds = RoundsSettings(**about, trained=trained, stage=stage, share=share)
                yield make_step(names.rounds(trained, seen), rounds_step, rounds)
        change = DriveSettings(region=condition, before=drives, learned=learned, frames=frames)
        drives = name_driving(condition, task, arm)
        yield make_step(drives, drive_step, change)
        for region in lifelong.conditions:
            tested = names.recording(region, "test", task)
            test = TestSettings(
                task=task, region=region, trained=drives, frames=tested, seed=outline.recipe.seed, model=None
            )
            yield make_step(names.test(drives, region), test_step, test)
        passed.append(inputs)


def _federate(
    outline: Outline, main: Setting, task: str, requests: Requests, inputs: RegionInputs, memory: Memory | None
) -> ReplaySettings:
    """Return the settings of a condition's rounds: like those of stage II, with groups on request."""
    rounds = main.edge_federation.model_copy(update={"requests": requests})
    about = outline.federation(main, task, EDGE).model_copy(update={"federation": rounds})
    return ReplaySettings(**dict(about), inputs=inputs, last=True, memory=memory)


def _track(outline: Outline, main: Setting, task: str, inputs: RegionInputs) -> Step:
    """Return the step that tracks the objects around a condition's frames by the network that drives."""
    assert inputs.tracks is not None  # called for labels by tracks alone
    before = inputs.model_copy(update={"tracks": None})
    settings = TrackSettings(
        task=task,
        inputs=before,
        labels=main.labels[task],
        messages=main.messages if LABEL_SOURCES[main.labels[task]].heard else None,
        navigation=outline.recipe.navigation,
    )
    return make_step(inputs.tracks, track_step, settings)


def forecast_lifelong_s(outline: Outline, task: str, rounds: int, step_s: float, test_s: float) -> float:
    """Return the computing time of lifelong learning [s] if all vehicles form a group in every condition of both arms.

    `rounds`: of stage II. `step_s`, `test_s`: times of a training step, and of testing a frame [s].
    """
    lifelong = outline.recipe.lifelong
    if lifelong is None:
        return 0.0
    size = outline.recipe.sized_splits
    steps = outline.settings[MAIN].training[task].local_steps
    count = len(lifelong.conditions)
    trained = rounds * steps * sum(outline.vehicles[condition] for condition in lifelong.conditions)
    tested = count**2 * size.test.scenes * size.test.spins * size.test.cavs
    watched = size.validation.scenes * size.validation.spins * size.validation.cavs
    watched *= (1 + rounds) * count * (count + 1) // 2
    return len(LEARNING) * (trained * step_s + (tested + watched) * test_s)

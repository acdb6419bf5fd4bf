"""Outcomes of a test, from which the task's measure and its bootstrap over scenes are computed without the network.

The bootstrap gives 95 % percentile intervals of the measure and of paired differences between two networks, see
`flcav.statistics`. The `evaluate.py` of a task defines what is kept per unit (a frame, an image or a road user) and how
the measure is computed from it.
"""

import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import nn

from flcav.arrays import Array, Ints, Words
from flcav.config import InputError, check_is_file
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.task import Task
from flcav.statistics.bootstrap import REDRAWS, bootstrap_over_scenes, share_scenes
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import SharedScenes
from flcav.statistics.streams import stream
from flcav.statistics.verdicts import verdict
from flcav.storage.files import atomic_path
from flcav.storage.records import WHERE_TRUE, Record

SCENE = "scene"
Times = Ints  # (n, N) how often each of N units is drawn in each of n bootstrap samples
Values = Array  # (n,) measure of each bootstrap sample; NaN where it is undefined


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of a network on N units: frames, images or road users, by task."""

    scene: Words  # (N,) scene of each unit
    arrays: Mapping[str, NDArray]  # arrays by name, as the task defines them

    def save(self, path: Path) -> None:
        """Write the outcomes as a compressed NumPy archive (.npz), atomically."""
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{SCENE: self.scene}, **self.arrays)

    @classmethod
    def load(cls, path: Path) -> "Outcomes":
        """Return the outcomes that `save` wrote; raises `InputError` for any other file."""
        check_is_file(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            return cls(arrays.pop(SCENE), arrays)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: no outcomes of a test ({error})") from None


Measure = Callable[[Outcomes, Times], Values]  # a measure of each of n bootstrap samples, see `Measurable.measure`


@runtime_checkable
class Measurable(Protocol):
    """A task whose measure is computed from outcomes, so that it can be bootstrapped over scenes."""

    @property
    def measure_name(self) -> str:
        """Return the name of the measure, such as "mAP50"; a measure lies in [0, 1], and more is better."""
        ...

    @property
    def redraws(self) -> int:
        """Return the number of bootstrap samples."""
        ...

    def outcomes(
        self, network: nn.Module, data: Dataset, frames: Sequence[int], progress: Report = ignore_progress
    ) -> Outcomes:
        """Return the outcomes of `network` on the frames; raises `InputError` if there is nothing to measure."""
        ...

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the measure (n,) of each of n bootstrap samples, in which the units count `times` (n, N)."""
        ...

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return further numbers by name; None where one is undefined."""
        ...


@runtime_checkable
class SharesTargets(Protocol):
    """A `Measurable` task whose networks may look for different things: two are compared on what both look for."""

    def describe_targets(self, config: Any) -> str:
        """Return what a network of `config` looks for, in words that are the same for networks of the same targets."""
        ...

    def share_targets(self, configs: Sequence[Any]) -> Any:
        """Return a configuration of what networks of all `configs` look for; raises `InputError` where that is nothing.

        `outcomes` takes it as `asked`: other targets are then left out, and what the network found of them.
        """
        ...

    def outcomes(
        self,
        network: nn.Module,
        data: Dataset,
        frames: Sequence[int],
        progress: Report = ignore_progress,
        asked: Any = None,
    ) -> Outcomes:
        """Return the outcomes of `network` on the frames, as `Measurable`; with `asked` of these targets alone."""
        ...


@runtime_checkable
class MeasuresMore(Protocol):
    """A task with further measures, computed from the same outcomes as its main measure."""

    @property
    def further_measures(self) -> Mapping[str, Measure]:
        """Return the further measures by their names in `numbers`."""
        ...


@dataclass(frozen=True)
class Counted:
    """Numbers of a test's objects that a network found, missed and made up."""

    noun: str  # of several targets, such as "cars"
    targets: int
    found: int
    false: int | None  # detections of nothing; None for a task without them


@runtime_checkable
class Counts(Protocol):
    """A task whose outcomes say how many targets a network found, at the score from which its detections are used."""

    def count(self, outcomes: Outcomes) -> Counted:
        """Return the numbers of targets, of those found, and of false detections."""
        ...


def further_measures(task: Task) -> Mapping[str, Measure]:
    """Return the further measures of a task by name; empty where it has none."""
    return task.further_measures if isinstance(task, MeasuresMore) else {}


class SceneScores:
    """Default measure of a task without outcomes: the mean over scenes of `Evaluated.score`."""

    measure_name = "mean score of a scene"
    redraws = REDRAWS

    def __init__(self, task: Task) -> None:
        self._task = task

    def outcomes(
        self, network: nn.Module, data: Dataset, frames: Sequence[int], progress: Report = ignore_progress
    ) -> Outcomes:
        """Return the score of each scene, under the name "score"."""
        scenes = list(dict.fromkeys(data.keys[i].scene for i in frames))
        scores = []
        for done, scene in enumerate(scenes, start=1):
            of_scene = [i for i in frames if data.keys[i].scene == scene]
            scores.append(self._task.evaluate(network, data, of_scene).score)
            progress(done, len(scenes), "")
        return Outcomes(np.array(scenes), {"score": np.array(scores, dtype=np.float64)})

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the mean score of each bootstrap sample."""
        return weighted_mean(outcomes.arrays["score"], times)

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return no further numbers."""
        return {}


def as_measurable(task: Task) -> Measurable:
    """Return the task itself if it is `Measurable`, otherwise its `SceneScores`."""
    return task if isinstance(task, Measurable) else SceneScores(task)


def compute_measure(task: Task, outcomes: Outcomes) -> float:
    """Return the task's measure with every unit counted once; NaN if it is undefined, as without targets."""
    return count_once(as_measurable(task).measure, outcomes)


def count_once(measure: Measure, outcomes: Outcomes) -> float:
    """Return a measure with every unit counted once; NaN if it is undefined."""
    return float(measure(outcomes, np.ones((1, len(outcomes.scene)), dtype=np.int64))[0])


def score_network(task: Task, network: nn.Module, data: Dataset, frames: Sequence[int] | None = None) -> float:
    """Return the measure of `network` on frames (None: all); 0 if it is undefined, as without targets."""
    value = compute_measure(task, as_measurable(task).outcomes(network, data, data.numbers(frames)))
    return 0.0 if np.isnan(value) else value


def compute_interval(task: Task, outcomes: Outcomes, seed: int = 0) -> tuple[float | None, float | None]:
    """Return low and high of the measure's 95 % bootstrap interval over scenes.

    Both are None if the measure is defined on fewer than two scenes.
    """
    measurable = as_measurable(task)
    counted = [scene for scene in np.unique(outcomes.scene) if not np.isnan(_alone(measurable, outcomes, scene))]
    if len(counted) < 2:
        return None, None
    rng = stream(seed, "bootstrap")
    return _known(
        bootstrap_over_scenes(
            lambda times: measurable.measure(outcomes, times), outcomes.scene, measurable.redraws, rng=rng
        )
    )


def difference(
    task: Task, before: Outcomes, after: Outcomes, seed: int = 0, measure: Measure | None = None
) -> tuple[float, float | None, float | None]:
    """Return measure(after) - measure(before) and its paired 95 % bootstrap interval over scenes (low, high).

    `measure` is by default the task's. Both are computed on the same bootstrap samples. Low and high are None for a
    single scene. Raises `InputError` if the outcomes are of different units.
    """
    if not np.array_equal(before.scene, after.scene):
        raise InputError("two tests are not of the same frames: there is no paired difference")
    measurable = as_measurable(task)
    of = measure or measurable.measure
    mean = count_once(of, after) - count_once(of, before)
    if len(np.unique(before.scene)) < 2:
        return mean, None, None
    rng = stream(seed, "bootstrap")

    def change(times: Times) -> Values:
        return of(after, times) - of(before, times)

    return mean, *_known(bootstrap_over_scenes(change, before.scene, measurable.redraws, rng=rng))


@dataclass(frozen=True)
class NetworkComparison(Record):
    """Paired comparison of two networks on the same frames: the second minus the first."""

    task: str
    measure: str
    frames: int
    scenes: int
    first: float  # the first network's measure
    second: float
    difference: Estimate  # with its interval over scenes (95 %, bootstrap); without one for a single scene
    verdict: str  # of the claim that the second network is better on such frames
    targets: Annotated[str, WHERE_TRUE] = ""  # of both networks, in words, where theirs differ

    def lines(self) -> list[str]:
        """Return the comparison in words."""
        change = self.difference
        interval = "no interval" if change.low is None else f"{change.low:+.3f} to {change.high:+.3f}"
        over = f"{plural(self.frames, 'frame')} of {plural(self.scenes, 'scene')}"
        both = f"{self.measure} of {self.task}: {self.first:.3f} -> {self.second:.3f}, {change.mean:+.3f}"
        return [
            f"{both} ({interval}) over {over}: {self.verdict}",
            *([f"on what both look for: {self.targets}"] if self.targets else ()),
            "of these two networks; other trainings of the same settings differ besides",
        ]


def compare_outcomes(
    task: Task, first: Outcomes, second: Outcomes, frames: int, targets: str = ""
) -> NetworkComparison:
    """Return the comparison of two networks given their outcomes; `targets` as in `NetworkComparison`.

    Raises `InputError` where their targets differ, or there are none.
    """
    measurable = as_measurable(task)
    wanted = [(sorted(outcomes.arrays), measurable.numbers(outcomes).get("targets")) for outcomes in (first, second)]
    if wanted[0] != wanted[1]:
        targets = " and ".join(f"{count or 0:.0f}" for _, count in wanted)
        raise InputError(
            f"the networks look for different things, by their classes or ranges ({targets} targets in these frames), "
            "so that there is no paired difference"
        )
    before, after = compute_measure(task, first), compute_measure(task, second)
    if np.isnan([before, after]).any():
        raise InputError(f"the {plural(frames, 'frame')} hold nothing to find for '{task.name}'")
    change, scenes = Estimate(*difference(task, first, second)), len(np.unique(first.scene))
    decided = verdict(change.low, change.high)
    return NetworkComparison(
        task.name, measurable.measure_name, frames, scenes, before, after, change, decided, targets
    )


def share_test_scenes(
    task: Task,
    seeds: Sequence[Sequence[Outcomes]],
    number: Callable[[Sequence[Values]], Values],
    seed: int = 0,
    measure: Measure | None = None,
) -> SharedScenes:
    """Return the spread of a mean over seeds, given that several seeds share test scenes: see `flcav.statistics`.

    Each seed has one or several tests of the same frames. `number` computes the seed's value from their measures, such
    as the difference of two. `measure` is by default the task's.
    """
    measurable = as_measurable(task)
    of = measure or measurable.measure

    def of_seed(tests: Sequence[Outcomes]) -> Callable[[Times], Values]:
        return lambda times: number([of(outcomes, times) for outcomes in tests])

    measures = [of_seed(tests) for tests in seeds]
    scenes = [tests[0].scene for tests in seeds]
    return share_scenes(measures, scenes, measurable.redraws, rng=stream(seed, "bootstrap"))


def weighted_mean(values: Array, times: Times) -> Values:
    """Return (n,) means of values (N,) weighted by `times` (n, N); NaN where all weights are 0."""
    with np.errstate(invalid="ignore"):
        return times @ values / times.sum(axis=1)


def _alone(measurable: Measurable, outcomes: Outcomes, scene: str) -> float:
    return float(measurable.measure(outcomes, (outcomes.scene == scene).astype(np.int64)[None])[0])


def _known(interval: tuple[float, float]) -> tuple[float | None, float | None]:
    low, high = (None if np.isnan(end) else end for end in interval)
    return low, high

"""What a network did on test frames, kept so that frames can be counted again: measures, intervals, paired differences.

A task says in its `outcomes.py` what is kept of a frame, a picture or a road user, and how its measure follows from it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import nn

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.files import atomic_path
from flcav.intervals import REDRAWS, over_scenes
from flcav.perception.task import Task
from flcav.progress import Report, silent
from flcav.seeds import stream

SCENE = "scene"
Times = NDArray[np.int64]  # (n, N) how often each unit counts in each of n redrawings
Values = NDArray[np.float64]  # (n,) NaN where nothing is to be measured


@dataclass(frozen=True)
class Outcomes:
    """What a network did with N units, each one scene's: frames, pictures or road users, as the task has them."""

    scene: NDArray[np.str_]  # (N,)
    arrays: Mapping[str, NDArray]  # the task's own

    def save(self, path: Path) -> None:
        """Write them as NumPy's archive, atomically."""
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{SCENE: self.scene}, **self.arrays)

    @classmethod
    def load(cls, path: Path) -> "Outcomes":
        """Read what `save` wrote; raises `InputError` where `path` is no such file."""
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            return cls(arrays.pop(SCENE), arrays)
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{path}: no outcomes of a test ({error})") from None


@runtime_checkable
class Measurable(Protocol):
    """A task whose measure follows from outcomes, so that it has intervals over scenes."""

    @property
    def measure_name(self) -> str:
        """Return what the measure is, in the field's words; it lies in [0, 1], more is better."""
        ...

    @property
    def redraws(self) -> int:
        """Return how many redrawings of the scenes there is time for."""
        ...

    def outcomes(self, network: nn.Module, data: Dataset, frames: Sequence[int], progress: Report = silent) -> Outcomes:
        """Return what `network` does in the frames; raises `InputError` where there is nothing to measure."""
        ...

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the measure where each unit counts so many times."""
        ...

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return more numbers, by name; None where one is not known."""
        ...


class SceneScores:
    """The measure of a task that keeps no outcomes: the mean over scenes of its score."""

    measure_name = "mean score of a scene"
    redraws = REDRAWS

    def __init__(self, task: Task) -> None:
        self._task = task

    def outcomes(self, network: nn.Module, data: Dataset, frames: Sequence[int], progress: Report = silent) -> Outcomes:
        """Return the score of each scene."""
        scenes = list(dict.fromkeys(data.keys[i].scene for i in frames))
        scores = []
        for done, scene in enumerate(scenes, start=1):
            own = [i for i in frames if data.keys[i].scene == scene]
            scores.append(self._task.evaluate(network, data, own).score)
            progress(done, len(scenes), "")
        return Outcomes(np.array(scenes), {"score": np.array(scores, dtype=np.float64)})

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the mean score."""
        return weighted_mean(outcomes.arrays["score"], times)

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return none."""
        return {}


def measurable(task: Task) -> Measurable:
    """Return how the task is measured."""
    return task if isinstance(task, Measurable) else SceneScores(task)


def measured(task: Task, outcomes: Outcomes) -> float:
    """Return the task's measure, each unit counted once; NaN where there was nothing to find."""
    return float(measurable(task).measure(outcomes, np.ones((1, len(outcomes.scene)), dtype=np.int64))[0])


def score_on(task: Task, network: nn.Module, data: Dataset, frames: Sequence[int] | None = None) -> float:
    """Return the measure of `network` on frames (None: all); 0 where there was nothing to find."""
    found = measured(task, measurable(task).outcomes(network, data, data.numbers(frames)))
    return 0.0 if np.isnan(found) else found


def interval(task: Task, outcomes: Outcomes, seed: int = 0) -> tuple[float | None, float | None]:
    """Return the 95 % interval of the measure over scenes; None where fewer than two hold something to measure."""
    own = measurable(task)
    counted = [scene for scene in np.unique(outcomes.scene) if not np.isnan(_alone(own, outcomes, scene))]
    if len(counted) < 2:
        return None, None
    rng = stream(seed, "bootstrap")
    return _known(over_scenes(lambda times: own.measure(outcomes, times), outcomes.scene, own.redraws, rng=rng))


def difference(
    task: Task, before: Outcomes, after: Outcomes, seed: int = 0
) -> tuple[float, float | None, float | None]:
    """Return measure(after) - measure(before) and its 95 % interval, both on the same redrawn scenes.

    Raises `InputError` where they are not of the same units.
    """
    if not np.array_equal(before.scene, after.scene):
        raise InputError("two tests are not of the same frames: there is no paired difference")
    own = measurable(task)
    mean = measured(task, after) - measured(task, before)
    if len(np.unique(before.scene)) < 2:
        return mean, None, None
    rng = stream(seed, "bootstrap")

    def change(times: Times) -> Values:
        return own.measure(after, times) - own.measure(before, times)

    return mean, *_known(over_scenes(change, before.scene, own.redraws, rng=rng))


def weighted_mean(values: NDArray[np.float64], times: Times) -> Values:
    """Return (n,) the means of values (N,) that count `times` (n, N); NaN where none does."""
    with np.errstate(invalid="ignore"):
        return times @ values / times.sum(axis=1)


def _alone(own: Measurable, outcomes: Outcomes, scene: str) -> float:
    return float(own.measure(outcomes, (outcomes.scene == scene).astype(np.int64)[None])[0])


def _known(interval: tuple[float, float]) -> tuple[float | None, float | None]:
    low, high = (None if np.isnan(end) else end for end in interval)
    return low, high

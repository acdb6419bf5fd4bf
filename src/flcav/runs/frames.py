"""Data splits of a run: recorded in a town, or taken by scenes from a recorded dataset."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import InputError, shorten
from flcav.dataset.layout import read_manifest
from flcav.dataset.recording.recorder import open_source, record
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report
from flcav.perception.agents import POLE, kind_of
from flcav.perception.client import as_shared
from flcav.perception.tasks import task_named
from flcav.runs.recipe import SPLITS_OF, Role, RunRecipe, SplitName, find_path
from flcav.runs.results.saved import Saved
from flcav.sources.recipe import Recipe, parse_recipe
from flcav.statistics.streams import derive_seed, stream
from flcav.storage.files import sha256
from flcav.world.map.town import PACKAGED

DATA = "data"
SLACK_S = 1e-6  # tolerance of times that are compared with the ends of a window [s]
SHORTEST_S = 10.0  # shortest scene for trajectories [s]: it must hold a past, a future, and several presents
SHARES: Mapping[Role, Mapping[SplitName, float]] = {  # fractions of a dataset's scenes
    "pretrain": {"pool": 0.7, "validation": 0.15, "test": 0.15},
    "federate": {"validation": 0.15, "registry": 0.2, "edge": 0.4, "test": 0.25},
    "unseen": {"validation": 0.3, "test": 0.7},
}


@dataclass(frozen=True)
class Recorded(Saved):
    """A data split on disk: the folder of its dataset, and its frames by agent."""

    folder: str  # relative to the step's folder, or absolute
    vehicles: tuple[int, ...]  # frame numbers of all vehicles, without those of windows around them
    poles: Mapping[int, tuple[int, ...]]  # frame numbers of the roadside sensors, by pole
    scenes: int


@dataclass(frozen=True)
class Frames:
    """A data split, open for reading, with its frames by agent."""

    data: Dataset
    vehicles: tuple[int, ...]  # frame numbers of all vehicles, without those of windows around them
    poles: Mapping[int, tuple[int, ...]]  # frame numbers of the roadside sensors, by pole

    @classmethod
    def open(cls, folder: Path) -> "Frames":
        """Return the split that a step recorded in `folder`."""
        recorded = Recorded.load(folder)
        return cls(Dataset.open(folder / recorded.folder), recorded.vehicles, recorded.poles)


def make_recording_recipe(
    recipe: RunRecipe, region: str, split: SplitName, task: str, name: str, window: Mapping[str, float] = {}
) -> Recipe:
    """Return the recording recipe of a split in a region's town, without poles.

    Settings of the task, the run, the region, and the run's entry of the task override one another in this order.
    `window`: fields of `Recipe` for what is recorded for labels: further spins around the frames, and navigation logs,
    for which vehicles without a GNSS receiver or an IMU get one. Raises `InputError`, naming the recording by its
    `name`, where the settings do not go together.
    """
    place = recipe.regions[region]
    frames = getattr(recipe.sized_splits, split)
    changes = [as_shared(task_named(task)).recording, recipe.recording.fields(split), place.recording.fields(split)]
    how: dict[str, Any] = {"every_s": frames.every_s}
    for more in (*changes, recipe.tasks[task].recording.fields(split)):
        how |= more
    spins = frames.spins
    if how["every_s"] < frames.every_s:  # the same duration, sampled more often
        spins = round(max(frames.spins * frames.every_s, SHORTEST_S) / how["every_s"]) + 1
    drawn = (recipe.test_draw,) if split == "test" and recipe.test_draw else ()
    fields = {
        **how,
        "town": place.town or region,
        "split": split,
        "seed": derive_seed(recipe.seed, region, split, *drawn),
        "scenes": frames.scenes,
        "spins_per_scene": spins,
        "cavs": recipe.vehicles(region) if split == "edge" else frames.cavs,
        **window,
    }
    if fields.get("navigation_s"):
        rig = parse_recipe(fields | {"navigation_s": 0.0}, name).vehicle_rig
        fields["vehicle_rig"] = rig.with_navigation()
    return parse_recipe(fields, name)


def list_window(split: Frames, frames: Sequence[int], window_s: float) -> tuple[int, ...]:
    """Return `frames` of vehicles and what the same vehicle recorded within `window_s` [s] of one, in ascending order.

    A vehicle's frames are matched within a scene only.
    """
    middle: dict[tuple[str, str], list[float]] = {}
    for i in frames:
        middle.setdefault((split.data.keys[i].scene, split.data.keys[i].agent), []).append(split.data.keys[i].time_s)
    keys = enumerate(split.data.keys)
    return tuple(
        i
        for i, key in keys
        if any(abs(key.time_s - time_s) <= window_s + SLACK_S for time_s in middle.get((key.scene, key.agent), ()))
    )


def record_frames(recipe: Recipe, beside: Path, folder: Path, report: Report) -> Recorded:
    """Record a split below `folder`; resumes an interrupted recording."""
    record(open_source(recipe, beside), folder / DATA, progress=report)
    return group_frames(Dataset.open(folder / DATA), DATA, spins=recipe.middle_spins)


def deal_frames(path: Path, split: SplitName, role: Role, seed: int, whole: bool) -> Recorded:
    """Return one split of a recorded dataset: all frames (`whole`), or those of a random share of its scenes.

    Raises `InputError` where there are too few scenes, or no frame of a vehicle.
    """
    data = Dataset.open(path)
    if whole:
        return group_frames(data, str(path))
    scenes = sorted({key.scene for key in data.keys})
    least = len(SPLITS_OF[role]) + 1  # one per split, and two for tests
    if len(scenes) < least:
        raise InputError(f"{path}: {len(scenes)} scenes; at least {least} are wanted to deal to a region to {role}")
    order = stream(seed, "deal").permutation(len(scenes))
    return group_frames(data, str(path), {scenes[number] for number in order[_slice_split(split, role, len(scenes))]})


def count_training_frames(path: Path, seed: int, whole: bool) -> dict[str, int]:
    """Return the number of training frames by vehicle, for a federating region with the dataset at `path`.

    Raises `InputError` as `deal_frames` does.
    """
    dealt = deal_frames(path, "edge", "federate", seed, whole)
    keys = Dataset.open(path).keys
    return dict(sorted(Counter(keys[i].agent for i in dealt.vehicles).items()))


def _slice_split(split: SplitName, role: Role, scenes: int) -> slice:
    """Return the slice of the shuffled scenes that a split gets: one scene (test: two) and its share of the rest."""
    shares = SHARES[role]
    least = {name: 2 if name == "test" else 1 for name in shares}
    free = scenes - sum(least.values())
    ends = np.round(np.cumsum(list(shares.values())) * free).astype(int)
    counts = {name: least[name] + more for name, more in zip(shares, np.diff(ends, prepend=0).tolist(), strict=True)}
    names = list(shares)
    start = sum(counts[name] for name in names[: names.index(split)])
    return slice(start, start + counts[split])


def group_frames(
    data: Dataset, folder: str, scenes: set[str] | None = None, spins: Sequence[int] | None = None
) -> Recorded:
    """Group the frames of these scenes (None: all) by agent; raises `InputError` where there is none of a vehicle.

    `spins`: numbers of the spins whose frames are the vehicles' (None: all); the other spins are windows around them.
    """
    frames = data.select(scenes=scenes)
    middle = frames if spins is None else [i for i in frames if data.keys[i].index in set(spins)]
    vehicles = tuple(i for i in middle if kind_of(data.keys[i].agent) != POLE)
    if not vehicles:
        raise InputError(f"{data.folder}: no frame of a vehicle")
    poles: dict[int, list[int]] = {}
    for i in frames:
        number = data.keys[i].agent.removeprefix(POLE)
        if kind_of(data.keys[i].agent) == POLE and number.isdigit():
            poles.setdefault(int(number), []).append(i)
    count = len({data.keys[i].scene for i in frames})
    return Recorded(folder, vehicles, {pole: tuple(numbers) for pole, numbers in poles.items()}, count)


def hash_town(town: str, beside: Path) -> dict[str, str]:
    """Return the SHA-256 of the files of a user's town, by file name; empty for a town of the package.

    Raises `InputError` where there is no such town in the folder `beside`.
    """
    if town in PACKAGED:
        return {}
    folder = find_path(town, beside)
    if folder is None:
        raise InputError(
            f"region's town {shorten(town)}: none of flcav, and there is no folder of that name in {beside}"
        )
    return {path.name: sha256(path) for path in sorted(folder.iterdir()) if path.is_file()}


def hash_manifest(path: Path) -> str:
    """Return the SHA-256 of a dataset's manifest, which names its version; raises `InputError` where there is none."""
    read_manifest(path)
    return sha256(path / "manifest.json")


class Joined(Sequence[Any]):
    """The concatenation of several sequences of samples, which are read on access."""

    def __init__(self, parts: Sequence[Sequence[Any]]) -> None:
        self._places = [(part, place) for part in parts for place in range(len(part))]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [part[place] for part, place in self._places[index]]
        part, place = self._places[index]
        return part[place]

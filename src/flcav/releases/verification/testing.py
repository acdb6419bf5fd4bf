"""Tests of a network on recorded frames: its detections in every condition, and the ground truth.

A condition changes a recorded frame as a degraded sensor would: noise on points, lost returns, a misaligned mount, late
detections. The targets stay the same.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, pose
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.processes import process_pool
from flcav.perception.agents import choose_frames, frame_reader
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_frames
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth
from flcav.perception.weights import load_network
from flcav.sensors.frame import Frame
from flcav.statistics.streams import stream

NOISE_M = 0.05  # standard deviation per coordinate [m]
DROPPED = 0.5  # share of lost returns
TURNED_RAD = (0.01, 0.005)  # yaw and pitch of the LiDAR [rad], unknown to the vehicle
LIFTED_M = 0.05  # height error of the LiDAR [m]
LATE_S = 0.2  # latency from the spin to the use of detections [s]

PLAIN = "plain"
Condition = Callable[[Frame], Frame]
Points = NDArray[np.float32]


def add_range_noise(frame: Frame) -> Frame:
    """Return the frame with Gaussian noise on the coordinates of its points."""
    rng = stream(0, "noise", frame.key)

    def noisy(points: Points) -> Points:
        shifted = points.copy()
        shifted[:, :3] += rng.normal(0, NOISE_M, (len(points), 3))
        return shifted

    return _change(frame, noisy)


def drop_returns(frame: Frame) -> Frame:
    """Return the frame without a random share of its returns."""
    rng = stream(0, "drop-out", frame.key)
    return _change(frame, lambda points: points[rng.random(len(points)) >= DROPPED])


def turn_mount(frame: Frame) -> Frame:
    """Return the frame with points of a LiDAR that was turned and lifted, unknown to the vehicle."""
    seen = inverse(pose(0, 0, LIFTED_M, *TURNED_RAD))

    def turned(points: Points) -> Points:
        out = points.copy()
        out[:, :3] = points[:, :3] @ seen[:3, :3].T + seen[:3, 3]
        return out

    return _change(frame, turned)


def move_on(frame: Frame) -> Frame:
    """Return the frame with its objects moved by their velocities to the time at which late detections are used."""
    known = frame.annotations
    velocity = np.nan_to_num(known.velocity)
    boxes = replace(known.boxes, center=known.boxes.center + LATE_S * velocity)
    return replace(frame, annotations=replace(known, boxes=boxes))


CONDITIONS: Mapping[str, Condition] = {
    "noise": add_range_noise,
    "drop-out": drop_returns,
    "miscalibration": turn_mount,
    "latency": move_on,
}
WORDS = {
    "noise": f"{NOISE_M * 100:g} cm noise on every point",
    "drop-out": f"{DROPPED:.0%} of the returns lost",
    "miscalibration": f"LiDAR turned by {np.degrees(TURNED_RAD[0]):.1f} degrees, tilted by "
    f"{np.degrees(TURNED_RAD[1]):.1f}, lifted by {LIFTED_M * 100:g} cm",
    "latency": f"detections used {LATE_S:g} s late",
}


def _change(frame: Frame, change: Callable[[Points], Points]) -> Frame:
    return replace(frame, lidar={name: change(points) for name, points in frame.lidar.items()})


Work = tuple[Path, Sequence["VerificationFrame"], str]  # weights, frames, condition
AT_ONCE = 16  # frames per work item
SPARSE = 4  # every fourth frame is tested in the further conditions


@dataclass(frozen=True)
class VerificationFrame:
    """A test frame: its number in a dataset, and properties of its scene."""

    data: Path
    number: int
    town: str
    scenario: str
    cell: str = ""  # of the operational design domain; "" if unknown


@dataclass(frozen=True)
class ConditionResults:
    """The results of a network in one condition, frame by frame."""

    frames: tuple[VerificationFrame, ...]
    detections: tuple[Boxes, ...]  # LiDAR frame
    truths: tuple[FrameTruth, ...]  # with scenes named DATASET/SCENE


def choose_test_frames(
    folders: Sequence[Path], network: Second, most: int | None = None
) -> tuple[VerificationFrame, ...]:
    """Return the frames of datasets whose sensors fit the network, at most `most` per dataset, evenly spaced.

    Raises `InputError` where a dataset has no labels, none fits, or one is given twice.
    """
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("a dataset is given twice: its frames would count twice")
    chosen = []
    for folder in folders:
        data = Dataset.open(folder)
        data.check_labelled("objects")
        numbers = choose_frames(OBJECTS, network.config, data).frames
        step = 1 if most is None else max(1, -(-len(numbers) // most))
        recipe = data.manifest.recipe
        scenarios = recipe.get("scenarios")
        listed = scenarios if isinstance(scenarios, Sequence) and not isinstance(scenarios, str) else ()
        kinds = [str(each["kind"]) for each in listed if isinstance(each, Mapping) and "kind" in each]
        town = str(recipe.get("town", data.manifest.imported or "unknown"))
        scenario = ", ".join(dict.fromkeys(kinds)) or "everyday traffic"
        chosen += [VerificationFrame(folder, number, town, scenario) for number in numbers[::step]]
    return tuple(chosen)


def run_condition(
    network: Second, frames: Sequence[VerificationFrame], condition: str, progress: Report = ignore_progress
) -> ConditionResults:
    """Return the results of a network on frames in a condition, one of `CONDITIONS` or `PLAIN`."""
    opened: dict[Path, Dataset] = {}
    change = CONDITIONS.get(condition)

    def read(each: VerificationFrame) -> Frame:
        data = opened.get(each.data) or opened.setdefault(each.data, Dataset.open(each.data, checked=False))
        frame = frame_reader(data, network.config.foreground)(each.number)
        return frame if change is None else change(frame)

    found, truths = detect_frames(network, map(read, frames), total=len(frames), progress=progress)
    named = [replace(truth, scene=f"{each.data}/{truth.scene}") for truth, each in zip(truths, frames, strict=True)]
    return ConditionResults(tuple(frames), tuple(found), tuple(named))


def run_tests(
    networks: Sequence[Path],
    frames: Sequence[VerificationFrame],
    conditions: Sequence[str] = (PLAIN, *CONDITIONS),
    jobs: int = 1,
    progress: Report = ignore_progress,
) -> list[dict[str, ConditionResults]]:
    """Return the results of networks (files of weights) by condition; all but `PLAIN` on every fourth frame."""
    works = [
        (path, part, name)
        for path in networks
        for name in conditions
        for part in _split(frames if name == PLAIN else frames[::SPARSE])
    ]
    if jobs == 1:
        return _collect(networks, works, (_run(*work) for work in works), progress)
    with process_pool(jobs, _nothing) as pool:
        waiting = [pool.submit(_run, *work) for work in works]
        return _collect(networks, works, (each.result() for each in waiting), progress)


def _run(weights: Path, frames: Sequence[VerificationFrame], condition: str) -> ConditionResults:
    return run_condition(load_network(OBJECTS, weights), frames, condition)


def _collect(
    networks: Sequence[Path], works: Sequence[Work], parts: Iterable[ConditionResults], progress: Report
) -> list[dict[str, ConditionResults]]:
    """Return the results per network by condition, from those of the work items."""
    results: list[dict[str, list[ConditionResults]]] = [{} for _ in networks]
    for done, (part, (path, _, name)) in enumerate(zip(parts, works, strict=True), start=1):
        results[networks.index(path)].setdefault(name, []).append(part)
        progress(done, len(works), "")
    return [{name: _join(pieces) for name, pieces in each.items()} for each in results]


def _split(frames: Sequence[VerificationFrame]) -> list[Sequence[VerificationFrame]]:
    return [frames[start : start + AT_ONCE] for start in range(0, len(frames), AT_ONCE)]


def _join(parts: Sequence[ConditionResults]) -> ConditionResults:
    """Return the results of several parts of the frames as one."""
    return ConditionResults(
        *(tuple(chain.from_iterable(getattr(each, field.name) for each in parts)) for field in fields(ConditionResults))
    )


def _nothing() -> None:
    """Initialise a worker process."""

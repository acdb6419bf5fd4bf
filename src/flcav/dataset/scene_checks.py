"""Checks over several frames: blocked LiDARs, empty boxes, motion against velocity, and duplicated sweeps."""

import contextlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from flcav.config import InputError
from flcav.dataset.layout import FILES, payload_path, read_manifest, table_path
from flcav.dataset.payloads import POINTS
from flcav.dataset.tables import read_table
from flcav.geometry import Array, Boxes, count_points_in_boxes, inverse, points_in_boxes, transform_points
from flcav.interface.wording import plural
from flcav.sensors.frame import Frame
from flcav.world.trace import Trace

CLOSE_M = 1.0  # points closer to the LiDAR are from its mount or an obstruction
MOST, ALMOST_ALL = 0.5, 0.95  # shares of close points above which the view is blocked, or almost entirely so
LONGEST_STEP_S = 1.0  # longer steps are skipped: the velocities at both ends do not predict the motion
DRIFT_M, DRIFT_MPS = 0.3, 2.5  # tolerance of a position predicted from velocities: constant, and per second
NEAR_M = 40.0  # distance up to which every LiDAR has points of a box
BEYOND_M, OUT_OF_REACH_M = 250.0, 1000.0  # beyond it no LiDAR has points of a car; no LiDAR measures as far
NEAR_SIZES = 10.0  # the same for smaller boxes, in lengths of their longest side
LIFT_M = 0.2  # height of a box's lower part, whose points may be the ground's [m]
HIDDEN = 0.5  # occlusion above which a box may be empty
LOW_M, CLEAR_M = 0.5, 3.0  # height above the ground, and distance from the vehicle, of points that are compared
SHARED_M, CELL_M = 30.0, 0.5  # half of the square that two vehicles share, and its cells
SHIFT_M = 8.0  # largest shift that is looked for
FEWEST_POINTS, FEWEST_CELLS = 200, 30  # of a vehicle in the square, and that coincide
APART_M, CONTRADICT, MOST_PAIRS = 2.0, 0.2, 50  # shift that is a contradiction, share of such; pairs compared
SECTOR_DEG = 2.0  # width of the azimuth sectors for which a LiDAR's range is determined
FEWEST_BOXES, FEWEST_OBJECTS = 5, 3  # boxes, and different objects among them, from which a share is judged
FEWEST_FILLED = 0.2  # share of boxes with points below which labels and points are not in one frame
CHECK = "check the units and the order of angles, the units of lengths, and the frames"


class BlockedViews:
    """Detector of blocked LiDARs: counts the points close to each LiDAR over all frames of a dataset."""

    def __init__(self) -> None:
        self._points: Counter[tuple[str, str]] = Counter()  # by agent and LiDAR
        self._close: Counter[tuple[str, str]] = Counter()

    def add(self, frame: Frame) -> None:
        """Add the points of a frame to the counts."""
        for name, points in frame.lidar.items():
            with np.errstate(invalid="ignore"):  # signalling NaNs, which `check_values` reports
                close = np.linalg.norm(points[:, :3].astype(np.float64), axis=1) < CLOSE_M
            self._points[frame.agent, name] += len(points)
            self._close[frame.agent, name] += int(close.sum())

    def problems(self) -> Iterator[str]:
        """Yield a sentence for each LiDAR of whose points more than the share MOST is closer than CLOSE_M."""
        for (agent, name), count in self._points.items():
            share = self._close[agent, name] / max(count, 1)
            counts = f"{share:.1%} of its {plural(count, 'point')} lie within {CLOSE_M:g} m of it"
            if share >= ALMOST_ALL:
                yield f"{agent}: '{name}' sees almost nothing but its own mount: {counts}"
            elif share > MOST:
                yield f"{agent}: the view of '{name}' is blocked: {counts}"


@dataclass
class _Tally:
    """Counts of boxes, of an agent or of all."""

    boxes: int = 0
    far: int = 0  # out of reach of any LiDAR
    near: int = 0  # boxes that a LiDAR must have points of
    empty: int = 0  # near boxes without a point
    objects: set[tuple[str, str]] = field(default_factory=set)  # scene and track of the empty ones
    first: str = ""  # track and frame of the first empty or far one
    judged: Counter[bool] = field(default_factory=Counter)  # near or beyond all LiDARs, by: at a height with beams
    filled: Counter[bool] = field(default_factory=Counter)  # those of them with points
    bare: set[tuple[str, str]] = field(default_factory=set)  # scene and track of the others

    def problem(self) -> str:
        """Return what is wrong with most of the boxes; "" where nothing is."""
        if self.boxes >= FEWEST_BOXES and self.far > MOST * self.boxes:
            return (
                f"{self.far} of {self.boxes} boxes are more than {OUT_OF_REACH_M:g} m from the LiDARs, as {self.first} "
                "is: boxes and poses are not in one frame, or not in metres"
            )
        if self.near >= FEWEST_BOXES and len(self.objects) >= FEWEST_OBJECTS and self.empty > MOST * self.near:
            return (
                f"{self.empty} of {self.near} boxes within {NEAR_M:g} m in view of the LiDARs have no points "
                f"above the ground, as {self.first} has none: boxes, poses and points do not fit together; {CHECK}"
            )
        return ""

    def refusal(self) -> str:
        """Return that hardly any box has points, whether something hides it or not; "" where more have."""
        few = all(self.filled[kind] < FEWEST_FILLED * count for kind, count in self.judged.items() if kind)
        boxes, full = self.judged.total(), self.filled.total()
        if boxes < FEWEST_BOXES or len(self.bare) < FEWEST_OBJECTS or not few or full >= FEWEST_FILLED * boxes:
            return ""
        return (
            f"{full} of {boxes} boxes within {NEAR_M:g} m of the LiDARs, or more than {BEYOND_M:g} m away, have points "
            f"above the ground: labels and points are not in one frame; {CHECK}"
        )


class EmptyBoxes:
    """Detector of misplaced boxes: counts the near ones without points over all frames.

    A box counts within NEAR_M of a LiDAR that measures farther in its direction and has beams at its height, unless it
    is known to be occluded. Few correct boxes are empty, with any LiDAR and in any weather; of wrong ones most are.
    """

    def __init__(self) -> None:
        self._tallies: dict[str, _Tally] = defaultdict(_Tally)  # by agent
        self._all = _Tally()

    def add(self, frame: Frame) -> None:
        """Add the boxes of a frame to the counts; a frame with points or boxes that are not finite is skipped."""
        clouds = [(cloud, frame.world_from_sensor(name)) for name, cloud in frame.lidar.items()]
        truth = frame.annotations
        self.count(truth.boxes, clouds, truth.track, truth.occlusion, frame.agent, frame.scene, str(frame.key))

    def count(
        self,
        boxes: Boxes,
        clouds: Sequence[tuple[NDArray[np.float32], Array]],
        track: NDArray[np.str_],
        occlusion: Array,
        agent: str,
        scene: str,
        key: str,
    ) -> None:
        """Add M boxes to the counts of an agent, with the tracks and occlusions (M,) of their objects.

        Each cloud has points (N, 4) x, y, z [m], intensity, and the pose (4, 4) [m] of its LiDAR in the boxes' frame.
        """
        if not len(boxes) or not np.isfinite(boxes.array()).all():
            return
        near, beamed = np.zeros((2, len(boxes)), bool)
        away = np.full(len(boxes), np.inf)
        points = np.zeros(len(boxes), np.int64)
        raised = _raise_floors(boxes)
        for cloud, world_from_lidar in clouds:
            if not len(cloud) or not np.isfinite(cloud).all() or not np.isfinite(world_from_lidar).all():
                continue
            local = raised.transform(inverse(world_from_lidar))
            x, y, z = local.center.T
            away = np.minimum(away, np.hypot(np.hypot(x, y), z))  # of implausible numbers, too
            level = _have_beams(local, cloud)
            beamed |= level
            near |= level & _are_in_view(local, cloud)
            points += count_points_in_boxes(cloud, raised, world_from_lidar)
        hidden = occlusion > HIDDEN
        near &= ~hidden
        far = (away > OUT_OF_REACH_M) & np.isfinite(away)
        empty = near & (points == 0)
        for tally in (self._all, self._tallies[agent]):
            tally.boxes += int(np.isfinite(away).sum())
            tally.far += int(far.sum())
            tally.near += int(near.sum())
            tally.empty += int(empty.sum())
            judged = ((away <= NEAR_M) | (away > BEYOND_M)) & np.isfinite(away) & ~hidden
            tally.judged.update(beamed[judged].tolist())
            tally.filled.update(beamed[judged & (points > 0)].tolist())
            tally.bare |= {(scene, name) for name in track[judged & (points == 0)].tolist()}
            named = track[empty | far].tolist()
            tally.objects |= {(scene, name) for name in named}
            tally.first = tally.first or (f"'{named[0]}' in {key}" if named else "")

    def refuse(self, folder: Path) -> None:
        """Raise `InputError` where fewer than one in five boxes have points, of all or of an agent's."""
        if refusal := self._all.refusal():
            raise InputError(f"{folder}: {refusal}")
        for agent, tally in self._tallies.items():
            if refusal := tally.refusal():
                raise InputError(f"{folder}: {agent}: {refusal}")

    def problems(self) -> Iterator[str]:
        """Yield a sentence where most boxes of all agents are wrong, else one for every agent of which most are."""
        if problem := self._all.problem():
            yield problem
            return
        yield from (f"{agent}: {problem}" for agent, tally in self._tallies.items() if (problem := tally.problem()))


def _raise_floors(boxes: Boxes) -> Boxes:
    """Return the boxes without their lowest LIFT_M."""
    lift = np.minimum(LIFT_M, boxes.size[:, 2] / 2)
    up = np.zeros_like(boxes.center)
    up[:, 2] = lift
    return replace(boxes, center=boxes.center + up / 2, size=boxes.size - up)


def _are_in_view(boxes: Boxes, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the mask (M,) of boxes in the LiDAR's frame near it, with `points` (N, 4) returned from beyond them.

    Returns from beyond are in the same direction, at any height.
    """
    x, y = points[:, :2].T.astype(np.float64)
    away = np.hypot(*boxes.center[:, :2].T)
    sectors = round(360 / SECTOR_DEG)

    def sector(ahead: Array, left: Array) -> NDArray[np.int64]:
        return np.floor(np.degrees(np.arctan2(left, ahead)) / SECTOR_DEG).astype(np.int64) % sectors

    reach = np.zeros(sectors)
    np.maximum.at(reach, sector(x, y), np.hypot(x, y))
    beyond = reach[sector(*boxes.center[:, :2].T)] > away + np.linalg.norm(boxes.size, axis=1) / 2
    return beyond & (away <= np.minimum(NEAR_M, NEAR_SIZES * boxes.size.max(axis=1)))


def _have_beams(boxes: Boxes, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the mask (M,) of boxes in the LiDAR's frame that are at a height with beams, by its `points`."""
    x, y, z = points[:, :3].T.astype(np.float64)
    slopes = np.sort(z / np.maximum(np.hypot(x, y), 1e-9))
    away, half = np.hypot(*boxes.center[:, :2].T), boxes.size[:, 2] / 2
    low, high = (
        np.searchsorted(slopes, (boxes.center[:, 2] + side) / np.maximum(away, 1e-9)) for side in (-half, half)
    )
    return (low < high) | (low == len(slopes))


@dataclass
class SharedPoints:
    """Detector of poses that contradict each other: static points that two vehicles see at once lie metres apart.

    Points above the ground and outside labelled boxes are compared, as occupied cells of the world's plane between the
    vehicles: it is counted whether another shift than none lets twice as many cells coincide.
    """

    pairs: int = 0  # of vehicles that see the same at one time
    apart: list[tuple[float, str]] = field(default_factory=list)  # shift [m] and frames of pairs that contradict
    _spin: list[Frame] = field(default_factory=list)  # the frames so far of the latest spin
    _static: dict[str, Array] = field(default_factory=dict)  # their points (N, 2), of those that were compared

    def add(self, frame: Frame) -> None:
        """Compare a frame with the others of its spin, which come before it."""
        if self._spin and (frame.scene, frame.index) != (self._spin[0].scene, self._spin[0].index):
            self._spin, self._static = [], {}
        for other in self._spin if self.pairs < MOST_PAIRS else ():
            places = frame.world_from_agent[:2, 3], other.world_from_agent[:2, 3]
            if np.linalg.norm(places[0] - places[1]) < NEAR_M:
                middle = (places[0] + places[1]) / 2
                one, two = (
                    points[np.abs(points).max(axis=1) < SHARED_M]
                    for points in (self._find(each) - middle for each in (frame, other))
                )
                if min(len(one), len(two)) >= FEWEST_POINTS:
                    self.pairs += 1
                    if (shift_m := _find_shift(one, two)) >= APART_M:
                        self.apart.append((shift_m, f"{other.key} and {frame.key}"))
        self._spin.append(frame)

    def _find(self, frame: Frame) -> Array:
        if frame.agent not in self._static:
            self._static[frame.agent] = _find_static(frame)
        return self._static[frame.agent]

    def refuse(self, folder: Path) -> None:
        """Raise `InputError` where many pairs contradict each other; those of two vehicles wrong alike do not."""
        if len(self.apart) > max(1, CONTRADICT * self.pairs):
            shift_m, where = self.apart[0]
            raise InputError(
                f"{folder}: the static points of two vehicles lie metres apart in {len(self.apart)} of {self.pairs} "
                f"pairs of frames, first {shift_m:.1f} m in {where}: their poses do not fit together; {CHECK}"
            )


def _find_static(frame: Frame) -> Array:
    """Return the points (N, 2) [m, world] of a frame that are above the ground and in no labelled box."""
    found = [np.zeros((0, 2))]
    for name, cloud in frame.lidar.items():
        if np.isfinite(cloud).all():
            local = transform_points(frame.agent_from_sensor[name], cloud[:, :3])
            high = local[(local[:, 2] > LOW_M) & (np.hypot(*local[:, :2].T) > CLEAR_M)]
            world = transform_points(frame.world_from_agent, high)
            boxed = points_in_boxes(world, frame.annotations.boxes, LOW_M).any(axis=0)
            found.append(world[~boxed, :2])
    return np.concatenate(found)


def _find_shift(one: Array, other: Array) -> float:
    """Return the shift [m] by which twice as many cells of two sets of points (N, 2) [m] coincide as by none, or 0."""
    edges = np.arange(-SHARED_M, SHARED_M + CELL_M, CELL_M)
    grids = [np.histogram2d(*points.T, bins=edges)[0] > 0 for points in (one, other)]
    wide = np.lib.stride_tricks.sliding_window_view(np.pad(grids[0], 1), (3, 3)).any(axis=(2, 3))
    most = round(SHIFT_M / CELL_M)
    inner = grids[1][most:-most, most:-most].astype(float)
    matches = fftconvolve(wide.astype(float), inner[::-1, ::-1], mode="valid")
    best = np.unravel_index(matches.argmax(), matches.shape)
    if matches[best] < FEWEST_CELLS or matches[best] < 2 * matches[most, most]:
        return 0.0
    return float(CELL_M * np.linalg.norm(np.array(best) - most))


def check_motion(scene: str, trace: Trace) -> Iterator[str]:
    """Check that every actor moves between instants as its recorded velocities predict, by the trapezoidal rule.

    Yields one sentence for each actor that does not, about its worst step.
    """
    step_s = np.diff(trace.time_s)[:, None]
    moved = np.diff(trace.position, axis=0)
    expected = (trace.velocity[1:] + trace.velocity[:-1]) / 2 * step_s[..., None]
    away = np.linalg.norm((moved - expected)[..., :2], axis=2)
    known = (step_s <= LONGEST_STEP_S) & ~np.isnan(away)
    excess = np.where(known, away - (DRIFT_M + DRIFT_MPS * step_s), -1.0)
    for actor in np.flatnonzero(excess.max(axis=0, initial=-1.0) > 0):
        t = int(excess[:, actor].argmax())
        speeds = np.linalg.norm(trace.velocity[t : t + 2, actor], axis=1)
        yield (
            f"scene '{scene}': {trace.category[actor]} '{trace.actor[actor]}' moves "
            f"{np.linalg.norm(moved[t, actor]):.2f} m from {trace.time_s[t]:g} s to {trace.time_s[t + 1]:g} s, "
            f"at recorded speeds of {speeds[0]:.1f} and {speeds[1]:.1f} m/s"
        )


class CloudPlace(NamedTuple):
    """The place of a point cloud: its dataset, the dataset's split (empty where it has none) and the scene."""

    folder: Path
    split: str
    scene: str


def find_copies(folders: Sequence[Path]) -> list[str]:
    """Return a sentence for each two splits, of one dataset or of two, that contain the same point clouds.

    Folders that hold no complete dataset are left out: `validate` reports what they lack.
    """
    first: dict[str, CloudPlace] = {}  # by checksum
    shared: dict[tuple[tuple[Path, str], tuple[Path, str]], list[tuple[str, str]]] = defaultdict(list)
    for folder in folders:
        with contextlib.suppress(InputError):
            for digest, cloud in _list_clouds(folder):
                one = first.setdefault(digest, cloud)
                if one.split != cloud.split and one.scene != cloud.scene:  # equal scene names are reported elsewhere
                    shared[one[:2], cloud[:2]].append((one.scene, cloud.scene))
    return [
        f"{one} (split '{split}') and {other} (split '{other_split}'): leakage, they share {len(scenes)} point clouds, "
        f"the first is of the scenes '{scenes[0][0]}' and '{scenes[0][1]}'"
        for ((one, split), (other, other_split)), scenes in shared.items()
    ]


def _list_clouds(folder: Path) -> Iterator[tuple[str, CloudPlace]]:
    """Yield the checksum and the place of all point clouds of a dataset except empty ones."""
    manifest = read_manifest(folder)
    split_of = manifest.split_of
    dataset_split = str(manifest.recipe.get("split", ""))
    frames = read_table(folder / table_path("frames"), "frames").select(["key", "scene", "lidar"]).to_pylist()
    files = read_table(folder / table_path(FILES), FILES).to_pydict()
    digests = {path: digest for path, size, digest in zip(files["path"], files["bytes"], files["sha256"]) if size}
    for row in frames:
        for lidar in row["lidar"]:
            if digest := digests.get(payload_path(lidar, row["key"], POINTS)):
                yield digest, CloudPlace(folder, split_of.get(row["scene"], dataset_split), row["scene"])

"""Parts shared by readers of other formats: scenes, agents' names, and annotations that are derived from boxes.

What a format does not provide is NaN, or UNKNOWN_PIXELS. Derived are returns (the points in an object's box),
velocities from tracks, and the rectangles that boxes fill in images.
"""

import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flcav.config import InputError, Json, parse_config, shorten
from flcav.dataset.payloads import measure_upright, open_image, read_image
from flcav.dataset.store import LazyMapping
from flcav.geometry import Array, Boxes, count_points_in_boxes, inverse, is_rigid
from flcav.interface.wording import plural
from flcav.sensors.frame import UNKNOWN_PIXELS, Annotations, CameraImage, Frame, SignViews, Views
from flcav.sensors.lens import Lens
from flcav.sensors.views import outline_boxes

LONGEST_STEP_S = 1.5  # between neighbouring annotations of a track that give a velocity, as in nuscenes-devkit
FARTHEST = 1e9  # largest number that a measurement may have
LARGEST_M, SMALLEST_M = 200.0, 0.01  # longest side of an object, at most and at least
ROUNDED = 0.01  # error of a rotation of few digits: in its singular values, or in its quaternion's length
APART_M, APART_DEG = 3.0, 5.0  # difference above which two poses of one instant contradict each other
NAMED = 3  # largest number of things that a note names


class LogSource(ABC):
    """A source that reads recorded logs from a folder, with what all formats have in common.

    The traffic is known only at the frames, so that there is no trace. A reader names its format and sets the fields.
    """

    FORMAT: ClassVar[str]
    notes: tuple[str, ...] = ()  # sentences for the user on what the files lack
    contradictions: tuple[str, ...] = ()  # those of `notes` on what contradicts itself, known once frames are read
    folder: Path
    split: str | None  # the requested one
    split_of: Mapping[str, str | None]  # scene -> its split
    folders: Mapping[str, Path] = {}  # scene -> its folder, where a format has one per scene
    labelled: bool = True  # whether all frames have boxes
    beams: int | None = None  # of the LiDAR, where the format determines them
    range_m: float | None = None  # largest range of the LiDAR [m], likewise

    def describe(self) -> Mapping[str, Json]:
        """Return folder, splits and labelled kinds, and the folders of scenes that are not named after their folder."""
        folders = {scene: name_place(self.folders[scene])[1] for scene in self.split_of if scene in self.folders}
        renamed = {scene: name for scene, name in folders.items() if scene != name}
        return {
            "imported": self.FORMAT,
            "from": str(self.folder.resolve()),
            "split": self.split or "",
            "labels": ["objects"] if self.labelled else [],
            "splits": name_splits(self.split_of),
            **({"folders": renamed} if renamed else {}),
            **({} if self.beams is None else {"beams": self.beams}),
            **({} if self.range_m is None else {"range_m": self.range_m}),
        }

    def scenes(self) -> list[str]:
        """Return the names of the scenes."""
        return list(self.split_of)

    def trace(self, scene: str) -> None:
        """Return None: the traffic between frames is not known."""
        return

    @abstractmethod
    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scene."""

    @abstractmethod
    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the frames of a scene; raises `InputError` where a file is missing, truncated or malformed."""


class ImportFormat(NamedTuple):
    """A format to read: how a folder of it is opened, and the files by which it is recognised."""

    read: Callable[..., LogSource]  # folder, split (None: all); `StatedLidar` where it takes one
    signs: tuple[str, ...] = ()  # patterns of paths, at least one of which matches in a folder of this format
    takes_lidar: bool = False  # whether its files do not say how the LiDAR is mounted


@dataclass(frozen=True)
class LogPicture:
    """A camera's image file, with its projection."""

    path: Path
    lens: Lens
    world_from_camera: Array  # (4, 4) [m], optical frame


def annotate(
    track: Iterable[str],
    boxes: Boxes,
    clouds: Mapping[str, tuple[NDArray[np.float32], Array]],
    views: Mapping[str, Views],
    *,
    velocity: Array | None = None,
    occlusion: Array | None = None,
) -> Annotations:
    """Return the annotations of M objects, given their boxes; the points in an object's box are its returns.

    Args:
        track: M track ids.
        boxes: (M,) boxes, world frame.
        clouds: LiDAR -> its (N, 4) points, sensor frame, and its (4, 4) pose in the world.
        views: camera -> image annotations of the objects.
        velocity: (M, 3) world [m/s]; None: NaN, unknown.
        occlusion: (M,) for the LiDARs, 0 to 1; None: NaN, unknown.
    """
    count = len(boxes)
    points = {
        name: count_points_in_boxes(cloud, boxes, world_from_lidar)
        for name, (cloud, world_from_lidar) in clouds.items()
    }
    return Annotations(
        track=np.array(list(track), np.str_).reshape(count),
        boxes=boxes,
        velocity=np.full((count, 3), np.nan) if velocity is None else velocity,
        acceleration=np.full((count, 3), np.nan),
        returns=sum(points.values(), np.zeros(count, np.int64)),
        occlusion=np.full(count, np.nan) if occlusion is None else occlusion,
        points=points,
        views=views,
        signs={name: SignViews.none() for name in views},
    )


def difference_tracks(track: NDArray[np.str_], time_s: Array, center: Array) -> Array:
    """Return velocities (R, 3) [m/s] of R annotations, by differences of neighbouring centres (R, 3) [m] of a track.

    The first and the last annotation of a track have one neighbour. NaN where neighbours are LONGEST_STEP_S or more
    apart, and where a track has one annotation, as in nuscenes-devkit's `box_velocity`. `time_s` is (R,) [s].
    """
    order = np.lexsort((time_s, track))
    same = track[order][1:] == track[order][:-1]
    before, after = order.copy(), order.copy()
    before[1:][same], after[:-1][same] = order[:-1][same], order[1:][same]
    step = time_s[after] - time_s[before]
    sides = (before != order).astype(int) + (after != order)
    known = (step > 0) & (step <= LONGEST_STEP_S * sides)
    velocity = np.full((len(track), 3), np.nan)
    velocity[order[known]] = ((center[after] - center[before]) / np.where(known, step, 1.0)[:, None])[known]
    return velocity


def view_boxes(boxes: Boxes, pictures: Mapping[str, LogPicture]) -> dict[str, Views]:
    """Return the rectangles that `boxes` (world frame) fill in each image, with the share outside it, by camera.

    They outline the boxes rather than their contents, so that they are somewhat larger than a simulated actor's. Which
    pixels show is unknown.
    """
    corners = boxes.corners()
    return {
        name: unseen_views(*outline_boxes(corners, picture.lens, picture.world_from_camera))
        for name, picture in pictures.items()
    }


def unseen_views(amodal: Array, truncation: Array, occlusion: Array | None = None) -> Views:
    """Return views of M objects with amodal boxes (M, 4) [px] and unknown visible pixels."""
    count = len(amodal)
    return Views(
        amodal_box=amodal,
        visible_box=np.full((count, 4), np.nan),
        pixels=np.full(count, UNKNOWN_PIXELS, np.int64),
        truncation=truncation,
        occlusion=np.full(count, np.nan) if occlusion is None else occlusion,
    )


def check_cloud(points: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    """Return the points (N, 4) of the file at `path`, x, y, z [m] and intensity, unchanged.

    Raises `InputError` where one is not finite or has an intensity outside 0 to 1.
    """
    for fault, bad in (
        ("is not finite", ~np.isfinite(points).all(axis=1)),
        ("has an intensity outside 0 to 1", (points[:, 3] < 0) | (points[:, 3] > 1)),
    ):
        if bad.any():
            raise InputError(f"{path}: point {int(np.flatnonzero(bad)[0])} {fault}")
    return points


def check_sizes(size: Array, path: Path) -> None:
    """Raise `InputError` where the file at `path` labels an object with a size (M, 3) that cannot be in metres."""
    if not (size > 0).all():
        raise InputError(f"{path}: object {int((size > 0).all(axis=1).argmin()) + 1} has a size that is not positive")
    longest = size.max(axis=1)
    if (odd := (longest > LARGEST_M) | (longest < SMALLEST_M)).any():
        number = int(odd.argmax())
        raise InputError(f"{path}: object {number + 1} is {longest[number]:g} m long; sizes are wanted in metres")


def check_headings(yaw: Array, path: Path) -> None:
    """Raise `InputError` where the file at `path` labels an object with a heading (M,) [rad] beyond a full turn."""
    if (odd := np.abs(yaw) > 2 * np.pi + ROUNDED).any():
        number = int(odd.argmax())
        raise InputError(f"{path}: object {number + 1} is turned by {yaw[number]:g}; radians within a turn are wanted")


def check_rotation(rotation: Array) -> Array:
    """Return the rotation (3, 3) for a matrix of few digits; a matrix that is exact to 1e-6 is returned unchanged.

    Raises ValueError where it is no rotation: mirrored, scaled, sheared or not finite.
    """
    whole = np.eye(4)
    whole[:3, :3] = rotation
    if is_rigid(whole):
        return rotation
    if not np.isfinite(rotation).all():
        raise ValueError("has a rotation that is not finite")
    # The nearest rotation in the Frobenius norm is that of the polar decomposition.
    left, scale, right = np.linalg.svd(rotation)
    if np.abs(scale - 1).max() > ROUNDED:
        raise ValueError(
            f"has a matrix that is no rotation: it scales by {scale[0]:.3g}, {scale[1]:.3g}, {scale[2]:.3g}"
        )
    if np.linalg.det(rotation) < 0:
        raise ValueError("has a matrix that is no rotation: it mirrors")
    return left @ right


def are_unit_quaternions(quaternions: Array) -> NDArray[np.bool_]:
    """Return the mask (N,) of quaternions (N, 4) that are rotations: of length 1, except for rounding."""
    return np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= ROUNDED


class PosePairs:
    """Comparison of two poses that every frame of a format has for the same body: counts those in contradiction."""

    def __init__(self, names: str) -> None:
        """`names` denotes the two poses in a note, such as "'lidar_pose' and 'true_ego_pos'"."""
        self._names, self._frames, self._apart, self._first = names, 0, 0, ""

    def add(self, one: Array, other: Array, origin: Path, also: str = "") -> None:
        """Compare two poses (4, 4) [m] of the file `origin`; `also` is a clause on another contradiction."""
        between = inverse(one) @ other
        degrees = float(np.degrees(np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1))))
        metres = float(np.linalg.norm(between[:3, 3]))
        self._frames += 1
        if degrees > APART_DEG or metres > APART_M or also:
            self._apart += 1
            apart = f"{degrees:.1f} degrees and {metres:.1f} m apart by the mount in the agent's first frame"
            self._first = self._first or f"{origin}, where {also or f'they are {apart}'}"

    def notes(self) -> tuple[str, ...]:
        """Return a sentence on the frames in which they contradict each other; empty where there are none."""
        summary = f"{self._names} contradict each other in {self._apart} of {plural(self._frames, 'frame')}"
        return (f"{summary}, first in {self._first}",) if self._apart else ()


def group_classes(**theirs: str) -> dict[str, str]:
    """Return flcav's categories by a format's class, from the format's classes by category, separated by spaces."""
    return {name: category for category, names in theirs.items() for name in names.split()}


def name_some(names: Collection[str]) -> str:
    """Return the first NAMED of several names, and the number of the others."""
    shown = ", ".join(list(names)[:NAMED])
    return shown if len(names) <= NAMED else f"{shown} and {len(names) - NAMED} more"


def pinhole(intrinsics: Array, width: float, height: float, path: Path) -> Lens:
    """Return the lens of a camera matrix (3, 3) [px] that was read from the file at `path`.

    Raises `InputError` where the matrix, or the `width` and `height` [px], are not those of a camera.
    """
    if intrinsics.shape != (3, 3):
        raise InputError(f"{path}: a camera has no matrix of 3 x 3 numbers")
    fx, fy, cx, cy = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return parse_config(Lens, {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}, str(path))


def measure_picture(path: Path) -> tuple[int, int]:
    """Return width and height [px] of an image file, upright; raises `InputError` where it is missing or no image."""
    try:
        with open_image(path) as image:
            return measure_upright(image)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        raise InputError(f"{path}: not an image, or a truncated one") from None


def link_pictures(paths: Mapping[str, Path]) -> Mapping[str, CameraImage]:
    """Return the images by camera; each is read on first access."""
    return LazyMapping(list(paths), lambda name: CameraImage(read_image(paths[name], np.uint8, channels=3)))


class AgentNames:
    """Names of agents: a dataset has one calibration per agent, so that another calibration makes another agent.

    >>> names = AgentNames()
    >>> names.of("ego", "calibration of Monday"), names.of("ego", "of Tuesday"), names.of("ego", "of Tuesday")
    ('ego', 'ego-2', 'ego-2')
    """

    def __init__(self) -> None:
        self._known: dict[str, dict[Hashable, str]] = {}

    def of(self, vehicle: str, calibration: Hashable) -> str:
        """Return the name of the agent for a `vehicle` with this `calibration`."""
        known = self._known.setdefault(vehicle, {})
        return known.setdefault(calibration, vehicle if not known else f"{vehicle}-{len(known) + 1}")


def name_folders(folders: Sequence[Path]) -> dict[str, Path]:
    """Return folders by scene: a scene has the name of its folder, or `PARENT-NAME` where folders share a name.

    Logs of the same name in several splits are separate scenes. Raises `InputError` where two scenes have one name.
    """
    count = Counter(name_place(path)[1] for path in folders)
    named = {}
    for path in folders:
        parent, name = name_place(path)
        scene = name if count[name] == 1 else f"{parent}-{name}"
        if scene in named:
            raise InputError(f"{path}: would be the scene '{scene}', as {named[scene]} is")
        named[scene] = path
    return named


def name_place(path: Path) -> tuple[str, str]:
    """Return the names of a path's folder and of the path itself, without following links."""
    whole = Path(os.path.abspath(path))  # noqa: PTH100 - `resolve` follows links, `absolute` keeps `..`
    return whole.parent.name, whole.name


def assign_split(split_of: MutableMapping[str, str | None], scene: str, split: str | None, origin: Path) -> None:
    """Assign a scene to a split; raises `InputError` where it is in another: a scene's frames show the same cars."""
    if split_of.setdefault(scene, split) != split:
        both = " and ".join(sorted(f"'{each}'" if each else "no split" for each in (split_of[scene], split)))
        raise InputError(f"{origin}: the scene {shorten(scene)} is in {both}")


def name_splits(split_of: Mapping[str, str | None]) -> dict[str, list[str]]:
    """Return the scenes by split, given the splits by scene; scenes without a split are left out."""
    scenes: dict[str, list[str]] = {}
    for scene, split in split_of.items():
        if split is not None:
            scenes.setdefault(split, []).append(scene)
    return scenes


def choose_split(folder: Path, split_of: Mapping[str, str | None], split: str | None) -> list[str]:
    """Return the scenes of `split`, or all for None; raises `InputError` where there are none."""
    if not split_of:
        raise InputError(f"{folder}: no scenes in it")
    chosen = [scene for scene, scene_split in split_of.items() if split is None or scene_split == split]
    if not chosen:
        known = sorted({scene_split for scene_split in split_of.values() if scene_split is not None})
        raise InputError(f"{folder}: no split '{split}'; it has {', '.join(known) or 'none'}")
    return chosen

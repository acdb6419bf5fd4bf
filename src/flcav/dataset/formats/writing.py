"""Parts shared by writers of other formats: options and results of exports, splits of scenes, sensor channels."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from flcav.config import Config, InputError
from flcav.dataset.formats.reading import difference_tracks
from flcav.dataset.rectangles import select_rectangles
from flcav.dataset.store import Dataset
from flcav.geometry import Array, points_in_boxes, transform_points, wrap_angle
from flcav.interface.progress import Report
from flcav.interface.wording import plural
from flcav.sensors.frame import Frame

SPLITS = ("train", "val", "test")


class ExportOptions(Config):
    """Options of an export; `ExportFormat.options` lists those that apply to a format."""

    labels: Literal["signs", "actors"] = "signs"  # classes of a YOLO export, which has one list of classes
    validation: float = Field(default=0.2, ge=0, lt=1)  # fraction of the scenes in the validation split
    min_pixels: int = Field(default=1, ge=1)  # least visible pixels of an object with a 2D label
    min_points: int = Field(default=1, ge=0)  # least LiDAR points in the box of a labelled object
    calibration: Literal["true", "assumed"] = "true"  # which of the two calibrations of a frame is written


class LeftOut(NamedTuple):
    """A kind of data that an export did not write, with the reason."""

    what: str  # kind, in the plural as in `Exported.counts`
    why: str
    which: str = ""  # agent, spin, camera or class to which the reason applies; "" for none


@dataclass(frozen=True)
class Exported:
    """The result of an export: counts of what was written and of what was left out.

    Objects are annotated actors of frames; for formats with 2D labels, signs and actors that show in an image. Each
    object of the dataset is counted once, as written or, by the first reason that applies, as left out.
    """

    counts: Counter[str]  # kind, e.g. "frames", "objects" -> number written
    left_out: Counter[LeftOut] = field(default_factory=Counter)

    def leave_out(self, frame: Frame, why: str, which: str) -> None:
        """Count a frame and its objects as left out."""
        self.left_out.update({LeftOut("frames", why, which): 1, LeftOut("objects", why, which): len(frame.annotations)})


class ExportFormat(NamedTuple):
    """A format to write: how a dataset is written into an empty folder, and the options that apply."""

    write: Callable[[Dataset, Path, ExportOptions, Report], Exported]
    # dataset, folder, options, and callback for the frames done and in total; raises `InputError` where the dataset
    # lacks what the format needs
    options: tuple[str, ...] = ()  # fields of `ExportOptions`


def write_file(path: Path, data: bytes | str) -> None:
    """Write a file of an export, text as UTF-8, and create its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def read_frame(dataset: Dataset, i: int, options: ExportOptions) -> Frame:
    """Return frame `i` with the calibration that `options` select, true or assumed, as its `calibration`."""
    frame = dataset.frame(i)
    return frame if options.calibration == "true" else replace(frame, calibration=frame.assumed)


def count_readable_points(frame: Frame, sensor: str, points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return for each annotation (M,) the number of LiDAR or radar `points` (N, >= 3) [m, sensor frame] in its box.

    Readers of an export count in this way. `annotations.points` differ: they count the points on the actor, which may
    lie outside its box, and no points of others inside it.
    """
    world = transform_points(frame.world_from_sensor(sensor), points[:, :3].astype(np.float64))
    return points_in_boxes(world, frame.annotations.boxes).sum(axis=1)


def select_objects(
    name: str, label: NDArray[np.str_], known: Collection[str], reasons: Mapping[str, NDArray[np.bool_]]
) -> tuple[NDArray[np.bool_], Counter[LeftOut]]:
    """Return the mask (M,) of objects, of classes `label` (M,), that an export to `name` labels, and what is left out.

    Left out are objects of no class in `known`, then those to which the `reasons` apply: reason -> mask (M,).
    """
    kept = np.isin(label, [*known])
    left_out = Counter(LeftOut("objects", f"{name} has no class for them", kind) for kind in label[~kept].tolist())
    for why, applies in reasons.items():
        left_out[LeftOut("objects", why)] += int((kept & applies).sum())
        kept = kept & ~applies
    return kept, left_out


def count_unwritten(name: str, frame: Frame, written: Collection[str]) -> Counter[LeftOut]:
    """Count the measurements of a frame by sensors other than those `written` in the format `name`."""
    sensors = (*frame.lidar, *frame.images, *frame.infrared, *frame.radar, *frame.gnss, *frame.imu)
    why = f"{name} has no place for them"
    return Counter(LeftOut("measurements", why, sensor) for sensor in sensors if sensor not in written)


def lacks_points(min_points: int) -> str:
    """Return the reason why objects with fewer than `min_points` LiDAR points are left out."""
    return f"fewer than {plural(min_points, 'LiDAR point')} in the box (--min-points)"


def find_visible_objects(frame: Frame, camera: str, labels: str) -> dict[int, str]:
    """Return the classes of the signs or actors (`labels`) that show in an image, by row, with a 2D label or not."""
    truth = frame.annotations
    if labels == "actors":
        return {int(row): str(truth.boxes.label[row]) for row in np.flatnonzero(truth.views[camera].pixels)}
    signs = truth.signs[camera]
    return {int(row): f"{signs.kind[row]} {signs.state[row]}".strip() for row in np.flatnonzero(signs.pixels)}


def count_unlabelled(frame: Frame, camera: str, labels: str, min_pixels: int) -> Counter[LeftOut]:
    """Count the signs or actors (`labels`) that show in an image and that `select_rectangles` leaves out."""
    visible = find_visible_objects(frame, camera, labels)
    known = select_rectangles(frame, camera, labels, min_pixels=1)
    unknown = visible.keys() - set(known.row.tolist())
    left_out = Counter(LeftOut(labels, "there is no class for them", visible[row]) for row in sorted(unknown))
    few = f"fewer than {plural(min_pixels, 'visible pixel')} (--min-pixels)"
    left_out[LeftOut(labels, few)] += int((known.pixels < min_pixels).sum())
    return left_out


def missing_data_error(dataset: Dataset, name: str, needed: str, who: str = "the dataset") -> InputError:
    """Return the error for a dataset, or an agent (`who`), that lacks what the format `name` needs."""
    return InputError(f"{dataset.folder}: cannot be exported to {name}, which needs {needed}; {who} has none")


def check_rectified(frame: Frame, camera: str, name: str) -> None:
    """Raise `InputError` where the lens of `camera` distorts, since the format `name` needs rectified images."""
    if np.any(frame.calibration.distortion.get(camera, 0)):
        raise InputError(
            f"{frame.key}: '{camera}' distorts; {name} wants rectified images, so record without distortion"
        )


def split_scenes(dataset: Dataset, options: ExportOptions) -> Mapping[str, str]:
    """Return the split, "train", "val" or "test", by scene. Scenes are not divided: their frames show the same cars.

    A dataset whose recipe says validation or test belongs to that split entirely; raises `InputError` where a share of
    validation scenes is requested nevertheless. In any other dataset, the last scenes are the validation split: the
    requested share of them, rounded up, but never all. An imported dataset keeps its splits, if it has them for all
    scenes and no share is requested.
    """
    scenes = list(dict.fromkeys(key.scene for key in dataset.keys))
    recorded_for = str(dataset.manifest.recipe.get("split", ""))
    imported = {scene: split for scene, split in dataset.manifest.split_of.items() if split in SPLITS}
    known = {} if recorded_for or "validation" in options.model_fields_set else imported
    if known.keys() >= set(scenes):
        return {scene: known[scene] for scene in scenes}
    for split in ("val", "test"):
        if recorded_for.startswith(split):
            if "validation" in options.model_fields_set:
                raise InputError(
                    f"{dataset.folder}: its recipe says 'split: {recorded_for}', so --validation is not for it"
                )
            return dict.fromkeys(scenes, split)
    held_out = min(math.ceil(round(options.validation * len(scenes), 9)), len(scenes) - 1)
    first = len(scenes) - held_out
    return {scene: "val" if i >= first else "train" for i, scene in enumerate(scenes)}


def split_with_validation(dataset: Dataset, options: ExportOptions, name: str) -> Mapping[str, str]:
    """Return `split_scenes` for a format `name` whose readers need a validation split to train.

    Raises `InputError` where all scenes are in the training split, unless `options` ask for no validation scenes.
    """
    split_of = split_scenes(dataset, options)
    if set(split_of.values()) == {"train"} and options.validation:
        raise InputError(
            f"{dataset.folder}: cannot be exported to {name}, which needs scenes that validate beside those that "
            "train; it is one scene: record two or more, or leave the validation empty with --validation 0"
        )
    return split_of


LEVEL_RAD = np.radians(2.0)  # largest tilt of a level camera
AHEAD_RAD = np.radians(30.0)  # largest yaw of a camera that looks ahead


def optical_yaw(agent_from_camera: Array) -> float:
    """Return the yaw [rad] of a camera's optical axis (z of its optical frame), counter-clockwise from straight ahead.

    `agent_from_camera` is its extrinsics (4, 4).
    """
    return float(np.arctan2(agent_from_camera[1, 2], agent_from_camera[0, 2]))


def is_level(agent_from_camera: Array) -> bool:
    """Return whether the y axis of a camera's optical frame points down in the agent frame, to within LEVEL_RAD."""
    return bool(-agent_from_camera[2, 1] >= np.cos(LEVEL_RAD))


def find_front_camera(agent_from_camera: Mapping[str, Array]) -> str | None:
    """Return the name of the level camera with the smallest yaw; None where none is within AHEAD_RAD."""
    turned = {name: abs(optical_yaw(mount)) for name, mount in agent_from_camera.items() if is_level(mount)}
    name = min(turned, key=turned.__getitem__, default=None)
    return name if name is not None and turned[name] <= AHEAD_RAD else None


def assign_channels(yaw: Mapping[str, float], named: Mapping[str, float]) -> dict[str, str]:
    """Return the channels by sensor: the assignment with the smallest sum of angles between sensors and channels.

    `yaw` holds the directions [rad] of the sensors, `named` those of the channels. Sensors in excess of the channels
    are left out.
    """
    sensors, known = list(yaw), list(named)
    away = np.abs(wrap_angle(np.subtract.outer([yaw[name] for name in sensors], [named[name] for name in known])))
    rows, columns = linear_sum_assignment(away.reshape(len(sensors), len(known)))
    return {sensors[row]: known[column] for row, column in zip(rows, columns)}


def quaternion(matrix: Array) -> list[float]:
    """Return the unit quaternion [w, x, y, z], w >= 0, of the rotation in a transform (3, 3) or (4, 4)."""
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True).tolist()
    return [w, x, y, z]


def agent_velocities(dataset: Dataset, scene: str) -> dict[tuple[str, int], Array]:
    """Return velocities (3,) [m/s, world frame] by (agent, spin); zero for an agent outside the traffic, as a pole.

    In an imported dataset velocities are differences of an agent's poses, and zero where no poses can be compared.
    """
    frames = dataset.select(scenes=[scene])
    keys = [dataset.keys[i] for i in frames]
    if dataset.manifest.imported:
        places = np.array([dataset.world_from_agent(i)[:3, 3] for i in frames])
        moved = difference_tracks(
            np.array([key.agent for key in keys]), np.array([key.time_s for key in keys]) - keys[0].time_s, places
        )
        return {(key.agent, key.index): each for key, each in zip(keys, np.nan_to_num(moved))}
    velocities = {(key.agent, key.index): np.zeros(3) for key in keys}
    trace = dataset.trace(scene)
    if trace is None:
        return velocities
    actors = {name: a for a, name in enumerate(trace.actor.tolist())}
    for key in keys:
        if key.agent in actors:
            t = int(np.argmin(np.abs(trace.time_s - key.time_s)))
            velocities[key.agent, key.index] = trace.velocity[t, actors[key.agent]]
    return velocities


COLOURS = {  # red, green, blue, each 0 to 1
    "car": (0.20, 0.55, 0.95),
    "van": (0.10, 0.75, 0.80),
    "truck": (0.95, 0.55, 0.15),
    "bus": (0.90, 0.75, 0.10),
    "motorcycle": (0.75, 0.35, 0.90),
    "bicycle": (0.45, 0.80, 0.30),
    "pedestrian": (0.95, 0.30, 0.40),
}
OTHER = (0.6, 0.6, 0.6)
SIGN = (1.0, 0.95, 0.3)

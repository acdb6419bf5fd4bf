"""Samples of the trajectory task: a vehicle's past and future in the frame of its present, and its surroundings.

The surroundings are a raster of map and tracks, or resized images of the cameras near the vehicle with the calibration
that projects the vehicle's frame into them. They do not depend on anything after the present: tracks are those of
`tracks_around`, and images, which show the smoothed traffic, are `REACH_S` old.
"""

import zlib
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Array32, Bytes, Ints, Mask, Words
from flcav.config import InputError
from flcav.dataset.layout import FrameKey
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, pose
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.agents import POLE, kind_of
from flcav.perception.images import Picture, check_picture, resize_picture
from flcav.perception.trajectory.config import PAST, CrossView, Patch, TrajectoryConfig
from flcav.perception.trajectory.rasters import BEFORE_M, RoadMap, draw_rasters, load_roads
from flcav.perception.trajectory.tracks import GAP_S, Tracks, check_instants, into_frame, tracks_around
from flcav.world.trace import Trace
from flcav.world.traffic.traffic import REACH_S

CAMERAS = 6  # typical number of cameras of a vehicle
KEPT_BYTES = 2**30  # [B] of images cached in memory
SEEN_M = 25.0  # largest distance from the observing vehicle to a road user that is predicted with cameras
LOOKED_AT_AGAIN = 4  # number of cached sets of samples, so that validation does not extract them again

Pictured = tuple[Bytes, Array, Array]  # images, intrinsics and camera_from_world of a frame's cameras


class Surround(NamedTuple):
    """The images of n cameras, `REACH_S` before the present, with their calibration relative to a road user."""

    pictures: Bytes  # (n, height, width, 3)
    intrinsics: Array  # (n, 3, 3) of the resized images [px]
    camera_from_frame: Array  # (n, 4, 4) from the road user's frame to the optical one: x right, y down, z forward


def surround_vehicle(data: Dataset, number: int, present: Array, settings: CrossView) -> Surround:
    """Return the resized images seen at frame `number`, with their calibration relative to a road user at `present`.

    The images are those of `find_pictured`. `present` is x, y, yaw in the world frame [m, rad]; poses and intrinsics of
    the cameras are the agent's assumed calibration.
    """
    pictures, intrinsics, camera_from_world = pictures_at(data, number, settings)
    world_from_frame = pose(float(present[0]), float(present[1]), yaw=float(present[2]))
    return Surround(pictures, intrinsics, camera_from_world @ world_from_frame)


def pictures_at(data: Dataset, number: int, settings: CrossView) -> Pictured:
    """Return the resized images seen at frame `number`, their intrinsics and camera_from_world: see `find_pictured`."""
    pictured = find_pictured(data, number)
    assert pictured is not None
    return _kept(settings)(data, pictured)


def find_pictured(data: Dataset, number: int) -> int | None:
    """Return the number of the frame whose images are seen at frame `number`: its agent's last one `REACH_S` before it.

    None where there is none, or only one that is more than `GAP_S` older.
    """
    key = data.keys[number]
    numbers, time_s = _frames_of_agents(data)[key.scene, key.agent], key.time_s - REACH_S
    count = bisect_right(numbers, time_s + 1e-6, key=lambda i: data.keys[i].time_s)
    if not count or data.keys[numbers[count - 1]].time_s < time_s - GAP_S - 1e-6:
        return None
    return numbers[count - 1]


@lru_cache(maxsize=2)
def _frames_of_agents(data: Dataset) -> Mapping[tuple[str, str], Sequence[int]]:
    """Return the numbers of the agents' frames, by scene and agent, in order of time."""
    numbers: dict[tuple[str, str], list[int]] = defaultdict(list)
    for number in sorted(range(len(data)), key=lambda i: data.keys[i].time_s):
        numbers[data.keys[number].scene, data.keys[number].agent].append(number)
    return numbers


@lru_cache(maxsize=2)
def _kept(settings: CrossView) -> Callable[[Dataset, int], Pictured]:
    """Return `_read` with a cache of the most recently used frames that fit into `KEPT_BYTES`."""
    frame_bytes = CAMERAS * settings.height_px * settings.width_px * 3
    return lru_cache(maxsize=KEPT_BYTES // frame_bytes)(partial(_read, settings))


def _read(settings: CrossView, data: Dataset, number: int) -> Pictured:
    frame = data.frame(number)
    pictures, intrinsics, views = [], [], []
    for camera in data.cameras(number):
        rgb = check_picture(data.plane(number, camera, "rgb"), f"{data.folder} {frame.key}/{camera}")
        pictures.append(resize_picture(rgb, settings.width_px, settings.height_px))
        intrinsics.append(rescaled(frame.assumed.intrinsics[camera], rgb, settings))
        views.append(inverse(frame.assumed_world_from_sensor(camera)))
    return np.stack(pictures), np.stack(intrinsics), np.stack(views)


def rescaled(intrinsics: Array, rgb: Picture, settings: CrossView) -> Array:
    """Return the intrinsics (3, 3) of an image after resizing; the centre of the first pixel is at (0, 0)."""
    scale = np.array((settings.width_px / rgb.shape[1], settings.height_px / rgb.shape[0]))
    out = intrinsics.copy()
    out[:2] *= scale[:, None]
    out[:2, 2] += (scale - 1) / 2
    return out


class Columns(NamedTuple):
    """The fields of N samples as arrays with one row per sample, see `Sample`; without `surround`."""

    past: Array32  # (N, PAST + 1, 4)
    future: Array32  # (N, FUTURE, 2)
    raster: Bytes  # (N, LAYERS, cells, cells / 8)
    pose: Array  # (N, 3)
    actor: Ints  # (N,)
    at_junction: Mask  # (N,)
    scene: Words  # (N,)
    frame: Ints  # (N,)


@dataclass(frozen=True)
class Sample:
    """A road user at an instant, in the frame of its present pose: x along its heading; metres, radians, seconds.

    Past and present are those of `tracks_around`, which use no later states; the future is the recorded one.
    """

    past: Array32  # (PAST + 1, 4) x, y, yaw, speed; the last is the present
    future: Array32  # (FUTURE, 2) x, y; NaN if unknown
    raster: Bytes  # (LAYERS, cells, cells / 8) packed bits of `flcav.perception.trajectory.rasters`
    pose: Array  # (3,) x, y, yaw of the present in the world frame
    actor: Ints  # () index in its trace
    at_junction: Mask  # () whether it is inside a junction or at most BEFORE_M before one
    scene: Words  # ()
    frame: Ints  # () number of the dataset's frame
    surround: Surround | None = None  # images and calibration of the cameras; None with rasters


class Samples(Sequence[Sample]):
    """Samples as arrays with one row per sample, `columns`; images are read when a sample is accessed."""

    def __init__(self, data: Dataset, columns: Columns, cameras: CrossView | None) -> None:
        self.columns = columns
        self._data, self._cameras = data, cameras

    def __len__(self) -> int:
        return len(self.columns.past)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        row = Columns(*(column[index] for column in self.columns))
        seen = surround_vehicle(self._data, int(row.frame), row.pose, self._cameras) if self._cameras else None
        return Sample(*row, surround=seen)


def samples_of(data: Dataset, config: TrajectoryConfig, frames: Sequence[int] | None = None) -> Samples:
    """Return the samples of a dataset's frames (None: all) with a complete past and future; cached.

    With rasters these are all vehicles on the road at the frames' instants, whichever agent observes; with cameras, the
    vehicles within `SEEN_M` of the frame's observing vehicle, which is included. Raises `InputError` where the dataset
    lacks traffic, map or images, or has no such sample.
    """
    return _samples(data, config.patch, config.cameras, tuple(data.numbers(frames)))


@lru_cache(maxsize=LOOKED_AT_AGAIN)
def _samples(data: Dataset, patch: Patch, cameras: CrossView | None, frames: tuple[int, ...]) -> Samples:
    parts = list(_parts(data, patch, cameras, frames))
    if not any(len(part.past) for part in parts):
        raise InputError(f"{data.folder}: no vehicle is there from 2 s before to 3 s after any of the frames")
    return Samples(data, Columns(*map(np.concatenate, zip(*parts))), cameras)


def _parts(data: Dataset, patch: Patch, cameras: CrossView | None, frames: Sequence[int]) -> Iterator[Columns]:
    seen = set()
    traces: dict[str, Trace] = {}
    for number in frames:
        key = data.keys[number]
        if key.scene not in traces:
            traces = {key.scene: load_traffic(data, key.scene)}
        trace = traces[key.scene]
        if cameras:
            pictured = find_pictured(data, number)
            if not data.cameras(number if pictured is None else pictured):
                raise InputError(f"{data.folder}: no camera pictures in its frames; record it with cameras")
            if pictured is None:
                continue
        elif (key.scene, key.index) in seen:
            continue
        seen.add((key.scene, key.index))
        tracks = tracks_around(trace, key.time_s)
        wanted = find_near(trace, tracks, key) if cameras else np.ones(len(trace.actor), np.bool_)
        yield extract_columns(trace, tracks, key, number, load_roads(data), patch, wanted)


def select_pictured_frames(data: Dataset, cameras: bool) -> Sequence[int]:
    """Return the numbers of the frames that can have samples: all, or with `cameras` those of vehicles, if any.

    With cameras only road users around an observing vehicle are predicted, none around a pole.
    """
    driving = [number for number, key in enumerate(data.keys) if kind_of(key.agent) != POLE]
    return driving if cameras and driving else range(len(data))


def load_traffic(data: Dataset, scene: str) -> Trace:
    """Return the traffic of a scene; raises `InputError` if it was not recorded, or at too coarse instants."""
    trace = data.trace(scene)
    if trace is None:
        raise InputError(f"{data.folder}: no traffic of scene '{scene}' was recorded, which 'trajectory' needs")
    check_instants(trace, f"{data.folder}, scene '{scene}'")
    return trace


def find_near(trace: Trace, tracks: Tracks, key: FrameKey) -> Mask:
    """Return the mask (A,) of actors within `SEEN_M` of the observing vehicle, which is included; none for a pole.

    `tracks` are those around the time of `key`.
    """
    observer = trace.actor == key.agent
    if not observer.any():
        return observer
    apart = tracks.position[PAST] - tracks.position[PAST, observer]
    return np.linalg.norm(apart, axis=1) <= SEEN_M  # False for absent actors


def extract_columns(
    trace: Trace,
    tracks: Tracks,
    key: FrameKey,
    number: int,
    roads: RoadMap,
    patch: Patch,
    wanted: Mask,
    complete: bool = True,
) -> Columns:
    """Return the samples of the `wanted` (A,) vehicles on the road at the time of the frame of this key and number.

    `tracks` are those around that time. Only vehicles with a complete past are included, and only with a complete
    future if `complete`.
    """
    known = np.isfinite(tracks.yaw)
    on_road = (trace.category != "pedestrian") & ~np.char.startswith(trace.actor, "parked") & wanted
    on_road &= known.all(axis=0) if complete else known[: PAST + 1].all(axis=0)
    actor = np.flatnonzero(on_road)
    pose = np.concatenate((tracks.position[PAST, actor], tracks.yaw[PAST, actor, None]), axis=1)
    path = into_frame(tracks.position[:, actor].transpose(1, 0, 2), pose)
    turn = np.unwrap(tracks.yaw[: PAST + 1, actor], axis=0).T - tracks.yaw[PAST, actor, None]
    turn -= np.round(turn[:, -1:] / (2 * np.pi)) * 2 * np.pi
    speed = tracks.speed[: PAST + 1, actor].T
    past = np.concatenate((path[:, : PAST + 1], turn[..., None], speed[..., None]), axis=2)
    lit = trace.light_state[max(0, int(np.searchsorted(trace.time_s, key.time_s + 1e-6, side="right")) - 1)]
    seen = draw_rasters(trace, tracks, lit, actor, roads, patch)
    _, to_junction_m = roads.lanes_at(pose[:, :2], pose[:, 2])
    return Columns(
        past=past.astype(np.float32),
        future=path[:, PAST + 1 :].astype(np.float32),
        raster=np.packbits(seen, axis=-1),
        pose=pose,
        actor=actor,
        at_junction=to_junction_m <= BEFORE_M,
        scene=np.full(len(actor), key.scene),
        frame=np.full(len(actor), number),
    )


def pack_frames(data: Dataset, config: TrajectoryConfig, frames: Sequence[int]) -> Iterator[bytes]:
    """Yield the messages of frames, with their samples: compressed rasters, or images.

    With rasters, all agents that observe an instant send all samples of the instant.
    """
    columns = samples_of(data, config, frames).columns
    instants = [i if config.cameras else (data.keys[i].scene, data.keys[i].index) for i in range(len(data))]
    rows: dict[object, list[int]] = {}
    for row, i in enumerate(columns.frame.tolist()):
        rows.setdefault(instants[i], []).append(row)
    for i in frames:
        arrays: dict[str, NDArray] = {
            name: column[rows.get(instants[i], [])] for name, column in columns._asdict().items()
        }
        arrays["scene"] = from_names(arrays["scene"].tolist())
        arrays["shape"] = np.array(arrays["raster"].shape)
        arrays["raster"] = np.frombuffer(zlib.compress(arrays["raster"].tobytes()), dtype=np.uint8)
        seen = pictures_at(data, i, config.cameras) if config.cameras and len(arrays["past"]) else None
        yield pack_arrays(arrays if seen is None else arrays | dict(zip(Surround._fields, seen, strict=True)))


def unpack_frames(messages: Sequence[bytes]) -> list[Sample]:
    """Return the samples in messages without duplicates: of several agents, the first one's."""
    samples: dict[tuple[int, int], Sample] = {}
    for message in messages:
        arrays = unpack_arrays(message)
        arrays["scene"] = to_names(arrays["scene"])
        packed = zlib.decompress(arrays["raster"].tobytes())
        arrays["raster"] = np.frombuffer(packed, dtype=np.uint8).reshape(arrays["shape"])
        for row in zip(*(arrays[name] for name in Columns._fields), strict=True):
            columns = Columns(*map(np.asarray, row))
            seen = None
            if "pictures" in arrays:
                x, y, yaw = columns.pose.tolist()
                views = arrays["camera_from_frame"] @ pose(x, y, yaw=yaw)
                seen = Surround(arrays["pictures"], arrays["intrinsics"], views)
            samples.setdefault((int(columns.frame), int(columns.actor)), Sample(*columns, surround=seen))
    return [*samples.values()]

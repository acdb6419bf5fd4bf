"""Reading of Argoverse 2's sensor dataset: logs in Feather files, as av2-api reads them.

Frames: `egovehicle` is at the centre of the rear axle, x ahead, y left, z up; `city` is the world; cameras are optical.
A sweep has the points of both stacked LiDARs, motion-compensated to the ego frame at the sweep's time; their times are
those of the measurements, counted from the sweep's time, at which the spin begins. Images have no distortion: av2-api's
camera model has none, and the coefficients in `intrinsics.feather` belong to the raw images.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flcav.config import InputError, check_is_file, path_within
from flcav.dataset.formats.reading import (
    FARTHEST,
    AgentNames,
    ImportFormat,
    LogPicture,
    LogSource,
    annotate,
    are_unit_quaternions,
    check_sizes,
    choose_split,
    difference_tracks,
    group_classes,
    link_pictures,
    name_folders,
    name_place,
    name_some,
    pinhole,
    view_boxes,
)
from flcav.dataset.frame_checks import LONGEST_SPIN_S
from flcav.geometry import Array, Boxes, pose, transform_points, turned_boxes
from flcav.interface.wording import plural
from flcav.sensors.frame import Calibration, LinkedFrame
from flcav.sensors.lens import Lens

# A bicycle in flcav has a rider; Argoverse 2's without a rider keeps its class name, as do all other classes.
CATEGORIES = group_classes(
    car="REGULAR_VEHICLE",
    truck="LARGE_VEHICLE BOX_TRUCK TRUCK TRUCK_CAB VEHICULAR_TRAILER",
    bus="BUS SCHOOL_BUS ARTICULATED_BUS",
    pedestrian="PEDESTRIAN OFFICIAL_SIGNALER",
    bicycle="BICYCLIST",
    motorcycle="MOTORCYCLIST",
)
SPLITS = ("train", "val", "test")  # folders of logs
AXLE_M = 0.33  # height of the rear axle above the ground, which in the log 7fab2350 lies 0.33 to 0.37 m below it
BEAMS = 64  # of both LiDARs: the lasers 0 to 63 of a sweep
RANGE_M = 200.0  # of a VLP-32C, by its data sheet (Velodyne 63-9378); both are of this type (Wilson et al., 2021)
LIDAR, MOUNT = "lidar", "up_lidar"  # our name for both LiDARs, and the sensor whose mount they are given
TIME = re.compile(r"[0-9]{1,18}")  # [ns], the name of a sweep or picture
LATE_NS = 50_000_000  # longest time between a sweep and the picture that belongs to it: cameras run at 20 Hz
TEXT = ("sensor_name", "track_uuid", "category")  # columns of text; all others are numbers
PLACED = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
EGO_FROM_AGENT = pose(0.0, 0.0, -AXLE_M)


class Log(NamedTuple):
    """A log: its folder, split and agent, the times of its sweeps, and what is missing from it."""

    folder: Path
    split: str | None
    agent: str
    sweeps: tuple[int, ...]  # [ns]
    labelled: bool
    lost: tuple[str, ...]  # annotated times without a sweep
    dark: tuple[str, ...]  # sweeps without a picture of a camera that has pictures of others


class LogLabels(NamedTuple):
    """The A annotations of a log, city frame."""

    sweep: NDArray[np.int64]  # (A,) time [ns]
    track: NDArray[np.str_]  # (A,)
    boxes: Boxes  # (A,) city frame
    velocity: Array  # (A, 3) city frame [m/s]


class Argoverse2Source(LogSource):
    """The logs in a folder of Argoverse 2's sensor dataset: one log, a folder of logs, or folders of SPLITS of logs."""

    FORMAT = "argoverse2"
    beams = BEAMS
    range_m = RANGE_M

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """Open the logs; raises `InputError` where there is none, none of `split`, or a file of a log is missing."""
        self.folder, self.split = folder, split
        self.folders = folders = _find_logs(folder)
        names = AgentNames()
        self._logs = {
            scene: _open_log(folders[scene], names)
            for scene in choose_split(folder, {scene: _split_of(path) for scene, path in folders.items()}, split)
        }
        bare = [log.folder.name for log in self._logs.values() if not log.labelled]
        lost = [name for log in self._logs.values() for name in log.lost]
        dark = [name for log in self._logs.values() for name in log.dark]
        late = f"no picture within {LATE_NS // 10**6} ms of a sweep, of cameras with others: {len(dark)}"
        notes = {
            f"no annotations in {len(bare)} of {plural(len(self._logs), 'log')}, so no boxes: {name_some(bare)}": bare,
            f"no sweep at {plural(len(lost), 'annotated time')}, so no frames there: {name_some(lost)}": lost,
            f"{late}, as of {name_some(dark)}": dark,
        }
        self.notes = tuple(note for note, names in notes.items() if names)
        self.labelled = not bare
        self.split_of = {scene: log.split for scene, log in self._logs.items()}

    def frame_count(self, scene: str) -> int:
        """Return the number of sweeps of a log."""
        return len(self._logs[scene].sweeps)

    def frames(self, scene: str) -> Iterator[LinkedFrame]:
        """Yield a frame for each sweep of a log; raises `InputError` where a file is missing or truncated."""
        log = self._logs[scene]
        poses = Poses(log.folder / "city_SE3_egovehicle.feather")
        mounts, lenses = _read_mounts(log.folder), _read_lenses(log.folder)
        labels = _read_labels(log.folder, poses) if log.labelled else None
        cameras = {name: _list_times(log.folder / "sensors" / "cameras" / name, "jpg") for name in lenses}
        agent_from_ego = np.linalg.inv(EGO_FROM_AGENT)
        seen = [name for name in lenses if len(cameras[name])]
        at = {LIDAR: pose(*mounts[MOUNT][:3, 3])} | {name: mounts[name] for name in lenses}
        calibration = Calibration(
            {name: agent_from_ego @ ego_from_sensor for name, ego_from_sensor in at.items()},
            intrinsics={name: lens.intrinsics() for name, lens in lenses.items()},
            distortion={name: np.zeros(5) for name in lenses},
        )
        for index, sweep in enumerate(log.sweeps):
            taken = {name: t for name in seen if (t := _nearest(cameras[name], sweep)) is not None}
            then = {name: poses.at(t) for name, t in taken.items()}
            pictures = {
                name: LogPicture(
                    log.folder / "sensors" / "cameras" / name / f"{t}.jpg", lenses[name], then[name] @ mounts[name]
                )
                for name, t in taken.items()
            }
            points, times_s = _read_sweep(log.folder / "sensors" / "lidar" / f"{sweep}.feather", mounts[MOUNT][:3, 3])
            rows = np.flatnonzero(labels.sweep == sweep) if labels else np.zeros(0, np.int64)
            boxes = labels.boxes[rows] if labels else Boxes.empty()
            city_from_ego = poses.at(sweep)
            files = {name: picture.path for name, picture in pictures.items()}
            yield LinkedFrame(
                scene=scene,
                index=index,
                time_s=sweep / 1e9,
                agent=log.agent,
                world_from_agent=city_from_ego @ EGO_FROM_AGENT,
                calibration=calibration,
                assumed=calibration,
                lidar={LIDAR: points},
                point_times={LIDAR: times_s},
                annotations=annotate(
                    labels.track[rows].tolist() if labels else (),
                    boxes,
                    {LIDAR: (points, city_from_ego @ at[LIDAR])},
                    view_boxes(boxes, pictures),
                    velocity=labels.velocity[rows] if labels else None,
                ),
                images=link_pictures(files),
                agent_at_trigger={name: city_from_then @ EGO_FROM_AGENT for name, city_from_then in then.items()},
                files=files,
            )


IMPORT = ImportFormat(Argoverse2Source, ("sensors/lidar", "*/sensors/lidar", "*/*/sensors/lidar"))


class Poses:
    """The ego vehicle's poses in the city frame [m], by time."""

    def __init__(self, path: Path) -> None:
        table = _read_feather(path, ("timestamp_ns", *PLACED), key="timestamp_ns")
        self._path, self._transforms = path, _transforms(table, path)
        self._row = {time: row for row, time in enumerate(table["timestamp_ns"].to_pylist())}

    def at(self, time_ns: int) -> Array:
        """Return the pose (4, 4) at a time [ns] in the table; raises `InputError` for any other time."""
        if time_ns not in self._row:
            raise InputError(f"{self._path}: no pose at {time_ns}, when a measurement was made")
        return self._transforms[self._row[time_ns]]


def _find_logs(folder: Path) -> dict[str, Path]:
    """Return the folders of the logs in `folder`, by scene: it is a log itself, or holds logs or splits of them."""
    depths = (folder,), folder.glob("*"), (path for split in SPLITS for path in (folder / split).glob("*"))
    for paths in depths:
        if logs := sorted(path for path in paths if (path / "sensors" / "lidar").is_dir()):
            return name_folders(logs)
    raise InputError(f"{folder}: no log of Argoverse 2; neither it nor a folder in it holds 'sensors/lidar'")


def _split_of(log: Path) -> str | None:
    name, _ = name_place(log)
    return name if name in SPLITS else None


def _open_log(folder: Path, names: AgentNames) -> Log:
    mounts, lenses = _read_mounts(folder), _read_lenses(folder)
    if MOUNT not in mounts:
        raise InputError(f"{folder / 'calibration' / 'egovehicle_SE3_sensor.feather'}: no mount of '{MOUNT}'")
    if lost := sorted(lenses.keys() - mounts.keys()):
        raise InputError(f"{folder / 'calibration' / 'egovehicle_SE3_sensor.feather'}: no mount of '{lost[0]}'")
    calibration = (*((name, mounts[name].tobytes()) for name in sorted(mounts)), *map(str, lenses.items()))
    sweeps = _list_times(folder / "sensors" / "lidar", "feather")
    if not len(sweeps):
        raise InputError(f"{folder / 'sensors' / 'lidar'}: no sweeps in it")
    annotations = folder / "annotations.feather"
    known = annotations.is_file()
    annotated = _read_feather(annotations, ("timestamp_ns",))["timestamp_ns"].unique().to_pylist() if known else ()
    lost = tuple(f"{folder.name}/{time}" for time in sorted(set(annotated) - set(sweeps.tolist())))
    times = {name: _list_times(folder / "sensors" / "cameras" / name, "jpg") for name in lenses}
    dark = tuple(
        f"{folder.name}/{name} at {sweep}"
        for name, taken in times.items()
        for sweep in (sweeps.tolist() if len(taken) else ())
        if _nearest(taken, sweep) is None
    )
    return Log(
        folder, _split_of(folder), names.of("ego", calibration), tuple(sweeps.tolist()), bool(annotated), lost, dark
    )


def _list_times(folder: Path, suffix: str) -> NDArray[np.int64]:
    """Return the times [ns] after which the files of a folder are named, ascending; none where it does not exist."""
    times = (int(path.stem) for path in folder.glob(f"*.{suffix}") if TIME.fullmatch(path.stem))
    return np.array(sorted(times), np.int64)


def _nearest(times: NDArray[np.int64], sweep: int) -> int | None:
    nearest = int(times[np.abs(times - sweep).argmin()])
    return nearest if abs(nearest - sweep) <= LATE_NS else None


def _read_sweep(path: Path, origin: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points (N, 4): x, y, z [m] from `origin` in the ego frame, intensity [0, 1]; and their times (N,) [s].

    Times are from the sweep's time on. Raises `InputError` where one is LONGEST_SPIN_S or more before or after it.
    """
    names = ("x", "y", "z", "intensity")
    table = _read_feather(path, (*names, "offset_ns"))
    x, y, z, intensity = (table[name].to_numpy().astype(np.float32) for name in names)
    xyz = np.column_stack((x, y, z)) - origin.astype(np.float32)
    points = np.column_stack((xyz, intensity / np.float32(255)))
    times_s = (table["offset_ns"].to_numpy() / 1e9).astype(np.float32)
    if not (np.abs(times_s) < LONGEST_SPIN_S).all():
        raise InputError(f"{path}: a point's 'offset_ns' is no time within the spin")
    return points, times_s


def _read_mounts(folder: Path) -> dict[str, Array]:
    """Return the poses (4, 4) of the sensors in the ego frame [m], by name."""
    path = folder / "calibration" / "egovehicle_SE3_sensor.feather"
    table = _read_feather(path, ("sensor_name", *PLACED), key="sensor_name")
    return dict(zip(table["sensor_name"].to_pylist(), _transforms(table, path)))


def _read_lenses(folder: Path) -> dict[str, Lens]:
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    path = folder / "calibration" / "intrinsics.feather"
    lenses = {}
    table = _read_feather(path, ("sensor_name", *names), key="sensor_name")
    for row in table.to_pylist():
        matrix = np.array([[row["fx_px"], 0, row["cx_px"]], [0, row["fy_px"], row["cy_px"]], [0, 0, 1.0]])
        path_within(folder / "sensors" / "cameras", row["sensor_name"], path)
        lenses[row["sensor_name"]] = pinhole(matrix, row["width_px"], row["height_px"], path)
    return lenses


def _read_labels(folder: Path, poses: Poses) -> LogLabels:
    """Return all annotations of a log, also those of missing sweeps, from which velocities are differenced."""
    path = folder / "annotations.feather"
    sides = ("length_m", "width_m", "height_m")
    table = _read_feather(path, ("timestamp_ns", "track_uuid", "category", *sides, *PLACED))
    size = np.column_stack([table[name].to_numpy() for name in sides])
    check_sizes(size, path)
    sweep = table["timestamp_ns"].to_numpy()
    track = np.array(table["track_uuid"].to_pylist(), np.str_)
    in_ego = _transforms(table, path)
    center, rotation = np.zeros((len(table), 3)), np.zeros((len(table), 3, 3))
    for time in np.unique(sweep).tolist():
        city_from_ego = poses.at(time)
        rows = np.flatnonzero(sweep == time)
        center[rows] = transform_points(city_from_ego, in_ego[rows, :3, 3])
        rotation[rows] = city_from_ego[:3, :3] @ in_ego[rows, :3, :3]
    label = np.array([CATEGORIES.get(name, name) for name in table["category"].to_pylist()], np.str_)
    boxes = turned_boxes(center, size, rotation, label)
    return LogLabels(sweep, track, boxes, difference_tracks(track, (sweep - sweep[:1]) / 1e9, center))


def _transforms(table: pa.Table, path: Path) -> Array:
    """Return the transforms (N, 4, 4) of the quaternions and translations in PLACED, from the file at `path`."""
    w, x, y, z, *translation = (table[name].to_numpy() for name in PLACED)
    transforms = np.tile(np.eye(4), (len(table), 1, 1))
    if not (unit := are_unit_quaternions(np.column_stack((w, x, y, z)))).all():
        raise InputError(f"{path}: the rotation of row {int(unit.argmin())} is no quaternion of length 1")
    if len(table):
        transforms[:, :3, :3] = Rotation.from_quat(np.column_stack((x, y, z, w))).as_matrix()
        transforms[:, :3, 3] = np.column_stack(translation)
    return transforms


def _read_feather(path: Path, columns: tuple[str, ...], *, key: str | None = None) -> pa.Table:
    """Return columns of a Feather file.

    Raises `InputError` where it is missing, truncated, lacks a column, or has two rows with the same value of `key`.
    """
    check_is_file(path, None)
    try:
        table = feather.read_table(path, memory_map=False)
    except (OSError, pa.ArrowException, ValueError):
        raise InputError(f"{path}: not a Feather file, or a truncated one") from None
    if lost := [name for name in columns if name not in table.column_names]:
        raise InputError(f"{path}: no column '{lost[0]}'")
    for name in columns:
        kind = table[name].type
        text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
        if table[name].null_count or text != (name in TEXT) or not (text or _is_number(kind)):
            raise InputError(f"{path}: the column '{name}' is not of {'texts' if name in TEXT else 'numbers'}")
        if pa.types.is_floating(kind) and not (near := np.abs(table[name].to_numpy().astype(float)) < FARTHEST).all():
            raise InputError(f"{path}: the column '{name}' has no number in row {int(near.argmin())}, or one too large")
    if key and len(table[key].unique()) < len(table):
        raise InputError(f"{path}: two rows with one '{key}'")
    return table.select(list(columns)).combine_chunks()


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)

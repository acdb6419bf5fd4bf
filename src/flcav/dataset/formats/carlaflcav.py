"""Reading of raw recordings of CarlaFLCAV's FLDatasetTool (SIAT-INVS, at its commit e19af3d): `raw_data/record_DATE`.

A recording is a scene. `others.world_0` has its labels; each other folder is a vehicle, with its poses in
`vehicle_status.csv`, or a post, and holds a folder per sensor. Frames, in the names of files, are ticks of CARLA.
Everything is already right-handed: metres, degrees, poses of cameras in their optical frames. The recorder's principal
point is in pixels from the image's corner. The agent is itself among the labels; so are the map's parked cars, with
boxes about the origins of their meshes, and all actors of the town, of which those within LABELLED_M are taken, as by
the recorder's export to KITTI.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, check_is_file
from flcav.dataset.formats.carlaflcav_labels import ActorLabels, read_labels
from flcav.dataset.formats.reading import (
    FARTHEST,
    AgentNames,
    ImportFormat,
    LogPicture,
    LogSource,
    PosePairs,
    annotate,
    check_cloud,
    choose_split,
    difference_tracks,
    name_folders,
    name_some,
    pinhole,
    view_boxes,
)
from flcav.dataset.payloads import check_image, read_image
from flcav.geometry import Array, angles_of, inverse, pose, rotations, turned_boxes
from flcav.interface.wording import plural
from flcav.sensors.frame import Calibration, CameraImage, Frame
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens
from flcav.storage.records import read_csv

Poses = Mapping[int, Array]  # tick -> (4, 4)

WORLD, STATUS, POSES, CAMERA = "others.world_*", "vehicle_status.csv", "poses.csv", "camera_info.csv"
POSE = ("frame", "timestamp", "x", "y", "z", "roll", "pitch", "yaw")
LABELLED_M = 150.0  # from the agent, between centres
OWN_M = 0.05  # an actor closer than this to the agent's pose is the agent
METRES, DEGREES = 3, 2  # decimals of mounts, which follow from CARLA's poses in float32
BESIDE = re.compile(r"sensor\.camera\.(depth|semantic_segmentation)")  # cameras whose pictures are not colour images
SEMANTIC = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "CosAngle")), ("ObjIdx", "<u4"), ("ObjTag", "<u4")])
RADAR = 7  # numbers per detection
NUMBER = re.compile(r"\d+$")  # of a folder, by the order of the recorder's settings


class RecordedSensor(NamedTuple):
    """A LiDAR, or a camera with its lens."""

    files: Mapping[int, Path]  # by tick
    poses: Poses  # `world_from_sensor` [m], of a camera in the optical frame
    lens: Lens | None


class RecordedAgent(NamedTuple):
    """An agent of a recording, the ticks for which it has a frame, and its sensors."""

    agent: str
    ticks: Collection[int]
    sensors: Mapping[str, RecordedSensor]
    calibration: Calibration
    anchor: str  # the sensor from whose poses the agent's follow
    vehicle: Poses  # empty for a post


class CarlaFlcavSource(LogSource):
    """The recordings in a folder, or the folder of a single one."""

    FORMAT = "carlaflcav"

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """Open the recordings; raises `InputError` where there is none, a table is malformed, or `split` is given."""
        self.folder, self.split = folder, split
        folders = sorted({path.parent for pattern in (WORLD, f"*/{WORLD}") for path in folder.glob(pattern)})
        self.folders = name_folders(folders)
        self.split_of = dict.fromkeys(choose_split(folder, dict.fromkeys(self.folders), split))
        self._counts: Counter[str] = Counter()
        self._lost: list[str] = []  # frames that lack labels, or points of a LiDAR
        self._pairs = PosePairs(f"the poses of the first sensor and '{STATUS}'")
        self._labels = {scene: _list_files(min(path.glob(WORLD)), "pkl") for scene, path in self.folders.items()}
        self._time_s: dict[str, dict[int, float]] = {scene: {} for scene in self.split_of}
        names = AgentNames()
        self._rigs = {scene: self._open(scene, names) for scene in self.split_of}
        if not any(self._rigs.values()):
            raise InputError(f"{folder}: no frame that has labels, a measurement and the pose of its sensor")
        self._note()

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a recording, of all agents."""
        return sum(len(rig.ticks) for rig in self._rigs[scene])

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the frames of a recording; raises `InputError` where a file is missing, truncated or malformed."""
        rigs = self._rigs[scene]
        time_s = self._time_s[scene]
        ticks = sorted({tick for rig in rigs for tick in rig.ticks})
        labels = {tick: self._read_labels(scene, tick) for tick in ticks}
        self._note()
        velocity = _difference(labels, time_s)
        for spin, tick in enumerate(ticks):
            for rig in rigs:
                if tick in rig.ticks:
                    since_s = round(time_s[tick] - time_s[ticks[0]], 6)
                    frame = _read_frame(scene, spin, since_s, rig, tick, labels[tick], velocity[tick])
                    if rig.vehicle:
                        file = rig.sensors[rig.anchor].files[tick]
                        self._pairs.add(frame.world_from_agent, rig.vehicle[tick], file)
                    yield frame
        self._note()

    def _open(self, scene: str, names: AgentNames) -> list[RecordedAgent]:
        """Return the agents of a recording that have frames; its vehicles and posts are numbered in order."""
        folders = [path for path in self.folders[scene].iterdir() if path.is_dir() and not path.match(WORLD)]
        number = Counter[str]()
        rigs = []
        for path in sorted(
            folders, key=lambda path: (int(digits[0]) if (digits := NUMBER.search(path.name)) else 0, path.name)
        ):
            read = {
                sensor_folder.name: self._read_sensor(scene, sensor_folder)
                for sensor_folder in sorted(path.iterdir())
                if sensor_folder.is_dir()
            }
            sensors = {name: sensor for name, sensor in read.items() if sensor is not None}
            if not sensors:
                continue
            vehicle = self._read_poses(scene, path / STATUS) if (path / STATUS).is_file() else {}
            kind = "cav" if vehicle else "pole"
            rig = _assemble(f"{kind}{number[kind]}", vehicle, sensors, self._labels[scene], names)
            number[kind] += 1
            every = {tick for sensor in sensors.values() for tick in sensor.files}
            self._counts.update(frame=len(every))
            self._lost += [f"{path.name}/{tick}" for tick in sorted(every - {*(rig.ticks if rig else ())})]
            if rig:
                rigs.append(rig)
        return rigs

    def _read_sensor(self, scene: str, folder: Path) -> RecordedSensor | None:
        """Return the sensor of a folder; None, and counted, for a kind that a dataset cannot hold."""
        pictures, clouds = (_list_files(folder, ending) for ending in ("png", "npy"))
        if not pictures and not clouds:
            return None
        kind = "camera" if pictures else _tell_cloud(next(iter(clouds.values())))
        kind = "other camera" if BESIDE.match(folder.name) else kind
        if kind not in ("camera", "lidar"):
            self._counts[kind] += 1
            return None
        lens = _read_lens(folder / CAMERA) if pictures else None
        return RecordedSensor(pictures or clouds, self._read_poses(scene, folder / POSES), lens)

    def _read_poses(self, scene: str, path: Path) -> Poses:
        """Return the poses (4, 4) [m] in a table, by tick, and keep the times of the ticks."""
        table = _read_numbers(path, POSE)
        ticks = table["frame"].astype(np.int64).tolist()
        if len({*ticks}) < len(ticks):
            raise InputError(f"{path}: two rows of the frame {max(ticks, key=ticks.count)}; each frame has one pose")
        order = np.argsort(table["frame"], kind="stable")
        if len(back := np.flatnonzero(np.diff(table["timestamp"][order]) <= 0)):
            raise InputError(
                f"{path}: the time stamp of the frame {ticks[order[back[0] + 1]]} is not after the one before"
            )
        self._time_s[scene].update(zip(ticks, table["timestamp"].tolist()))
        placed = np.tile(np.eye(4), (len(ticks), 1, 1))
        placed[:, :3, :3] = rotations(*(np.radians(table[angle]) for angle in ("yaw", "pitch", "roll")))
        placed[:, :3, 3] = np.stack([table[axis] for axis in "xyz"], axis=1)
        return dict(zip(ticks, placed))

    def _read_labels(self, scene: str, tick: int) -> ActorLabels:
        labels = read_labels(self._labels[scene][tick])
        self._counts["flat"] += int((labels.size <= 0).any(axis=1).sum())
        return labels

    def _note(self) -> None:
        count = self._counts
        kinds = {
            f"left out {plural(count['semantic'], 'semantic LiDAR')}, which has no intensities": "semantic",
            f"left out {plural(count['radar'], 'radar')}, which has no radar cross-sections": "radar",
            f"left out {plural(count['other camera'], 'camera')} of depths or classes": "other camera",
            f"left out {plural(count['flat'], 'label')} of objects without a volume": "flat",
        }
        lost = f"left out {len(self._lost)} of {plural(count['frame'], 'frame')}: no labels, or not all of a LiDAR"
        self.notes = (
            *((f"{lost}: {name_some(self._lost)}",) if self._lost else ()),
            *(note for note, kind in kinds.items() if count[kind]),
            *self._pairs.notes(),
        )


IMPORT = ImportFormat(CarlaFlcavSource, (WORLD, f"*/{WORLD}"))


def _assemble(
    agent: str, vehicle: Poses, sensors: Mapping[str, RecordedSensor], labelled: Collection[int], names: AgentNames
) -> RecordedAgent | None:
    """Return an agent, with its mounts as in its first frame; None where it has no frame.

    A frame needs labels, the vehicle's pose, and points of all LiDARs or, where there are none, a picture of the first
    camera.
    """
    lidars = [name for name, sensor in sensors.items() if sensor.lens is None]
    anchor = (lidars or list(sensors))[0]
    needed = [*({*sensors[name].files} & sensors[name].poses.keys() for name in lidars or [anchor]), {*labelled}]
    ticks = sorted(set.intersection(*needed, *([{*vehicle}] if vehicle else [])))
    if not ticks:
        return None

    def body(name: str, tick: int) -> Array:
        sensor = sensors[name]
        return sensor.poses[tick] if sensor.lens is None else sensor.poses[tick] @ inverse(BODY_FROM_OPTICAL)

    mounts: dict[str, Array] = {}
    for name, sensor in sensors.items():
        if posed := [tick for tick in ticks if tick in sensor.poses]:
            base = vehicle[posed[0]] if vehicle else body(anchor, posed[0])
            mounts[name] = _round_mount(inverse(base) @ body(name, posed[0]))
    cameras = {name: lens for name in mounts if (lens := sensors[name].lens) is not None}
    calibration = Calibration(
        {name: mount @ BODY_FROM_OPTICAL if name in cameras else mount for name, mount in mounts.items()},
        intrinsics={name: lens.intrinsics() for name, lens in cameras.items()},
        distortion={name: np.zeros(5) for name in cameras},
    )
    fingerprint = (*((name, mount.tobytes()) for name, mount in mounts.items()), *cameras.items())
    kept = {name: sensors[name] for name in mounts}
    return RecordedAgent(names.of(agent, fingerprint), frozenset(ticks), kept, calibration, anchor, vehicle)


def _round_mount(mount: Array) -> Array:
    degrees = np.round(np.degrees(angles_of(mount[:3, :3])), DEGREES)
    return pose(*np.round(mount[:3, 3], METRES), *np.radians(degrees)) + 0.0  # no -0.0


def _difference(labels: Mapping[int, ActorLabels], time_s: Mapping[int, float]) -> dict[int, Array]:
    """Return the velocities (M, 3) [m/s] of the labels, by tick: see `difference_tracks`."""
    ends = np.cumsum([len(actors.track) for actors in labels.values()])
    moved = difference_tracks(
        np.concatenate([actors.track for actors in labels.values()]),
        np.concatenate([np.full(len(actors.track), time_s[tick]) for tick, actors in labels.items()]),
        np.concatenate([actors.world_from_box[:, :3, 3] for actors in labels.values()]),
    )
    return dict(zip(labels, np.split(moved, ends[:-1])))


def _read_frame(
    scene: str, spin: int, time_s: float, rig: RecordedAgent, tick: int, labels: ActorLabels, velocity: Array
) -> Frame:
    mounts = rig.calibration.agent_from_sensor
    world_from_agent = rig.sensors[rig.anchor].poses[tick] @ inverse(mounts[rig.anchor])
    taken = (labels.size > 0).all(axis=1)
    taken &= np.linalg.norm(labels.world_from_box[:, :3, 3] - world_from_agent[:3, 3], axis=1) <= LABELLED_M
    if rig.vehicle:
        taken &= np.linalg.norm(labels.world_from_actor[:, :3, 3] - rig.vehicle[tick][:3, 3], axis=1) > OWN_M
    placed = labels.world_from_box[taken]
    boxes = turned_boxes(placed[:, :3, 3], labels.size[taken], placed[:, :3, :3], labels.category[taken])
    points, images, pictures = {}, {}, {}
    for name, sensor in rig.sensors.items():
        if sensor.lens is None:
            points[name] = _read_points(sensor.files[tick])
        elif tick in sensor.files and tick in sensor.poses:
            images[name] = _read_picture(sensor.files[tick], sensor.lens)
            pictures[name] = LogPicture(sensor.files[tick], sensor.lens, world_from_agent @ mounts[name])
    return Frame(
        scene=scene,
        index=spin,
        time_s=time_s,
        agent=rig.agent,
        world_from_agent=world_from_agent,
        calibration=rig.calibration,
        assumed=rig.calibration,
        lidar=points,
        annotations=annotate(
            labels.track[taken],
            boxes,
            {name: (cloud, world_from_agent @ mounts[name]) for name, cloud in points.items()},
            view_boxes(boxes, pictures),
            velocity=velocity[taken],
        ),
        images=images,
    )


def _list_files(folder: Path, ending: str) -> dict[int, Path]:
    """Return the files of a folder by tick, in order."""
    found = [path for path in folder.glob(f"*.{ending}") if path.stem.isdecimal()]
    return {int(path.stem): path for path in sorted(found)}


def _read_numbers(path: Path, columns: tuple[str, ...]) -> dict[str, Array]:
    """Return numeric columns of a CSV file; raises `InputError` where one is missing or has other values."""
    table = read_csv(path)
    values: dict[str, Array] = {}
    for name in columns:
        try:
            values[name] = np.array(table[name].to_pylist(), np.float64)
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path}: no column '{name}' of numbers") from None
        if len(odd := np.flatnonzero(~(np.abs(values[name]) < FARTHEST * 10))):
            row, value = int(odd[0]), values[name][odd[0]]
            raise InputError(f"{path}: row {row + 1}: a value of '{name}' is not finite, or too large: {value:g}")
    return values


def _read_lens(path: Path) -> Lens:
    values = _read_numbers(path, ("width", "height", "fx", "fy", "cx", "cy"))
    if any(len(column) != 1 for column in values.values()):
        raise InputError(f"{path}: other than one camera")
    width, height, fx, fy, cx, cy = (float(column[0]) for column in values.values())
    half = 0.5  # flcav's principal point is in pixels from the centre of the first one
    return pinhole(np.array([[fx, 0, cx - half], [0, fy, cy - half], [0, 0, 1.0]]), width, height, path)


def _open_array(path: Path) -> NDArray[np.generic]:
    """Return the array of a .npy file, memory-mapped, so that sizes in its header allocate nothing."""
    check_is_file(path)
    try:
        found = np.load(path, mmap_mode="r", allow_pickle=False)
        if isinstance(found, np.ndarray):
            return found
    except Exception as error:  # the header is evaluated as a Python literal, which may raise anything
        raise InputError(f"{path}: not a readable NumPy array ({type(error).__name__})") from None
    raise InputError(f"{path}: not a NumPy array but an archive of some")


def _tell_cloud(path: Path) -> str:
    """Return the kind of sensor that an array comes from; raises `InputError` where it is not one of the recorder's."""
    found = _open_array(path)
    if found.dtype == SEMANTIC:
        return "semantic"
    columns = found.shape[1] if found.ndim == 2 else 0
    kind = {(4, "<f4"): "lidar", (RADAR, "<f8"): "radar"}.get((columns, found.dtype.str))
    if kind is None:
        raise InputError(f"{path}: {found.dtype} of shape {found.shape}, which no sensor of CarlaFLCAV has")
    return kind


def _read_points(path: Path) -> NDArray[np.float32]:
    if _tell_cloud(path) != "lidar":
        raise InputError(f"{path}: no sweep of a LiDAR, as others beside it are")
    return check_cloud(np.array(_open_array(path), np.float32), path)


def _read_picture(path: Path, lens: Lens) -> CameraImage:
    check_image(path)
    pixels = read_image(path, np.uint8, channels=4)[..., :3]
    if pixels.shape[:2] != (lens.height, lens.width):
        raise InputError(f"{path}: {pixels.shape[1]} x {pixels.shape[0]} pixels, not those of {CAMERA}")
    return CameraImage(np.ascontiguousarray(pixels))

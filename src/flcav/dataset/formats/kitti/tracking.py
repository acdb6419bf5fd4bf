"""Reading of KITTI's multi-object tracking benchmark: sequences of sweeps with labelled tracks.

A sequence is a scene, with files of the same name in `velodyne`, `label_02`, `calib`, `image_02` and `oxts`, of which
only sweeps and calibration are needed. Poses are those of the OXTS log (Geiger et al., IJRR 32(11), 2013, section 3):
latitude, longitude and altitude in a local tangent plane at the first frame, with roll, pitch and yaw of the IMU.
Without a log they are unknown: the world is then each frame's vehicle. Objects are labelled in the left camera's view
alone.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from flcav.arrays import Array
from flcav.config import InputError
from flcav.dataset.formats.kitti.files import (
    FOLDERS,
    KittiCalibration,
    Objects,
    check_objects,
    parse_objects,
    read_calibration,
    read_lines,
    read_points,
)
from flcav.dataset.formats.kitti.read import (
    CAMERA,
    CATEGORIES,
    DRIVE_HZ,
    LIDAR,
    OCCLUSION,
    mount_sensors,
)
from flcav.dataset.formats.reading import (
    ImportFormat,
    LogSource,
    annotate,
    check_rotation,
    choose_split,
    difference_tracks,
    link_pictures,
    measure_picture,
    name_some,
    unseen_views,
)
from flcav.dataset.formats.rig import RANGE_M, UNSTATED, LidarRig, StatedLidar, find_rig
from flcav.geometry import inverse
from flcav.geometry.poses import rotations
from flcav.interface.wording import plural
from flcav.sensors.frame import Calibration, LinkedFrame
from flcav.world.geodesy import convert_from_geodetic
from flcav.world.map.parameters import GeoReference

AGENT = "ego"
SITTING = {"Person": "Person_sitting"}  # the benchmark's name of a class of the object benchmark
OXTS_FIELDS = 6  # latitude, longitude [deg], altitude [m], roll, pitch, yaw [rad], of 30


class KittiTrackingSource(LogSource):
    """The sequences of KITTI's tracking benchmark in `training` and `testing`."""

    FORMAT = "kitti-tracking"
    range_m = RANGE_M

    def __init__(self, folder: Path, split: str | None = None, stated: StatedLidar = UNSTATED) -> None:
        """Open the sequences; raises `InputError` where there is none, none of `split`, or one has no calibration."""
        self.folder, self.split = folder, split
        found = [path for part in FOLDERS for path in sorted((folder / part / "velodyne").glob("*/")) if path.is_dir()]
        if not found:
            raise InputError(f"{folder}: no sequence of KITTI's tracking benchmark, such as 'training/velodyne/0000'")
        splits = {"training": None, "testing": "test"}
        names = {f"kitti-{path.parents[1].name}-{path.name}": path for path in found}
        split_of = {scene: splits[path.parents[1].name] for scene, path in names.items()}
        self.split_of = {scene: split_of[scene] for scene in choose_split(folder, split_of, split)}
        self._sequences = {scene: _Sequence(names[scene]) for scene in self.split_of}
        for sequence in self._sequences.values():
            sequence.check()
        sweeps = [sweep for each in self._sequences.values() for sweep in each.sweeps.values()]
        rig = find_rig(sweeps, read_points, stated)
        for sequence in self._sequences.values():
            sequence.rig = rig
        self.beams = rig.beams
        lost = {kind: [s.name for s in self._sequences.values() if not s.path(kind).exists()] for kind in EFFECTS}
        self.labelled = not lost["label_02"]
        count = plural(len(self._sequences), "sequence")
        self.notes = rig.notes + tuple(
            f"no {kind} of {len(names)} of {count}, {EFFECTS[kind]}: {name_some(names)}"
            for kind, names in lost.items()
            if names
        )

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scene: its sweeps."""
        return len(self._sequences[scene].sweeps)

    def frames(self, scene: str) -> Iterator[LinkedFrame]:
        """Yield the frames of a scene; raises `InputError` where a file is missing, truncated or malformed."""
        yield from self._sequences[scene].frames(scene)


IMPORT = ImportFormat(KittiTrackingSource, ("training/velodyne/*/*.bin", "testing/velodyne/*/*.bin"), takes_lidar=True)

EFFECTS = {
    "label_02": "so no boxes there",
    "image_02": "so LiDAR alone there",
    "oxts": "so no poses there, which --estimate-poses estimates",
}


@dataclass(frozen=True)
class _Labels:
    """The labelled objects of a frame in its LiDAR's frame, and the numbers of their tracks (M,)."""

    objects: Objects
    track: list[str]


class _Sequence:
    """A sequence of the benchmark: its files, by the folder of its sweeps."""

    rig: LidarRig

    def __init__(self, velodyne: Path) -> None:
        self._part, self.name = velodyne.parents[1], velodyne.name
        self.sweeps = {int(path.stem): path for path in sorted(velodyne.glob("*.bin")) if path.stem.isdecimal()}

    def path(self, kind: str) -> Path:
        """Return the sequence's file, or folder of images, of a kind."""
        return self._part / kind / (self.name if kind == "image_02" else f"{self.name}.txt")

    def check(self) -> None:
        """Raise `InputError` where there are no sweeps or no calibration."""
        if not self.sweeps:
            raise InputError(f"{self._part / 'velodyne' / self.name}: no sweeps, 000000.bin and so on")
        if not self.path("calib").is_file():
            raise InputError(f"{self.path('calib')}: no such file; a sequence of KITTI's tracking benchmark has one")

    @cached_property
    def calibration(self) -> KittiCalibration:
        """The calibration of LiDAR and left camera."""
        return read_calibration(self.path("calib"))

    @cached_property
    def labels(self) -> Mapping[int, _Labels]:
        """The labels by frame; empty where there is no file."""
        path = self.path("label_02")
        if not path.is_file():
            return {}
        rows, tracks = defaultdict[int, dict[int, str]](dict), defaultdict[int, list[str]](list)
        for number, line in enumerate(read_lines(path), 1):
            try:
                frame, track, *label = line.split()
                at, which = int(frame), int(track)
            except ValueError:
                raise InputError(f"{path}: line {number} does not begin with a frame and a track") from None
            kind = SITTING.get(label[0], label[0]) if label else ""
            rows[at][number] = " ".join((kind, *label[1:]))
            if kind != "DontCare":
                if str(which) in tracks[at]:
                    raise InputError(f"{path}: line {number}: the track {which} is in frame {at} already")
                tracks[at].append(str(which))
        if beyond := sorted(rows.keys() - self.sweeps.keys()):
            raise InputError(f"{path}: labels frame {beyond[0]}, of which there is no sweep")
        found = {at: parse_objects(lines, path, self.calibration, levels=True) for at, lines in rows.items()}
        return {at: _Labels(objects, tracks[at]) for at, objects in found.items()}

    @cached_property
    def world_from_agent(self) -> Mapping[int, Array]:
        """The vehicle's poses (4, 4) [m] by frame, relative to the place of the first; the identity without a log."""
        path = self.path("oxts")
        if not path.is_file():
            return dict.fromkeys(self.sweeps, np.eye(4))
        log = [_read_oxts(path, number, line) for number, line in enumerate(read_lines(path), 1)]
        if len(log) <= max(self.sweeps):
            raise InputError(f"{path}: {plural(len(log), 'line')}, and the last sweep is {max(self.sweeps)}")
        imu_from_agent = inverse(_read_imu(self.path("calib"))) @ inverse(self.mounts.agent_from_sensor[LIDAR])
        world_from_imu = _locate(np.array(log)[list(self.sweeps)])
        poses = world_from_imu @ imu_from_agent
        poses[:, :3, 3] -= poses[0, :3, 3].copy()
        return dict(zip(self.sweeps, poses, strict=True))

    @cached_property
    def mounts(self) -> Calibration:
        """The mounts of LiDAR and camera on the vehicle."""
        return mount_sensors(self.calibration, self.rig)

    def frames(self, scene: str) -> Iterator[LinkedFrame]:
        """Yield the frames, with the velocities of tracks where poses are known."""
        agent_from_lidar, moved = self.mounts.agent_from_sensor[LIDAR], self._velocities()
        for index, (number, sweep) in enumerate(self.sweeps.items()):
            picture = self.path("image_02") / f"{number:06d}.png"
            pictures = {CAMERA: picture} if picture.is_file() else {}
            labels = self.labels.get(number, _Labels(Objects.none(), []))
            objects, points = labels.objects, read_points(sweep)
            check_objects(objects, *(measure_picture(picture) if pictures else (None, None)), self.path("label_02"))
            pose = self.world_from_agent[number]
            boxes = objects.boxes.transform(pose @ agent_from_lidar)
            names = [CATEGORIES.get(name, name) for name in boxes.label.tolist()]
            yield LinkedFrame(
                scene=scene,
                index=index,
                time_s=number / DRIVE_HZ,
                agent=AGENT,
                world_from_agent=pose,
                calibration=self.mounts,
                assumed=self.mounts,
                lidar={LIDAR: points},
                annotations=annotate(
                    labels.track,
                    replace(boxes, label=np.array(names, np.str_)),
                    {LIDAR: (points, pose @ agent_from_lidar)},
                    {
                        name: unseen_views(objects.rectangle, objects.truncation, OCCLUSION[objects.occlusion])
                        for name in pictures
                    },
                    velocity=moved.get(number),
                ),
                images=link_pictures(pictures),
                agent_at_trigger={},
                files={LIDAR: sweep, **pictures},
            )

    def _velocities(self) -> dict[int, Array]:
        """Return the velocities (M, 3) [m/s, world] of the labels by frame; empty where the poses are unknown."""
        if not self.path("oxts").is_file():
            return {}
        at = [number for number, labels in self.labels.items() for _ in labels.track]
        track = [name for labels in self.labels.values() for name in labels.track]
        world_from_lidar = {n: pose @ self.mounts.agent_from_sensor[LIDAR] for n, pose in self.world_from_agent.items()}
        centres = [each.objects.boxes.transform(world_from_lidar[n]).center for n, each in self.labels.items()]
        number, centre = np.array(at, np.int64), np.concatenate([*centres, np.zeros((0, 3))])
        found = difference_tracks(np.array(track, np.str_), number / DRIVE_HZ, centre)
        return {n: found[number == n] for n in self.labels}


def _read_oxts(path: Path, number: int, line: str) -> list[float]:
    """Return the position and attitude of a line of the log."""
    try:
        values = [float(field) for field in line.split()[:OXTS_FIELDS]]
    except ValueError:
        values = []
    latitude, longitude = (*values, np.nan, np.nan)[:2]
    if len(values) < OXTS_FIELDS or not np.isfinite(values).all() or abs(latitude) > 90 or abs(longitude) > 180:
        raise InputError(f"{path}: line {number} has no latitude, longitude, altitude, roll, pitch and yaw")
    return values


def _read_imu(path: Path) -> Array:
    """Return the pose (4, 4) [m] of the IMU in the LiDAR's frame, from a sequence's calibration."""
    for line in read_lines(path):
        name, *numbers = line.replace(":", " ").split()
        if name in ("Tr_imu_to_velo", "Tr_imu_velo"):
            try:
                pose = np.vstack((np.array(numbers, np.float64).reshape(3, 4), [0, 0, 0, 1]))
                pose[:3, :3] = check_rotation(pose[:3, :3])
            except ValueError as error:
                raise InputError(f"{path}: '{name}' {error}") from None
            return pose
    raise InputError(f"{path}: needs 12 numbers after 'Tr_imu_to_velo:', to use the poses of 'oxts'")


def _locate(log: Array) -> Array:
    """Return the poses (N, 4, 4) [m] of the IMU, east, north and up of the first, for N lines of the log."""
    places = [GeoReference(latitude_deg=at, longitude_deg=by, altitude_m=up) for at, by, up in log[:, :3].tolist()]
    poses = np.tile(np.eye(4), (len(log), 1, 1))
    poses[:, :3, 3] = [convert_from_geodetic(places[0], place) for place in places]
    poses[:, :3, :3] = rotations(log[:, 5], log[:, 4], log[:, 3])
    return poses

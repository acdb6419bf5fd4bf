"""Reading of KITTI's object detection benchmark as a source of frames.

Its frames belong to no sequence: each is a scene, at time 0 and at the world's origin. Only an export of flcav has
more, in `frames.csv`. A drive is a folder that itself holds `velodyne` and `calib`, or one `calib.txt`: its sweeps
follow one another in a single scene, its poses are unknown, and its labels have levels of truncation, as those of
KITTI's tracking benchmark. The LiDAR is KITTI's unless the sweeps show another (see `rig`); beams and range of an
export are unknown. A label's rectangle covers the whole object as far as it lies in the image.
"""

import csv
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flcav.config import InputError, check_is_file, read_file, shorten
from flcav.dataset.formats.kitti.files import (
    FOLDERS,
    PICTURES,
    SUFFIXES,
    KittiCalibration,
    Objects,
    check_objects,
    find_part,
    is_drive,
    read_calibration,
    read_objects,
    read_points,
    read_split,
)
from flcav.dataset.formats.kitti.write import FRAMES
from flcav.dataset.formats.reading import (
    AgentNames,
    ImportFormat,
    LogSource,
    annotate,
    assign_split,
    choose_split,
    link_pictures,
    measure_picture,
    name_some,
    unseen_views,
)
from flcav.dataset.formats.rig import RANGE_M, UNSTATED, LidarRig, StatedLidar, find_rig
from flcav.geometry import Boxes, inverse
from flcav.interface.wording import plural
from flcav.sensors.frame import Calibration, LinkedFrame

CATEGORIES = {  # KITTI's other classes (Person_sitting, Tram, Misc) keep their names
    "Car": "car",
    "Van": "van",
    "Truck": "truck",
    "Pedestrian": "pedestrian",
    "Cyclist": "bicycle",
}
OCCLUSION = np.array([0.0, 0.3, 0.75, np.nan])  # shares for the levels 0 fully visible, 1, 2, 3 unknown
LIDAR, CAMERA = "velodyne", PICTURES
DRIVE_HZ = 10.0  # rate of the sweeps of a drive
LISTS = ("train", "val", "test")


class KittiShot(NamedTuple):
    """A frame of the benchmark, and where it belongs in a dataset."""

    folder: Path  # "training" or "testing"
    number: str  # "000008"
    split: str | None
    scene: str
    spin: int
    vehicle: str
    time_s: float
    exported: bool  # by flcav: its camera may have moved since the spin, so an agent keeps its first calibration


class KittiSource(LogSource):
    """The frames of a KITTI folder, `training` and `testing`."""

    FORMAT = "kitti"

    def __init__(self, folder: Path, split: str | None = None, stated: StatedLidar = UNSTATED) -> None:
        """Open the frames; raises `InputError` where there is none, none of `split`, or a file of one is missing."""
        self.folder, self.split = folder, split
        shots = _find_shots(folder)
        split_of: dict[str, str | None] = {}
        for shot in shots:
            assign_split(split_of, shot.scene, shot.split, folder)
        chosen = set(choose_split(folder, split_of, split))
        self.split_of = {scene: scene_split for scene, scene_split in split_of.items() if scene in chosen}
        self._shots: dict[str, list[KittiShot]] = defaultdict(list)
        self._agent: dict[KittiShot, str] = {}
        self._calibration: dict[str, Calibration] = {}
        every = [shot for shot in shots if shot.scene in chosen]
        _check_complete(every)
        names, rig = AgentNames(), find_rig([_path(shot, "velodyne") for shot in every], read_points, stated)
        self._rig = rig
        for shot in every:
            calibration = _path(shot, "calib")
            mounted = mount_sensors(read_calibration(calibration), rig)
            self._shots[shot.scene].append(shot)
            text = "" if shot.exported else read_file(calibration).decode()
            agent = self._agent[shot] = names.of(shot.vehicle, text)
            self._calibration.setdefault(agent, mounted)
        if not any(shot.exported for shot in every):
            self.beams, self.range_m = rig.beams, RANGE_M
        lost = {
            kind: [shot.number for shot in every if not _path(shot, kind).is_file()] for kind in ("label_2", CAMERA)
        }
        self.labelled = not lost["label_2"]
        effects = {"label_2": "so no boxes there", CAMERA: "so LiDAR alone there"}
        self.notes = rig.notes + tuple(
            f"no {kind} of {len(numbers)} of {plural(len(every), 'frame')}, {effects[kind]}: {name_some(numbers)}"
            for kind, numbers in lost.items()
            if numbers
        )

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scene."""
        return len(self._shots[scene])

    def frames(self, scene: str) -> Iterator[LinkedFrame]:
        """Yield the frames of a scene; raises `InputError` where a file is missing, truncated or malformed."""
        for shot in sorted(self._shots[scene], key=lambda shot: (shot.spin, shot.vehicle)):
            agent = self._agent[shot]
            yield _read_frame(shot, agent, self._calibration[agent], self._rig)


IMPORT = ImportFormat(KittiSource, ("training/velodyne", "testing/velodyne", "velodyne/*.bin"), takes_lidar=True)


def mount_sensors(calibrated: KittiCalibration, rig: LidarRig) -> Calibration:
    """Return the mounts of LiDAR and camera on a vehicle with the LiDAR of `rig`."""
    agent_from_lidar = rig.agent_from_lidar
    projection = calibrated.image_from_camera
    shifted = np.eye(4)  # the projection's fourth column, K t, as a translation t of the camera
    shifted[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    return Calibration(
        {LIDAR: agent_from_lidar, CAMERA: agent_from_lidar @ inverse(shifted @ calibrated.camera_from_lidar)},
        intrinsics={CAMERA: projection[:, :3]},
        distortion={CAMERA: np.zeros(5)},
    )


def _read_frame(shot: KittiShot, agent: str, calibration: Calibration, rig: LidarRig) -> LinkedFrame:
    pictures = {CAMERA: path} if (path := _path(shot, CAMERA)).is_file() else {}
    files = {LIDAR: _path(shot, "velodyne"), **pictures}
    points, calibrated = read_points(files[LIDAR]), read_calibration(_path(shot, "calib"))
    size = measure_picture(path) if pictures else (None, None)
    label = _path(shot, "label_2")
    objects = read_objects(label, calibrated, levels=is_drive(shot.folder)) if label.is_file() else Objects.none()
    check_objects(objects, *size, label)
    agent_from_lidar, mount = calibration.agent_from_sensor[LIDAR], calibration.agent_from_sensor[CAMERA]
    then = mount_sensors(calibrated, rig).agent_from_sensor[CAMERA] @ inverse(mount)
    labels = [CATEGORIES.get(name, name) for name in objects.boxes.label.tolist()]
    boxes = objects.boxes.transform(agent_from_lidar)
    return LinkedFrame(
        scene=shot.scene,
        index=shot.spin,
        time_s=shot.time_s,
        agent=agent,
        world_from_agent=np.eye(4),
        calibration=calibration,
        assumed=calibration,
        lidar={LIDAR: points},
        annotations=annotate(
            [f"{shot.number}-{row}" for row in range(len(boxes))],  # no track is followed
            Boxes(boxes.center, boxes.size, boxes.yaw, np.array(labels, np.str_)),
            {LIDAR: (points, agent_from_lidar)},
            {
                name: unseen_views(objects.rectangle, objects.truncation, OCCLUSION[objects.occlusion])
                for name in pictures
            },
        ),
        images=link_pictures(pictures),
        agent_at_trigger={} if not pictures or np.allclose(then, np.eye(4), atol=1e-9) else {CAMERA: then},
        files=files,
    )


def _find_shots(folder: Path) -> list[KittiShot]:
    """Return the frames of `training` and `testing` in the order of their numbers, in folders with a point cloud.

    A frame is a listed number, or one for which any file exists.
    """
    listed = {}
    for name in LISTS:
        path = folder / "ImageSets" / f"{name}.txt"
        for number in read_split(path) if path.is_file() else ():
            frame = "testing" if name == "test" else "training", number
            if listed.setdefault(frame, name) != name:
                raise InputError(f"{path}: lists the frame {number}, which '{listed[frame]}' lists, too")
    origin = _read_origins(folder / FRAMES)
    shots = []
    for part in FOLDERS:
        found = {kind: {path.stem for path in (folder / part / kind).glob(f"*.{SUFFIXES[kind]}")} for kind in SUFFIXES}
        numbers = set().union(*found.values(), (number for listed_part, number in listed if listed_part == part))
        for number in sorted(numbers) if found["velodyne"] else ():
            split = listed.get((part, number), "test" if part == "testing" else None)
            where = origin.get(number, (f"kitti-{part}-{number}", 0, "ego", 0.0))
            shots.append(KittiShot(folder / part, number, split, *where, number in origin))
    numbers = sorted(path.stem for path in (folder / "velodyne").glob("*.bin")) if is_drive(folder) else []
    scene = f"kitti-{folder.resolve().name}"
    shots += [KittiShot(folder, name, None, scene, i, "ego", i / DRIVE_HZ, False) for i, name in enumerate(numbers)]
    if not shots:
        raise InputError(f"{folder}: no KITTI folder; it holds no 'training/velodyne' with point clouds")
    return shots


def _check_complete(shots: list[KittiShot]) -> None:
    """Raise `InputError` where a file of a frame is missing; images may be missing, or all labels of a folder."""
    labelled = {shot.folder for shot in shots if _path(shot, "label_2").is_file()}
    for shot in shots:
        for part in SUFFIXES:
            if part == CAMERA or (part == "label_2" and shot.folder not in labelled):
                continue
            if not _path(shot, part).is_file():
                raise InputError(f"{_path(shot, part)}: no such file; a frame of KITTI has one")


def _read_origins(path: Path) -> dict[str, tuple[str, int, str, float]]:
    """Return scene, spin, agent and time [s] by number, from the list of an export; empty where there is none."""
    if not path.is_file():
        return {}
    origins = {}
    numbers = dict[str, str]()
    check_is_file(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(file):
                scene, index, _ = row["frame"].removesuffix(row["agent"]).rsplit("_", 2)
                origins[row["number"]] = scene, int(index), row["agent"], float(row["time_s"])
                if (one := numbers.setdefault(row["frame"], row["number"])) != row["number"]:
                    raise InputError(f"{path}: {row['number']} is the frame {shorten(row['frame'])}, as {one} is")
    except InputError:
        raise
    except (KeyError, ValueError, TypeError, AttributeError, csv.Error):
        raise InputError(
            f"{path}: not the list of frames of an export; without it the folder can be read, too"
        ) from None
    return origins


def _path(shot: KittiShot, part: str) -> Path:
    return find_part(shot.folder, part, shot.number)

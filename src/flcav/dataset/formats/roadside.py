"""Reading of roadside LiDAR datasets, DAIR-V2X and TUMTraf: sweeps of sensors at junctions, with boxes.

DAIR-V2X-I (Yu et al., CVPR 2022) has its sweeps in `velodyne` and boxes in `label/virtuallidar`, in the frame of a
level LiDAR; in the cooperative dataset it is the folder `infrastructure-side`. TUMTraf Intersection (Zimmer et al.,
ITSC 2023) has `point_clouds/<lidar>` and, as ASAM OpenLABEL, `labels_point_clouds/<lidar>`. Each LiDAR is a pole. The
world frame is the LiDAR's: positions of sensors are not read, nor are pictures.
"""

import math
import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from flcav.config import InputError, read_json, shorten
from flcav.dataset.formats.clouds import BRIGHTEST, read_pcd
from flcav.dataset.formats.reading import (
    ImportFormat,
    LogSource,
    annotate,
    are_unit_quaternions,
    check_cloud,
    check_headings,
    check_sizes,
    choose_split,
    group_classes,
    name_some,
)
from flcav.geometry import Array, Boxes, turned_boxes, wrap_angle
from flcav.interface.wording import plural
from flcav.sensors.frame import Calibration, Frame

LIDAR = "lidar"
# Classes of both datasets, without regard to case; others keep their names.
CATEGORIES = group_classes(
    car="car",
    van="van",
    truck="truck trailer",
    bus="bus",
    pedestrian="pedestrian",
    bicycle="cyclist bicycle",
    motorcycle="motorcyclist motorcycle",
)
OCCLUSION = (0.0, 0.3, 0.75)  # shares for DAIR-V2X's levels: 0 not, 1 partly and 2 largely occluded
STAMP = re.compile(r"(\d+)_(\d{9})_")  # seconds and nanoseconds in the names of TUMTraf's files


class RoadsideSweep(NamedTuple):
    """A sweep of a roadside LiDAR, its labels, and where it belongs in a dataset."""

    cloud: Path
    label: Path
    pole: str
    spin: int
    time_s: float  # since the first sweep of its scene [s]


class Labelled(NamedTuple):
    """The M labelled objects of a sweep, LiDAR frame."""

    track: tuple[str, ...]
    boxes: Boxes
    occlusion: Array  # (M,) 0 to 1


class RoadsideSource(LogSource):
    """The sweeps of roadside LiDARs in a folder."""

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """Open the sweeps; raises `InputError` where none has labels, none is in `split`, or a table is malformed."""
        self.folder, self.split = folder, split
        labelled, bare = self._list_sweeps(folder)
        if not labelled:
            raise InputError(f"{folder}: no sweep that has labels")
        self.split_of = dict.fromkeys(choose_split(folder, dict.fromkeys(labelled), split))
        self._sweeps = {
            scene: sorted(labelled[scene], key=lambda sweep: (sweep.spin, sweep.pole)) for scene in self.split_of
        }
        self.notes = tuple(_describe_lacking(bare, self._sweeps))

    def frame_count(self, scene: str) -> int:
        """Return the number of sweeps of a scene."""
        return len(self._sweeps[scene])

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the sweeps of a scene; raises `InputError` where a file is missing, truncated or malformed."""
        calibration, here = Calibration({LIDAR: np.eye(4)}), np.eye(4)
        for sweep in self._sweeps[scene]:
            points = read_roadside_sweep(sweep.cloud)
            labelled = self._read_labels(sweep.label)
            check_sizes(labelled.boxes.size, sweep.label)
            yield Frame(
                scene=scene,
                index=sweep.spin,
                time_s=sweep.time_s,
                agent=sweep.pole,
                world_from_agent=here,
                calibration=calibration,
                assumed=calibration,
                lidar={LIDAR: points},
                annotations=annotate(
                    labelled.track, labelled.boxes, {LIDAR: (points, here)}, {}, occlusion=labelled.occlusion
                ),
            )

    @abstractmethod
    def _list_sweeps(self, folder: Path) -> tuple[dict[str, list[RoadsideSweep]], list[str]]:
        """Return the labelled sweeps by scene, and the file names of those without labels."""

    @abstractmethod
    def _read_labels(self, path: Path) -> Labelled:
        """Return the objects in a label file; raises `InputError` for another file."""


class DairSource(RoadsideSource):
    """The sweeps of DAIR-V2X-I: scenes are the sequences in `data_info.json`; without them, a scene is one sweep."""

    FORMAT = "dair-v2x"

    def _list_sweeps(self, folder: Path) -> tuple[dict[str, list[RoadsideSweep]], list[str]]:
        about = _read_infos(folder / "data_info.json")
        labels = folder / "label" / "virtuallidar"
        places = {place: number for number, place in enumerate(sorted({row.place for row in about.values()} | {""}))}
        scenes: dict[str, list[RoadsideSweep]] = {}
        bare = list[str]()
        for cloud in sorted((folder / "velodyne").glob("*.pcd")):
            label = labels / f"{cloud.stem}.json"
            info = about.get(cloud.stem, Info("", "", 0.0))
            if not label.is_file():
                bare.append(cloud.name)
                continue
            scene = f"dair-{info.sequence or cloud.stem}"
            scenes.setdefault(scene, []).append(
                RoadsideSweep(cloud, label, f"pole{places[info.place]}", 0, info.time_s)
            )
        return {scene: _number(sweeps) for scene, sweeps in scenes.items()}, bare

    def _read_labels(self, path: Path) -> Labelled:
        rows: Any = read_json(path)
        track, category, numbers, occlusion = [], [], [], []
        try:
            for number, row in enumerate(rows):
                size = row["3d_dimensions"]
                place = row["3d_location"]
                values = [place[axis] for axis in "xyz"] + [size[axis] for axis in "lwh"] + [row["rotation"]]
                numbers.append([float(value) for value in values])
                category.append(str(row["type"]))
                track.append(str(row.get("track_id", f"{path.stem}-{number}")))
                level = int(float(row.get("occluded_state", 0)))
                occlusion.append(OCCLUSION[level] if 0 <= level < len(OCCLUSION) else math.nan)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(f"{path}: object {len(track) + 1} is none of DAIR-V2X's labels") from None
        array = _check_numbers(np.array(numbers).reshape(-1, 7), path)
        check_headings(array[:, 6], path)
        boxes = Boxes(array[:, :3], array[:, 3:6], wrap_angle(array[:, 6]), _name(category))
        return Labelled(tuple(track), boxes, np.array(occlusion))


class TumTrafSource(RoadsideSource):
    """The sequences of TUMTraf Intersection in a folder, or the folder of a single one."""

    FORMAT = "tumtraf"

    def _list_sweeps(self, folder: Path) -> tuple[dict[str, list[RoadsideSweep]], list[str]]:
        roots = [folder] if (folder / "point_clouds").is_dir() else sorted(folder.iterdir())
        scenes: dict[str, list[RoadsideSweep]] = {}
        bare = list[str]()
        for root in (path for path in roots if (path / "point_clouds").is_dir()):
            for number, lidar in enumerate(sorted(path for path in (root / "point_clouds").iterdir() if path.is_dir())):
                for cloud in sorted(lidar.glob("*.pcd")):
                    label = root / "labels_point_clouds" / lidar.name / f"{cloud.stem}.json"
                    stamp = STAMP.match(cloud.stem)
                    time_s = int(stamp[1]) + int(stamp[2]) / 1e9 if stamp else 0.0
                    if not label.is_file():
                        bare.append(cloud.name)
                        continue
                    sweep = RoadsideSweep(cloud, label, f"pole{number}", 0, time_s)
                    scenes.setdefault(root.resolve().name, []).append(sweep)
        return {scene: _number(sweeps) for scene, sweeps in scenes.items()}, bare

    def _read_labels(self, path: Path) -> Labelled:
        values: Any = read_json(path)
        track, category, numbers = [], [], []
        try:
            (frame,) = values["openlabel"]["frames"].values()
            for name, row in frame["objects"].items():
                data = row["object_data"]
                numbers.append([float(value) for value in data["cuboid"]["val"]])
                category.append(str(data["type"]))
                track.append(str(name))
            array = np.array(numbers, np.float64).reshape(-1, 10)
            turned = Rotation.from_quat(array[:, 3:7]).as_matrix() if len(array) else np.zeros((0, 3, 3))
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(f"{path}: object {len(track) + 1} is no cuboid of OpenLABEL") from None
        array = _check_numbers(array, path)
        if not (unit := are_unit_quaternions(array[:, 3:7])).all():
            raise InputError(f"{path}: the rotation of object {int(unit.argmin()) + 1} is no quaternion of length 1")
        boxes = turned_boxes(array[:, :3], array[:, 7:], turned, _name(category))
        return Labelled(tuple(track), boxes, np.full(len(boxes), np.nan))


def read_roadside_sweep(path: Path) -> NDArray[np.float32]:
    """Return points (N, 4) of a PCD file: x, y, z [m], intensity [0, 1]; points that are not finite are left out.

    Intensities in the file may reach 255, or 65535. Raises `InputError` for other files.
    """
    rows = read_pcd(path)
    try:
        columns = [rows[name] for name in ("x", "y", "z", "intensity")]
    except ValueError:
        raise InputError(f"{path}: not a sweep, which has the fields x, y, z, intensity") from None
    points = np.stack([column.astype(np.float32) for column in columns], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    brightest = float(points[:, 3].max(initial=0.0))
    for limit in (BRIGHTEST, 2**16 - 1):
        if 1 < brightest <= limit:
            points[:, 3] /= np.float32(limit)
            break
    return check_cloud(points, path)


class Info(NamedTuple):
    """The entry of a sweep in `data_info.json`."""

    sequence: str  # "" for none
    place: str  # junction
    time_s: float  # of the sweep [s]


def _read_infos(path: Path) -> Mapping[str, Info]:
    """Return the entries of the sweeps, by the stem of the sweep's file; empty where there is no table."""
    if not path.is_file():
        return {}
    rows: Any = read_json(path)
    infos: dict[str, Info] = {}
    try:
        for row in rows:
            name = Path(str(row["pointcloud_path"])).stem
            info = Info(
                str(row.get("sequence_id", "")),
                str(row.get("intersection_loc", "")),
                float(row.get("pointcloud_timestamp", 0)) / 1e6,
            )
            if infos.setdefault(name, info) != info:
                raise InputError(f"{path}: two entries of {shorten(name)} differ")
        return infos
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError):
        raise InputError(f"{path}: not the list of sweeps of DAIR-V2X") from None


def _number(sweeps: Sequence[RoadsideSweep]) -> list[RoadsideSweep]:
    """Return a scene's sweeps with their spins, which number each LiDAR's sweeps by time, and times since the first."""
    first, spins, numbered = min(sweep.time_s for sweep in sweeps), dict[str, int](), []
    for sweep in sorted(sweeps, key=lambda entry: (entry.time_s, entry.cloud)):
        spin = spins.get(sweep.pole, 0)
        spins[sweep.pole] = spin + 1
        numbered.append(sweep._replace(spin=spin, time_s=round(sweep.time_s - first, 6)))
    return numbered


def _describe_lacking(bare: Sequence[str], scenes: Mapping[str, Sequence[RoadsideSweep]]) -> Iterator[str]:
    """Yield sentences on sweeps without labels, and on sweeps of one LiDAR and scene that share a time stamp."""
    if bare:
        yield f"left out {plural(len(bare), 'sweep')} without labels: {name_some(bare)}"
    by_time: dict[tuple[str, str, float], list[RoadsideSweep]] = {}
    for scene, sweep in ((scene, entry) for scene, sweeps in scenes.items() for entry in sweeps):
        by_time.setdefault((scene, sweep.pole, sweep.time_s), []).append(sweep)
    if twins := [twin for twin in by_time.values() if len(twin) > 1]:
        one, other, *_ = twins[0]
        equal, whole = (sum(map(len, group)) for group in (twins, by_time.values()))
        yield (
            f"{equal} of {plural(whole, 'sweep')} have the time stamp of another "
            f"of their LiDAR, as {other.cloud.name} has that of {one.cloud.name}: correct the time stamps"
        )


def _name(category: Sequence[str]) -> NDArray[np.str_]:
    return np.array([CATEGORIES.get(name.lower(), name) for name in category], np.str_).reshape(len(category))


def _check_numbers(numbers: Array, path: Path) -> Array:
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: object {int(np.isfinite(numbers).all(axis=1).argmin()) + 1} is not finite")
    return numbers


DAIR = ImportFormat(DairSource, ("label/virtuallidar",))
TUMTRAF = ImportFormat(TumTrafSource, ("labels_point_clouds", "*/labels_point_clouds"))

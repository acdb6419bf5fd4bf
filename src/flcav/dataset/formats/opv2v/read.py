"""Reading of OPV2V, as OpenCOOD reads it: scenarios of several agents in CARLA's left-handed frames.

OPV2V has a single class, vehicle, which is read as car; it has no times, but spins at 10 Hz, and for velocities only
the speed, along the heading. V2X-Real (Xiang et al., ECCV 2024) has its files, but raw point clouds, JPEG pictures and
classes: its code takes clouds and poses as left-handed, too. Sensor poses in the files are in the world frame: mounts
are derived from the agent's first frame.
"""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, read_yaml
from flcav.dataset.formats.opv2v.files import (
    CAMERAS,
    EGO,
    FOLDERS,
    KMH,
    RADIANS,
    About,
    from_carla,
    read_about,
    read_cloud,
    read_raw_cloud,
)
from flcav.dataset.formats.reading import (
    AgentNames,
    ImportFormat,
    LogPicture,
    LogSource,
    PosePairs,
    annotate,
    check_sizes,
    choose_split,
    link_pictures,
    measure_picture,
    name_folders,
    name_place,
    name_some,
    pinhole,
    view_boxes,
)
from flcav.geometry import Array, Boxes, heading_vectors, inverse, turned_boxes
from flcav.interface.wording import plural
from flcav.sensors.frame import Calibration, LinkedFrame
from flcav.sensors.lens import BODY_FROM_OPTICAL

PERIOD_S = 0.1
LIDAR, CATEGORY = "lidar", "car"
CATEGORIES = {"policecar": "car", "longvehicle": "car", "motorcyle": "motorcycle"}  # V2X-Real's, named otherwise here
CLOUDS, PICTURES = (".pcd", ".bin"), (".png", ".jpeg", ".jpg")
DIGITS = 9  # decimals of mounts, which are computed from poses
PROTOCOL = "data_protocol.yaml"


class Opv2vShot(NamedTuple):
    """A frame of an agent: the files without their ending, and where it belongs in a dataset."""

    stem: Path
    agent: str
    spin: int
    time_s: float


class Opv2vSource(LogSource):
    """The scenarios in a folder: a single one, a split of scenarios, or a folder of splits."""

    FORMAT = "opv2v"

    def __init__(self, folder: Path, split: str | None = None) -> None:
        """Open the scenarios; raises `InputError` where there is none, none of `split`, or a file of one is missing."""
        self.folder, self.split = folder, split
        self.folders = folders = _find_scenarios(folder)
        split_of = {scene: _split_of(path) for scene, path in folders.items()}
        self.split_of = {scene: split_of[scene] for scene in choose_split(folder, split_of, split)}
        self._calibration: dict[str, Calibration] = {}
        self._track: dict[str, dict[str, str]] = {}
        names = AgentNames()
        self._blind: dict[str, list[str]] = {}  # agent -> its cameras without any picture
        self._frames = 0  # in the folder
        self._lost, self._unseen = list[str](), list[str]()  # incomplete frames, and missing pictures
        self._pairs = PosePairs(f"'lidar_pose' and '{EGO[0]}'")
        self._shots = {scene: self._open(scene, folders[scene], names) for scene in self.split_of}
        agents, frames = plural(len(self._calibration), "agent"), plural(self._frames, "frame")
        if not self._calibration:
            raise InputError(f"{folder}: none of {frames} has both a YAML file and a point cloud")
        blind = len(self._blind)
        dark = len({path.rpartition("_")[0] for path in self._unseen})
        cameras = name_some([f"{camera} of {agent}" for agent, blinded in self._blind.items() for camera in blinded])
        notes = {
            f"no pictures of a camera of {blind} of {agents}, so no images of it: {cameras}": blind,
            f"left out {len(self._lost)} of {frames}: no YAML file or no point cloud of {name_some(self._lost)}": len(
                self._lost
            ),
            f"no picture of a camera of {dark} of {frames}, so no image there: {name_some(self._unseen)}": dark,
        }
        self._lacking = self.notes = tuple(note for note, count in notes.items() if count)

    def _open(self, scene: str, folder: Path, names: AgentNames) -> list[Opv2vShot]:
        known = self._track[scene] = _read_names(folder / PROTOCOL)
        stamps_of = {path: self._list_stamps(path) for path in sorted(folder.iterdir()) if path.is_dir()}
        rank = {
            spin: number
            for number, spin in enumerate(sorted({int(s) for stamps, _ in stamps_of.values() for s in stamps}))
        }
        shots = []
        for path, (stamps, pictured) in stamps_of.items():
            if stamps:
                kind = "pole" if path.name.startswith("-") else "cav"
                vehicle = known.get(path.name, f"{kind}{path.name.lstrip('-')}")
                calibration = _calibrate(path / stamps[0])
                lidar, cameras = calibration.agent_from_sensor[LIDAR] + 0.0, calibration.intrinsics  # no -0.0
                agent = names.of(vehicle, (lidar.tobytes(), *((name, cameras[name].tobytes()) for name in cameras)))
                self._calibration.setdefault(agent, calibration)
                if lacking := sorted(cameras.keys() - pictured):
                    self._blind[agent] = lacking
                shots += [Opv2vShot(path / stamp, agent, int(stamp), rank[int(stamp)] * PERIOD_S) for stamp in stamps]
        return sorted(shots, key=lambda shot: (shot.spin, shot.agent))

    def _list_stamps(self, folder: Path) -> tuple[list[str], set[str]]:
        """Return the time stamps of an agent's complete frames, in order, and its cameras that have pictures.

        A complete frame has a YAML file and a point cloud; others are noted, and so are missing pictures. Raises
        `InputError` where two frames have the same number.
        """
        names = {path.name for path in folder.iterdir()}
        stems = {re.split(r"[_.]", name, maxsplit=1)[0] for name in names}
        stamps = sorted((stem for stem in stems if stem.isdecimal()), key=lambda stem: (int(stem), stem))
        for one, other in pairwise(stamps):
            if int(one) == int(other):
                raise InputError(f"{folder / other}.yaml: is frame {int(other)}, as {one}.yaml is; keep one of them")
        whole = [
            stamp for stamp in stamps if f"{stamp}.yaml" in names and any(f"{stamp}{end}" in names for end in CLOUDS)
        ]
        pictured = {camera: {s for s in whole if _picture(folder / s, camera) is not None} for camera in CAMERAS}
        cameras = {camera for camera, stamped in pictured.items() if stamped}
        place = "/".join((folder.parent.name, folder.name))
        self._frames += len(stamps)
        self._lost += [f"{place}/{stamp}" for stamp in stamps if stamp not in whole]
        self._unseen += [f"{place}/{s}_{name}" for s in whole for name in sorted(cameras) if s not in pictured[name]]
        return whole, cameras

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scenario, of all agents."""
        return len(self._shots[scene])

    def frames(self, scene: str) -> Iterator[LinkedFrame]:
        """Yield the frames of a scenario; raises `InputError` where a file is missing, truncated or malformed."""
        for shot in self._shots[scene]:
            yield self._frame(scene, shot)
            self.contradictions = self._pairs.notes()
            self.notes = (*self._lacking, *self.contradictions)

    def _frame(self, scene: str, shot: Opv2vShot) -> LinkedFrame:
        calibration = self._calibration[shot.agent]
        about = read_about(shot.stem)
        mounts = calibration.agent_from_sensor
        world_from_lidar = about["lidar_pose"]
        world_from_agent = world_from_lidar @ inverse(mounts[LIDAR])
        also = "the angles of one are those of the other in radians" if about[RADIANS] else ""
        self._pairs.add(world_from_agent, about[EGO[0]], shot.stem.with_suffix(".yaml"), also)
        boxes, velocity = _read_vehicles(about)
        check_sizes(boxes.size, shot.stem.with_suffix(".yaml"))
        points = _read_points(shot.stem)
        files = {name: file for name in mounts if name in about and (file := _picture(shot.stem, name)) is not None}
        placed = {name: about[name]["cords"] @ BODY_FROM_OPTICAL for name in files}
        pictures = {
            name: LogPicture(
                file,
                pinhole(calibration.intrinsics[name], *measure_picture(file), shot.stem.with_suffix(".yaml")),
                placed[name],
            )
            for name, file in files.items()
        }
        names = self._track[scene]
        return LinkedFrame(
            scene=scene,
            index=shot.spin,
            time_s=shot.time_s,
            agent=shot.agent,
            world_from_agent=world_from_agent,
            calibration=calibration,
            assumed=calibration,
            lidar={LIDAR: points},
            annotations=annotate(
                [names.get(str(number), str(number)) for number in about["vehicles"]],
                boxes,
                {LIDAR: (points, world_from_lidar)},
                view_boxes(boxes, pictures),
                velocity=velocity,
            ),
            images=link_pictures(files),
            agent_at_trigger={name: world @ inverse(mounts[name]) for name, world in placed.items()},
            files=files,
        )


IMPORT = ImportFormat(Opv2vSource, ("data_protocol.yaml", "*/data_protocol.yaml", "*/*/data_protocol.yaml"))


def _read_points(stem: Path) -> NDArray[np.float32]:
    """Return the point cloud of a frame: see `read_cloud` and `read_raw_cloud`."""
    path = _find_cloud(stem)
    if path is None:
        raise InputError(f"{stem.with_suffix(CLOUDS[0])}: no such file")
    return read_cloud(path) if path.suffix == CLOUDS[0] else read_raw_cloud(path)


def _calibrate(stem: Path) -> Calibration:
    """Return the calibration of an agent by its first frame: sensor poses in the agent frame."""
    about = read_about(stem)
    agent_from_world = inverse(about[EGO[0]])
    cameras = [name for name in CAMERAS if name in about]
    mounts = {LIDAR: agent_from_world @ about["lidar_pose"]}
    mounts |= {name: agent_from_world @ about[name]["cords"] @ BODY_FROM_OPTICAL for name in cameras}
    return Calibration(
        {name: np.round(mount, DIGITS) for name, mount in mounts.items()},
        intrinsics={name: np.array(about[name]["intrinsic"], np.float64).reshape(3, 3) for name in cameras},
        distortion={name: np.zeros(5) for name in cameras},
    )


def _read_vehicles(about: About) -> tuple[Boxes, Array]:
    """Return the boxes of a frame's vehicles, world frame, and their velocities (M, 3) [m/s]."""
    rows = list(about["vehicles"].values())
    placed = [from_carla([*np.add(row["location"], row["center"]), *row["angle"]]) for row in rows]
    poses = np.array(placed).reshape(-1, 4, 4)
    size = 2 * np.array([row["extent"] for row in rows], np.float64).reshape(-1, 3)
    speed = np.array([row.get("speed", np.nan) for row in rows]) / KMH
    named = [row.get("obj_type", CATEGORY).lower() for row in rows]
    label = np.array([CATEGORIES.get(name, name) for name in named], np.str_)
    boxes = turned_boxes(poses[:, :3, 3], size, poses[:, :3, :3], label)
    climb = np.zeros(len(rows)) if boxes.tilt is None else -boxes.tilt[:, 0]
    ahead = np.column_stack((heading_vectors(boxes.yaw) * np.cos(climb)[:, None], np.sin(climb)))
    return boxes, ahead * speed[:, None]


def _read_names(path: Path) -> dict[str, str]:
    """Return the names of agents and tracks by number, from an export's `data_protocol.yaml`; else empty."""
    if not path.is_file():
        return {}
    protocol = read_yaml(path)
    numbers = protocol.get("numbers") if isinstance(protocol, dict) else None
    return {str(number): str(name) for name, number in numbers.items()} if isinstance(numbers, dict) else {}


def _picture(stem: Path, camera: str) -> Path | None:
    """Return the picture of a camera; None where it is missing or an empty file, as one in V2X-Real is."""
    paths = (stem.with_name(f"{stem.name}_{camera}{suffix}") for suffix in PICTURES)
    return next((path for path in paths if path.is_file() and path.stat().st_size), None)


def _find_cloud(stem: Path) -> Path | None:
    return next((path for suffix in CLOUDS if (path := stem.with_suffix(suffix)).is_file()), None)


def _find_scenarios(folder: Path) -> dict[str, Path]:
    """Return the folders of the scenarios in `folder`, by name: folders of agents with a YAML file per frame."""
    for depth in ("*/*.yaml", "*/*/*.yaml", "*/*/*/*.yaml"):
        if frames := [path for path in folder.glob(depth) if path.stem.isdigit()]:
            scenarios = sorted({path.parent.parent for path in frames})
            return name_folders(scenarios)
    raise InputError(f"{folder}: no scenario of OPV2V; agents' folders with a YAML file for each frame are wanted")


def _split_of(scenario: Path) -> str | None:
    name, _ = name_place(scenario)
    return {folder: split for split, folder in FOLDERS.items()}.get(name, "test" if name.startswith("test") else None)

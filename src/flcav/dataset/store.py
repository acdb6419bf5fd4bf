"""Random access to the frames of a recorded dataset."""

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from flcav.config import InputError, path_within, shorten
from flcav.dataset.calibration import Calibrations, read_calibrations
from flcav.dataset.frame_checks import (
    check_calibration,
    check_measurements,
    check_planes,
    check_signs,
    check_values,
    check_views,
)
from flcav.dataset.layout import (
    CALIBRATION,
    FILES,
    LEVEL_FORMAT,
    MANIFEST,
    FrameKey,
    Manifest,
    navigation_path,
    payload_path,
    read_manifest,
    table_path,
    town_path,
    trace_path,
)
from flcav.dataset.navigation_logs import load_logs
from flcav.dataset.payloads import INFRARED, PICTURES, PLANES, POINTS, RADAR, TIMES, read_image, read_plane, read_rows
from flcav.dataset.rows import decode_annotations, decode_vectors, decode_weather
from flcav.dataset.tables import GNSS_COLUMNS, IMU_COLUMNS, SCHEMAS, TILTS, read_table
from flcav.geometry import Array
from flcav.interface.notebook import Displayed
from flcav.sensors.frame import LONGEST_NAME, CameraImage, Frame, format_key
from flcav.sensors.navigation_log import NavigationLog
from flcav.world.map.town import PACKAGED, Town, load_town
from flcav.world.trace import Trace

KINDS = ("lidar", "radar", "cameras", "infrared")  # columns of `frames` that list sensors
NAME = re.compile(rf"[A-Za-z0-9_][A-Za-z0-9_.-]{{0,{LONGEST_NAME - 1}}}")  # names of frames, scenes, agents, sensors

Value = TypeVar("Value")


class Dataset(Displayed):
    """A recorded dataset: its tables in memory, its measurements read from disk on demand.

    >>> from flcav import Dataset
    >>> data = Dataset.open("data")
    >>> len(data), data.name(0)
    (4, 'grid-0-000_0000_cav0')
    >>> data.select(agents=["cav1"])  # numbers of its frames
    [1, 3]
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        calibrations: dict[str, Calibrations],
        tables: dict[str, pa.Table],
        first: dict[str, NDArray[np.int64]],
        *,
        checked: bool = True,
    ) -> None:
        self.folder = folder
        self.manifest = manifest
        self.calibrations = calibrations
        frames = tables["frames"].to_pydict()
        self.keys = [FrameKey(*fields) for fields in zip(*(frames[name] for name in FrameKey.__annotations__))]
        self._name: list[str] = frames["key"]
        self._lidar = [dict(zip(*counts)) for counts in zip(frames["lidar"], frames["points"])]
        self._radar = [dict(zip(*counts)) for counts in zip(frames["radar"], frames["detections"])]
        self._cameras: list[list[str]] = frames["cameras"]
        self._infrared: list[list[str]] = frames["infrared"]
        self._tables = tables
        self._first = first
        self._checked = checked

    @classmethod
    def open(cls, path: Path | str, *, checked: bool = True) -> "Dataset":
        """Return the dataset in the folder `path`; raises `InputError` that names the missing or damaged file.

        With `checked`, `InputError` is also raised for impossible values, here and when frames are read: see
        `flcav.dataset.frame_checks`.
        """
        folder = Path(path)
        manifest = read_manifest(folder)
        absent = {TILTS} if manifest.format == LEVEL_FORMAT else set()
        tables = {
            name: schema.empty_table() if name in absent else read_table(folder / table_path(name), name)
            for name, schema in SCHEMAS.items()
        }
        frames = tables["frames"]
        if not len(frames):
            raise InputError(f"{folder / table_path('frames')}: the dataset is empty, it holds no frames")
        if not tables["poses"]["frame"].equals(frames["key"]):
            raise InputError(f"{folder / table_path('poses')}: its rows are not those of the frames")
        first = {
            name: _first_rows(table, frames, folder / table_path(name))
            for name, table in tables.items()
            if name not in ("frames", "poses")
        }
        if not np.array_equal(np.diff(first["annotations"]), frames["annotations"].to_numpy()):
            raise InputError(f"{folder / table_path('annotations')}: its rows are not those of the frames")
        calibrations = read_calibrations(folder / CALIBRATION, _sensors(frames))
        _check_frames(frames, folder / table_path("frames"))
        if checked:
            _raise_first(folder / table_path("frames"), _find_wrong_names(frames))
            for agent, both in calibrations.items():
                for calibration in both:
                    _raise_first(folder / CALIBRATION, check_calibration(f"the calibration of {agent}", calibration))
        return cls(folder, manifest, calibrations, tables, first, checked=checked)

    def __len__(self) -> int:
        return len(self.keys)

    def __repr__(self) -> str:
        return f"Dataset({str(self.folder)!r}, {len(self)} frames, {len(self.manifest.scenes)} scenes)"

    def numbers(self, frames: Sequence[int] | None) -> Sequence[int]:
        """Return `frames`, or for None the numbers of all frames."""
        return range(len(self)) if frames is None else frames

    def frame(self, i: int) -> Frame:
        """Return frame `i`; its images are read on first access.

        Raises `InputError` where a point cloud or its point times are missing or not of the length in the table, and on
        access to an image that is missing or damaged.
        """
        key = self.keys[i]
        calibration = self.calibrations[self.keys[i].agent]
        poses = self._tables["poses"].slice(i, 1).to_pylist()[0]
        if len(poses["world_from_agent_then"]) != 16 * len(poses["triggered"]):
            raise InputError(f"{self.folder / table_path('poses')}: '{self._name[i]}' needs 16 numbers for each pose")
        then = np.array(poses["world_from_agent_then"], np.float64).reshape(-1, 4, 4)
        frame = Frame(
            scene=key.scene,
            index=key.index,
            time_s=key.time_s,
            agent=key.agent,
            world_from_agent=np.array(poses["world_from_agent"]).reshape(4, 4),
            calibration=calibration.true,
            assumed=calibration.assumed,
            lidar=self._rows_of(i, self._lidar[i], POINTS),
            annotations=decode_annotations(
                *(self._rows(name, i) for name in ("annotations", "points", "views", "signs", TILTS)),
                ranging=(*self._lidar[i], *self._radar[i]),
                cameras=(*self._cameras[i], *self._infrared[i]),
            ),
            point_times=self._point_times(i),
            images=LazyMapping(self._cameras[i], lambda camera: self._image(i, camera)),
            infrared=LazyMapping(self._infrared[i], lambda camera: self._thermal(i, camera)),
            radar=self._rows_of(i, self._radar[i], RADAR),
            gnss=decode_vectors(self._rows("gnss", i), GNSS_COLUMNS),
            imu=decode_vectors(self._rows("imu", i), IMU_COLUMNS),
            weather=decode_weather(self._rows("weather", i)),
            agent_at_trigger=dict(zip(poses["triggered"], then)),
        )
        if self._checked:
            imported = self.manifest.imported is not None
            _raise_first(self.folder, check_values(frame, imported=imported))
            _raise_first(self.folder, check_measurements(frame))
            for camera, views in frame.annotations.views.items():
                _raise_first(self.folder, check_views(frame.key, camera, views, imported=imported))
                _raise_first(self.folder, check_signs(frame.key, camera, frame.annotations.signs[camera]))
        return frame

    def world_from_agent(self, i: int) -> Array:
        """Return the pose (4, 4) of the agent in frame `i` in the world frame [m], without reading measurements."""
        return np.array(self._tables["poses"]["world_from_agent"][i].as_py()).reshape(4, 4)

    def rows(self, name: str) -> tuple[pa.Table, NDArray[np.int64]]:
        """Return a table of `flcav.dataset.tables`, and the number of the frame to which each row belongs (rows,)."""
        table = self._tables[name]
        if name not in self._first:
            return table, np.arange(len(self))
        return table, np.repeat(np.arange(len(self)), np.diff(self._first[name]))

    def plane(self, i: int, camera: str, plane: str) -> NDArray:
        """Return a plane ("rgb", "depth_m", "semantic" or "instance") of an image of frame `i`: see `CameraImage`.

        Raises `InputError` where its file is missing or damaged.
        """
        return read_plane(self.plane_path(i, camera, plane), plane)

    def plane_path(self, i: int, camera: str, plane: str) -> Path:
        """Return the path of the file with a plane of an image of frame `i`."""
        suffixes = PICTURES if plane == "rgb" and self.manifest.imported else (PLANES[plane],)
        paths = [payload_path(camera, self._name[i], suffix) for suffix in suffixes]
        return self.folder / next((path for path in paths if path in self._files), paths[0])

    def trace(self, scene: str) -> Trace | None:
        """Return the traffic of a scene, None if it was not recorded; raises `InputError` where its file is damaged."""
        path = self.folder / trace_path(scene)
        return Trace.load(path) if path.is_file() else None

    def navigation_logs(self, scene: str) -> dict[str, NavigationLog]:
        """Return the navigation logs of a scene by vehicle, empty without any; raises `InputError` as `trace` does."""
        path = self.folder / navigation_path(scene)
        return load_logs(path) if path.is_file() else {}

    def town(self) -> Town | None:
        """Return the town of the dataset, from the dataset's folder or from flcav; None where neither has it."""
        name = str(self.manifest.recipe.get("town", ""))
        if not name:  # imported
            return None
        try:
            kept = path_within(self.folder, town_path(name), self.folder / MANIFEST)
            if kept.is_dir():
                return load_town(kept)
            return load_town(name) if name in PACKAGED else None
        except InputError:
            return None

    def check_labelled(self, what: str) -> None:
        """Raise `InputError` where `what`, "objects" or "signs", is not labelled in an imported dataset."""
        if what not in self.manifest.labels:
            origin = f"imported from {self.manifest.imported}" if self.manifest.imported else "recorded"
            raise InputError(f"{self.folder}: {origin} without labels of {what}")

    def select(
        self,
        *,
        agents: Collection[str] | None = None,
        scenes: Collection[str] | None = None,
        spins: Collection[int] | None = None,
    ) -> list[int]:
        """Return the numbers of the frames of the given agents, scenes and spins, in order; None does not restrict."""
        return [
            i
            for i, key in enumerate(self.keys)
            if (agents is None or key.agent in agents)
            and (scenes is None or key.scene in scenes)
            and (spins is None or key.index in spins)
        ]

    def name(self, i: int) -> str:
        """Return the key of frame `i` as text, see `Frame.key`."""
        return self._name[i]

    def lidars(self, i: int) -> list[str]:
        """Return the names of the LiDARs of frame `i`."""
        return list(self._lidar[i])

    def cameras(self, i: int) -> list[str]:
        """Return the names of the cameras of frame `i`, without the infrared ones."""
        return list(self._cameras[i])

    def radars(self, i: int) -> list[str]:
        """Return the names of the radars of frame `i`."""
        return list(self._radar[i])

    def infrareds(self, i: int) -> list[str]:
        """Return the names of the infrared cameras of frame `i`."""
        return list(self._infrared[i])

    def number(self, name: str) -> int:
        """Return the number of the frame with the key `name`; raises `InputError` where there is none."""
        try:
            return self._name.index(name)
        except ValueError:
            raise InputError(f"{self.folder}: no frame '{name}'; the first is '{self._name[0]}'") from None

    def _rows(self, table: str, i: int) -> pa.Table:
        first, last = int(self._first[table][i]), int(self._first[table][i + 1])
        return self._tables[table].slice(first, last - first)

    def _rows_of(self, i: int, counts: dict[str, int], suffix: str) -> dict[str, NDArray[np.float32]]:
        return {
            sensor: read_rows(self.folder / payload_path(sensor, self._name[i], suffix), suffix, count)
            for sensor, count in counts.items()
        }

    def _point_times(self, i: int) -> dict[str, NDArray[np.float32]]:
        """Return the times (N,) [s] of the points by LiDAR, for LiDARs with a file of them, the rolling ones."""
        timed = {
            sensor: count
            for sensor, count in self._lidar[i].items()
            if payload_path(sensor, self._name[i], TIMES) in self._files
        }
        return {sensor: times[:, 0] for sensor, times in self._rows_of(i, timed, TIMES).items()}

    @cached_property
    def _files(self) -> frozenset[str]:
        """Return the relative paths of all files except the manifest and the tables."""
        return frozenset(read_table(self.folder / table_path(FILES), FILES)["path"].to_pylist())

    def _image(self, i: int, camera: str) -> CameraImage:
        planes = ("rgb",) if self.manifest.imported else PLANES
        image = CameraImage(**{plane: self.plane(i, camera, plane) for plane in planes})
        if self._checked:
            actors = int(np.diff(self._first["annotations"])[i])
            _raise_first(self.folder, check_planes(self._name[i], camera, image, actors))
        return image

    def _thermal(self, i: int, camera: str) -> NDArray[np.uint16]:
        return read_image(self.folder / payload_path(camera, self._name[i], INFRARED), np.uint16)


class LazyMapping(Mapping[str, Value], Generic[Value]):
    """A mapping whose values are read on first access and cached."""

    def __init__(self, names: Collection[str], read: Callable[[str], Value]) -> None:
        self._names, self._read = list(names), read
        self._known: dict[str, Value] = {}

    def __getitem__(self, name: str) -> Value:
        if name not in self._names:
            raise KeyError(name)
        if name not in self._known:
            self._known[name] = self._read(name)
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _raise_first(where: Path, problems: Iterable[str]) -> None:
    """Raise `InputError` with the first of `problems`, if any."""
    for problem in problems:
        raise InputError(f"{where}: {problem}")


def _check_frames(frames: pa.Table, path: Path) -> None:
    """Raise `InputError` where a name is not safe in file names, or the counts of points do not match the sensors."""
    for row in frames.to_pylist():
        names = [row["key"], row["scene"], row["agent"], *(name for kind in KINDS for name in row[kind])]
        if odd := [name for name in names if not NAME.fullmatch(name)]:
            raise InputError(f"{path}: {shorten(odd[0])} is no name: letters, digits, dots, - and _ are")
        for sensors, counts in (("lidar", "points"), ("radar", "detections")):
            if len(row[sensors]) != len(row[counts]) or min(row[counts], default=0) < 0:
                raise InputError(f"{path}: '{row['key']}' needs one number of {counts} for each of its {sensors}s")


def _find_wrong_names(frames: pa.Table) -> Iterator[str]:
    """Yield a sentence for each frame whose key does not match its row or whose time is not finite."""
    for row in frames.to_pylist():
        if row["key"] != format_key(row["scene"], row["index"], row["agent"]):
            yield f"'{row['key']}' is not spin {row['index']} of {row['agent']} in '{row['scene']}'"
        if not np.isfinite(row["time_s"]):
            yield f"'{row['key']}' is at no time"


def _first_rows(table: pa.Table, frames: pa.Table, path: Path) -> NDArray[np.int64]:
    """Return offsets (F + 1,): the rows of frame i in `table` are [offset i, offset i + 1).

    Raises `InputError` where a row belongs to no frame, or the rows are not in the order of the frames.
    """
    number = pc.call_function(
        "index_in", [table["frame"]], pc.SetLookupOptions(value_set=frames["key"].combine_chunks())
    )
    if number.null_count or (np.diff(number.to_numpy()) < 0).any():
        raise InputError(f"{path}: its rows are not those of the frames")
    return np.searchsorted(number.to_numpy(), np.arange(len(frames) + 1))


def _sensors(frames: pa.Table) -> dict[str, set[str]]:
    """Return the names of the LiDARs, radars, cameras and infrared cameras, by agent."""
    sensors: dict[str, set[str]] = defaultdict(set)
    for kind in KINDS:
        for agent, names in zip(frames["agent"].to_pylist(), frames[kind].to_pylist()):
            sensors[agent].update(names)
    return sensors

"""A recorded dataset, read frame by frame in any order."""

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.layout import CALIBRATION, FrameKey, points_path, read_manifest, table_path
from flcav.dataset.tables import SCHEMAS, annotations_of, read_table
from flcav.sensors.frame import Calibration, Frame

POINT_BYTES = 16  # four float32


class Dataset:
    """A dataset folder: tables in memory, point clouds read when asked for."""

    def __init__(
        self, folder: Path, manifest: dict[str, Any], calibration: dict[str, Any], tables: dict[str, pa.Table]
    ) -> None:
        self.folder = folder
        self.manifest = manifest
        self.calibration = {
            agent: Calibration({sensor: np.array(matrix).reshape(4, 4) for sensor, matrix in mounts.items()})
            for agent, mounts in calibration.items()
        }
        frames = tables["frames"].to_pydict()
        self.keys = [FrameKey(*fields) for fields in zip(*(frames[name] for name in FrameKey.__annotations__))]
        self._name: list[str] = frames["key"]
        self._lidar = [dict(zip(*counts)) for counts in zip(frames["lidar"], frames["points"])]
        self._poses = np.array(tables["poses"]["world_from_agent"].to_pylist()).reshape(-1, 4, 4)
        self._annotations = tables["annotations"]
        self._first = np.concatenate(([0], np.cumsum(frames["annotations"]))).astype(int)

    @classmethod
    def open(cls, path: Path | str) -> "Dataset":
        """Return the dataset in the folder `path`; raises `InputError` naming the file that is not as it should be."""
        folder = Path(path)
        manifest = read_manifest(folder)
        tables = {name: read_table(folder / table_path(name), name) for name in SCHEMAS}
        frames = tables["frames"]
        if not len(frames):
            raise InputError(f"{folder / table_path('frames')}: the dataset is empty, it holds no frames")
        if not tables["poses"]["frame"].equals(frames["key"]):
            raise InputError(f"{folder / table_path('poses')}: its rows are not those of the frames")
        expected = np.repeat(frames["key"].to_numpy(), frames["annotations"].to_numpy())
        if not np.array_equal(tables["annotations"]["frame"].to_numpy(), expected):
            raise InputError(f"{folder / table_path('annotations')}: its rows are not those of the frames")
        return cls(folder, manifest, _read_calibration(folder / CALIBRATION, frames), tables)

    def __len__(self) -> int:
        return len(self.keys)

    def frame(self, i: int) -> Frame:
        """Return frame `i`; raises `InputError` where a point cloud is missing or not as long as the table says."""
        key = self.keys[i]
        return Frame(
            scene=key.scene,
            index=key.index,
            time_s=key.time_s,
            agent=key.agent,
            world_from_agent=self._poses[i],
            calibration=self.calibration[key.agent],
            assumed=self.calibration[key.agent],
            lidar={lidar: self._points(i, lidar) for lidar in self._lidar[i]},
            annotations=annotations_of(self._label_rows(i)),
        )

    def payload_bytes(self, i: int) -> int:
        """Return the bytes of frame `i` as a labelled sample: its point clouds and its annotation rows."""
        return sum(self._lidar[i].values()) * POINT_BYTES + self._label_rows(i).nbytes

    def select(
        self,
        *,
        agents: Collection[str] | None = None,
        scenes: Collection[str] | None = None,
        spins: Collection[int] | None = None,
    ) -> list[int]:
        """Return the numbers of the frames of these agents, scenes and spins, in order; None selects all."""
        return [
            i
            for i, key in enumerate(self.keys)
            if (agents is None or key.agent in agents)
            and (scenes is None or key.scene in scenes)
            and (spins is None or key.index in spins)
        ]

    def name(self, i: int) -> str:
        """Return the key of frame `i` as one word: `Frame.key`."""
        return self._name[i]

    def lidars(self, i: int) -> list[str]:
        """Return the names of the LiDARs of frame `i`."""
        return list(self._lidar[i])

    def number(self, name: str) -> int:
        """Return the number of the frame with this key; raises `InputError` where there is none."""
        try:
            return self._name.index(name)
        except ValueError:
            raise InputError(f"{self.folder}: no frame '{name}'; the first is '{self._name[0]}'") from None

    def _label_rows(self, i: int) -> pa.Table:
        first, last = int(self._first[i]), int(self._first[i + 1])
        return self._annotations.slice(first, last - first)

    def _points(self, i: int, lidar: str) -> NDArray[np.float32]:
        path = self.folder / points_path(lidar, self._name[i])
        expected = self._lidar[i][lidar]
        try:
            found = path.stat().st_size
            points = np.fromfile(path, dtype="<f4")
        except FileNotFoundError:
            raise InputError(f"{path}: missing from the dataset") from None
        if found != expected * POINT_BYTES:
            raise InputError(f"{path}: {found} bytes where {expected} points take {expected * POINT_BYTES}")
        return points.reshape(-1, 4)


def _read_calibration(path: Path, frames: pa.Table) -> dict[str, Any]:
    try:
        calibration = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: missing from the dataset") from None
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error})") from None
    for agent, lidars in zip(frames["agent"].to_pylist(), frames["lidar"].to_pylist()):
        for lidar in lidars:
            if len(calibration.get(agent, {}).get(lidar, ())) != 16:
                raise InputError(f"{path}: no mount of the sensor '{lidar}' of '{agent}'")
    return calibration

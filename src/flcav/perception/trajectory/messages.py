"""Samples of trajectories as messages: past, future and surroundings of the road users that a frame's agent sees."""

import zlib
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.geometry import pose
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.trajectory.config import TrajectoryConfig
from flcav.perception.trajectory.samples import Columns, Sample, Surround, pictures_at, samples_of


def pack_frames(data: Dataset, config: TrajectoryConfig, frames: Sequence[int]) -> Iterator[bytes]:
    """Yield the message of each frame: its samples, rasters compressed, or its images.

    With rasters, each agent that observes an instant sends all samples of the instant.
    """
    columns = samples_of(data, config, frames).columns
    instants = [i if config.cameras else (data.keys[i].scene, data.keys[i].index) for i in range(len(data))]
    rows: dict[object, list[int]] = {}
    for row, i in enumerate(columns.frame.tolist()):
        rows.setdefault(instants[i], []).append(row)
    for i in frames:
        own: dict[str, NDArray] = {name: each[rows.get(instants[i], [])] for name, each in columns._asdict().items()}
        own["scene"] = from_names(own["scene"].tolist())
        own["shape"] = np.array(own["raster"].shape)
        own["raster"] = np.frombuffer(zlib.compress(own["raster"].tobytes()), dtype=np.uint8)
        seen = pictures_at(data, i, config.cameras) if config.cameras and len(own["past"]) else None
        yield pack_arrays(own if seen is None else own | dict(zip(Surround._fields, seen, strict=True)))


def unpack_frames(messages: Sequence[bytes]) -> list[Sample]:
    """Return the samples in messages, each once: of several agents, the first one's."""
    found: dict[tuple[int, int], Sample] = {}
    for message in messages:
        arrays = unpack_arrays(message)
        arrays["scene"] = to_names(arrays["scene"])
        packed = zlib.decompress(arrays["raster"].tobytes())
        arrays["raster"] = np.frombuffer(packed, dtype=np.uint8).reshape(arrays["shape"])
        for row in zip(*(arrays[name] for name in Columns._fields), strict=True):
            own = Columns(*map(np.asarray, row))
            seen = None
            if "pictures" in arrays:
                x, y, yaw = own.pose.tolist()
                views = arrays["camera_from_frame"] @ pose(x, y, yaw=yaw)
                seen = Surround(arrays["pictures"], arrays["intrinsics"], views)
            found.setdefault((int(own.frame), int(own.actor)), Sample(*own, surround=seen))
    return [*found.values()]

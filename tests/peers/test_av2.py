"""Argoverse 2's sensor dataset, imported here and read by av2-api: the same points, poses and boxes."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Peer

from flcav.dataset.formats.argoverse2 import AXLE_M, CATEGORIES
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.store import Dataset
from flcav.geometry import transform_points, wrap_angle

LOGS = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[3] / "shared" / "data")) / "argoverse2"


@pytest.mark.skipif(not LOGS.is_dir(), reason=f"no log of Argoverse 2 at {LOGS}; set FLCAV_REAL_DATA")
def test_av2_reads_what_is_imported(peer: Callable[[str], Peer], tmp_path: Path):
    import_dataset("argoverse2", LOGS, tmp_path / "data")
    data = Dataset.open(tmp_path / "data")
    (log,) = LOGS.iterdir()
    read = peer("av2").read(log, tmp_path)
    assert len(read) == len(data)
    for i, (time, said) in enumerate(read.items()):
        frame, truth = data.frame(i), data.frame(i).annotations
        np.testing.assert_allclose(frame.world_from_agent, np.array(said["pose"]) @ _below(AXLE_M), atol=1e-6)
        cloud = np.load(tmp_path / f"{time}.npy")
        ours = transform_points(frame.agent_from_sensor["lidar"], frame.lidar["lidar"][:, :3].astype(float))
        np.testing.assert_allclose(ours - [0, 0, AXLE_M], cloud[:, :3], atol=2e-5)
        np.testing.assert_allclose(frame.lidar["lidar"][:, 3], cloud[:, 3] / 255, atol=1e-6)
        assert truth.boxes.label.tolist() == [CATEGORIES.get(name, name) for name in said["categories"]]
        np.testing.assert_allclose(truth.boxes.center, said["centers"], atol=1e-6)
        np.testing.assert_allclose(truth.boxes.size, said["sizes"], atol=1e-9)
        np.testing.assert_allclose(wrap_angle(truth.boxes.yaw - np.array(said["yaws"])), 0, atol=1e-9)
        np.testing.assert_array_equal(truth.returns, said["inside"])


def _below(height_m: float) -> np.ndarray:
    lowered = np.eye(4)
    lowered[2, 3] = -height_m
    return lowered

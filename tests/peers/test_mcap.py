"""MCAP, by its own package and nothing of Foxglove's: a file tells how it is to be read."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from conftest import Peer

from flcav.dataset.formats.conversion import export
from flcav.dataset.store import Dataset

SCHEMAS = {
    "points": "foxglove.PointCloud",
    "image": "foxglove.CompressedImage",
    "calibration": "foxglove.CameraCalibration",
    "labels": "foxglove.ImageAnnotations",
    "objects": "foxglove.SceneUpdate",
    "tf": "foxglove.FrameTransforms",
    "fix": "foxglove.LocationFix",
    "imu": "flcav.Imu",
    "weather": "flcav.Weather",
}


def test_it_decodes_every_message_with_its_time(together: Dataset, peer: Callable[[str], Peer], tmp_path: Path):
    export(together, "mcap", tmp_path / "out")
    read = peer("mcap").read(tmp_path / "out")
    assert list(read) == sorted(together.manifest.scenes)
    for topics in read.values():
        for name, topic in topics.items():
            assert topic["schema"] == SCHEMAS[name.rpartition("/")[2]], name
    for scene, topics in read.items():
        frames = [together.frame(i) for i in together.select(scenes=[scene])]
        for agent in {frame.agent for frame in frames}:
            own = [frame for frame in frames if frame.agent == agent]
            boxes = topics[f"/{agent}/objects"]
            assert boxes["boxes"] == sum(len(frame.annotations) for frame in own)
            np.testing.assert_allclose(np.array(boxes["times"]) / 1e9, [frame.time_s for frame in own])
            for name in own[0].lidar:
                assert topics[f"/{agent}/{name}/points"]["points"] == sum(len(frame.lidar[name]) for frame in own)
            for name in own[0].images:
                shown = sum(
                    (frame.annotations.views[name].pixels > 0).sum() + len(frame.annotations.signs[name])
                    for frame in own
                )
                assert topics[f"/{agent}/{name}/labels"]["rectangles"] == shown

"""OPV2V's layout, by OpenCOOD's datasets for late, early and intermediate fusion."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import Peer
from recorded import points_in

from flcav.dataset.formats.conversion import export
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, wrap_angle
from flcav.sensors.frame import Frame

OPENCOOD = os.environ.get("FLCAV_OPENCOOD", "")
RANGE = np.array([[-140.0, -40, -3], [140, 40, 1]])  # in which OpenCOOD tests
VEHICLES = ("car", "van", "truck", "bus")
HEARD_M = 70.0  # agents that are further from the ego do not count
TRAIN, TEST = 4, 3  # spins that all agents have


def _apart(one: Frame, other: Frame) -> float:
    places = [frame.world_from_sensor("lidar")[:2, 3] for frame in (one, other)]
    return float(np.linalg.norm(places[0] - places[1]))


@pytest.mark.skipif(not OPENCOOD, reason="no copy of OpenCOOD; name one with FLCAV_OPENCOOD")
def test_its_datasets_find_what_was_recorded(together: Dataset, peer: Callable[[str], Peer], tmp_path: Path):
    export(together, "opv2v", tmp_path / "out")
    read = peer("opencood").read(OPENCOOD, tmp_path / "out")
    assert [read[fusion]["train"] for fusion in ("late", "early", "intermediate")] == [TRAIN] * 3
    assert [len(read[fusion]["test"]) for fusion in ("late", "early", "intermediate")] == [TEST] * 3
    scene = together.manifest.scenes[-1]
    numbers = yaml.safe_load((tmp_path / "out" / "validate" / scene / "data_protocol.yaml").read_text())["numbers"]
    name = {number: name for name, number in numbers.items()}
    ego = name[min(numbers.values())]
    found = 0
    for fusion, content in read.items():
        for spin, sample in enumerate(content["test"]):
            frames = {together.keys[i].agent: together.frame(i) for i in together.select(scenes=[scene], spins=[spin])}
            for agent, seen in sample.items():
                own = frames[ego if agent == "ego" else name[int(agent)]]
                heard = [frame for frame in frames.values() if _apart(frame, own) < HEARD_M]
                shared = [own] if fusion == "late" else heard
                lidar_from_world = inverse(own.world_from_sensor("lidar"))
                truth = {
                    str(frame.annotations.track[i]): frame.annotations.boxes.transform(lidar_from_world)[[i]]
                    for frame in shared
                    for i in np.flatnonzero(points_in(frame) > 0)
                    if str(frame.annotations.boxes.label[i]) in VEHICLES
                }
                tracks = [name[number] for number in seen["numbers"]]
                for track, (x, y, z, height, width, length, yaw) in zip(tracks, seen["boxes"]):
                    box = truth[track]
                    np.testing.assert_allclose((x, -y, z), box.center[0], atol=1e-3)
                    np.testing.assert_allclose((length, width, height), box.size[0], atol=1e-3)
                    assert abs(wrap_angle(-yaw - box.yaw[0])) < 1e-3
                for track, box in truth.items():
                    corners = box.corners()[0]
                    if (corners > RANGE[0] + 0.5).all() and (corners < RANGE[1] - 0.5).all():
                        assert track in tracks
                found += len(tracks)
    assert found > 50

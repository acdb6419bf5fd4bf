"""nuScenes' tables, by nuscenes-devkit: its reading, and the benchmark's evaluation of detection."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from conftest import Peer
from numpy.typing import NDArray
from recorded import echoes_in, in_lidar, points_in

from flcav.dataset.formats.conversion import export
from flcav.dataset.formats.nuscenes.files import CATEGORIES
from flcav.dataset.store import Dataset
from flcav.sensors.frame import Frame

NAMES = {"van": "car"}  # the benchmark's name of an actor, where it is another
FLOOR = 5  # objects of a class on which its measures are looked at


def _doing(category: str, track: str, speed_m_s: float) -> str:
    moves = speed_m_s > 0.2
    if category == "pedestrian":
        return "pedestrian.moving" if moves else "pedestrian.standing"
    if category in ("bicycle", "motorcycle"):
        return "cycle.with_rider"
    return "vehicle.moving" if moves else "vehicle.parked" if track.startswith("parked") else "vehicle.stopped"


def _detections(frame: Frame) -> list[tuple[str, str, list[float], list[float]]]:
    """Return what the benchmark scores: what holds a point of the LiDAR or the radars."""
    truth, boxes = frame.annotations, in_lidar(frame)
    velocity = truth.velocity @ frame.world_from_sensor(next(iter(frame.lidar)))[:3, :3]
    return [
        (
            NAMES.get(category := str(boxes.label[i]), category),
            _doing(category, str(truth.track[i]), float(np.linalg.norm(truth.velocity[i]))),
            boxes.array()[i].tolist(),
            velocity[i].tolist(),
        )
        for i in np.flatnonzero(points_in(frame) + echoes_in(frame))
    ]


def _area(box: NDArray[np.float64]) -> float:
    return float(np.prod(box[2:] - box[:2]))


def test_the_devkit_finds_and_scores_what_was_recorded(together: Dataset, peer: Callable[[str], Peer], tmp_path: Path):
    out = tmp_path / "out"
    export(together, "nuscenes", out)
    frames = {frame.key: frame for frame in (together.frame(i) for i in range(len(together)))}
    detections = {key: _detections(frame) for key, frame in frames.items()}
    (tmp_path / "detections.json").write_text(json.dumps(detections))
    read = peer("nuscenes").read(out, tmp_path / "detections.json", tmp_path / "evaluation")
    assert read["splits"] == {"flcav_train": 4, "flcav_val": 4}  # a scene of theirs is an agent's
    town = together.town()
    assert town is not None
    extent = np.subtract(town.bounds[2:], town.bounds[:2])[::-1]
    np.testing.assert_allclose(np.array(read["mask"]) / 10, extent, atol=0.1)

    assert read["samples"].keys() == frames.keys()
    shares = []
    for key, sample in read["samples"].items():
        frame, truth = frames[key], in_lidar(frames[key])
        row = np.linalg.norm(np.array(sample["centers"])[:, None] - truth.center[None], axis=2).argmin(axis=1)
        assert sorted(row) == list(range(len(truth)))
        assert sample["names"] == [CATEGORIES[str(truth.label[i])] for i in row]
        np.testing.assert_allclose(sample["sizes"], truth.size[row])
        np.testing.assert_allclose(sample["centers"], truth.center[row], atol=1e-6)
        assert sample["said"] == sample["inside"]
        said = np.column_stack((points_in(frame), echoes_in(frame)))[row]
        assert (sample["said"] == said).mean() > 0.999  # a point on a box's side may fall to either
        level = [echoes[:, 0] * np.cos(echoes[:, 2]) for echoes in frame.radar.values()]
        np.testing.assert_allclose(sample["radar_m"], np.sort(np.concatenate([*level, []])), rtol=1e-5)
        assert len(sample["rectangles"]) == len(frame.images)
        for name in frame.images:  # a box seen from the side is as its actor's outline, or larger
            views = frame.annotations.views[name]
            for instance, rectangle in sample["rectangles"]["CAM_FRONT"].items():
                i = row[sample["instances"].index(instance)]
                if views.truncation[i] == 0:
                    left, top, right, bottom = rectangle
                    assert (views.amodal_box[i] >= (left - 1, top - 1, left - 1, top - 1)).all()
                    assert (views.amodal_box[i] <= (right + 1, bottom + 1, right + 1, bottom + 1)).all()
                    shares.append(_area(views.amodal_box[i]) / _area(np.array(rectangle)))
    assert np.mean(shares) > 0.8

    validating = [key for key in frames if key.startswith(together.manifest.scenes[-1])]
    counted = [name for key in validating for name, *_ in detections[key]]
    for name in {name for name in counted if counted.count(name) >= FLOOR}:
        assert min(read["ap"][name].values()) > 0.99, name
        assert read["errors"][name]["trans_err"] < 1e-3
        assert read["errors"][name]["scale_err"] < 1e-3
        assert read["errors"][name]["orient_err"] < 1e-3
        assert read["errors"][name]["attr_err"] in (0, None) or np.isnan(read["errors"][name]["attr_err"])
    assert read["errors"]["car"]["vel_err"] < 0.5

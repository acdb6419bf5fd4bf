"""Fig. 4 of Wang et al. (IEEE Network 37(3), 2023): suites of a crossing and a street registered, associated and fused.

Two LiDARs stand at a crossing of `grid`, on either side of it, a third on the straight street that leads away. Each is
off from where its calibration says. The second and third are registered to the first by generalised ICP on the static
background; then the road detector's boxes of all three are averaged. Two cameras hang beside the first LiDAR and two
beside the third, off as well: their cars are associated with those of the LiDAR, which corrects their extrinsics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.roadside.cameras import CALIBRATED, CORRECTED, CameraResult, associate_camera
from flcav.fusion.average import BoxReport, average_boxes
from flcav.fusion.detector import THRESHOLD, load_road_network
from flcav.fusion.registration import Offset, measure_offset, register
from flcav.fusion.road import MIN_RETURNS
from flcav.geometry import Boxes, inverse, points_in_boxes, transform_points
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.foreground import frame_reader, pole_backgrounds
from flcav.perception.metrics.matching import assign_targets
from flcav.perception.objects.predict import detect
from flcav.perception.objects.truth import CARS
from flcav.report import style
from flcav.report.charts.suites import Shown, draw_suites
from flcav.runs.provenance import Provenance, provenance
from flcav.sensors.calibration import CalibrationError
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.records import Record

CROSSING, STREET = "pole4", "pole2"
ACROSS_M = 24.0  # from the first suite over the crossing to the second
FIRST, SECOND = "lidar", "across"
SUITES = ((CROSSING, FIRST), (CROSSING, SECOND), (STREET, FIRST))
NAMES = ("crossing, near side", "crossing, far side", "straight street")
CAMERAS = {
    (CROSSING, "camera_left"): "crossing, left camera",
    (CROSSING, "camera_right"): "crossing, right camera",
    (STREET, "camera_left"): "straight street, left camera",
    (STREET, "camera_right"): "straight street, right camera",
}
LIDAR = RIGS["lidar_pole"].lidars["lidar"].model_dump(mode="json")
RECIPE: dict[str, Any] = {
    "town": "grid",
    "seed": 8402,
    "split": "test",
    "scenes": 10,
    "spins_per_scene": 2,
    "every_s": 6.0,
    "cavs": 0,
    "poles": [2, 4],
    "pole_rig": {
        "lidars": {FIRST: LIDAR, SECOND: {**LIDAR, "mount": {"x": ACROSS_M, "yaw_deg": 180.0}}},
        "cameras": {name: each.model_dump(mode="json") for name, each in RIGS["roadside"].cameras.items()},
    },
    "calibration_error": {"position_m": 0.3, "rotation_deg": 1.5},
}
SWEEPS = 4  # of each suite, whose backgrounds are registered together
EDGES_M = tuple(range(0, 91, 10))  # of distance from the first suite
OVERLAP = 0.5  # bird's-eye IoU of a car that was found
ARMS = ("first suite alone", "three suites as calibrated", "three suites registered")
REACHED = 0.8  # recall that makes a range

Found = Mapping[tuple[int, str], Boxes]  # cars in a sweep, LiDAR frame, by frame number and LiDAR


@dataclass(frozen=True)
class Suite:
    """A suite's pose in the frame of the first one: how far off before and after the registration."""

    name: str
    apart_m: float  # from the first suite
    before: Offset
    after: Offset


@dataclass(frozen=True)
class Fig4(Record):
    """Residuals of registered suites, the share of cars found against distance, and the cameras' associations."""

    suites: tuple[Suite, ...]  # the second and the third
    cars: tuple[int, ...]  # seen by any suite, in each interval of `EDGES_M`
    found: dict[str, tuple[int, ...]]  # of these, by arm
    range_m: dict[str, float]  # to which an arm finds the share `REACHED` of the cars; 0 where nowhere
    cameras: tuple[CameraResult, ...]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return residuals and ranges in words."""
        told = [
            f"{each.name}, {each.apart_m:.0f} m away: off by {each.before.position_cm:.0f} cm and "
            f"{each.before.rotation_deg:.2f} degrees as calibrated, {each.after.position_cm:.1f} cm and "
            f"{each.after.rotation_deg:.2f} degrees registered"
            for each in self.suites
        ]
        told += [f"{arm}: {REACHED:.0%} of the cars are found up to {self.range_m[arm]:.0f} m" for arm in ARMS]
        for each in self.cameras:
            before, after = (each.by_extrinsics[name] for name in (CALIBRATED, CORRECTED))
            told.append(
                f"{each.name}: of {each.cars} cars {before.found} are rightly associated as calibrated, off by "
                f"{before.off.rotation_deg:.2f} degrees, {after.found} corrected, off by {after.off.rotation_deg:.2f}"
                + ("" if each.settled else "; the pairs had not settled")
            )
        return told


def fig4(out: Path, progress: Report = ignore_progress) -> tuple[Fig4, dict[str, bytes]]:
    """Record the suites into `out`; return the numbers of the figure, and its picture as PNG by file name.

    Raises `InputError` where small_gicp is not installed.
    """
    record(EmbeddedSource(parse_config(Recipe, RECIPE, "fig4")), out / "data", progress=progress)
    data = Dataset.open(out / "data")
    truth = [_pose(data, agent, lidar, assumed=False) for agent, lidar in SUITES]
    calibrated = [_pose(data, agent, lidar, assumed=True) for agent, lidar in SUITES]
    clouds = [_background(data, agent, lidar) for agent, lidar in SUITES]
    guess = [inverse(calibrated[0]) @ each for each in calibrated]
    exact = [inverse(truth[0]) @ each for each in truth]
    registered = [np.eye(4), *(register(clouds[0], c, g) for c, g in zip(clouds[1:], guess[1:], strict=True))]
    suites = tuple(
        Suite(
            NAMES[row],
            float(np.linalg.norm(exact[row][:3, 3])),
            measure_offset(exact[row], guess[row]),
            measure_offset(exact[row], registered[row]),
        )
        for row in (1, 2)
    )
    placed = {ARMS[0]: guess[:1], ARMS[1]: guess, ARMS[2]: registered}
    boxes = _detect_cars(data)
    cars, found = _count_found(data, boxes, truth[0], placed)
    ranges = {arm: find_range(EDGES_M, cars, counts) for arm, counts in found.items()}
    error = parse_config(CalibrationError, RECIPE["calibration_error"], "fig4")
    cameras = tuple(
        associate_camera(data, pole, FIRST, camera, name, lambda number: boxes[number, FIRST], error)
        for (pole, camera), name in CAMERAS.items()
    )
    result = Fig4(suites, cars, found, ranges, cameras, provenance())
    shown = [
        Shown(
            arm,
            [transform_points(pose, cloud[:, :3]) for pose, cloud in zip(placed[arm], clouds, strict=True)],
            [pose[:3, 3] for pose in placed[arm]],
        )
        for arm in ARMS[1:]
    ]
    shares = {arm: [f / c if c else None for f, c in zip(own, cars, strict=True)] for arm, own in found.items()}
    return result, {"fig4.png": style.png(draw_suites(shown, NAMES, EDGES_M, shares))}


def _pose(data: Dataset, agent: str, lidar: str, *, assumed: bool) -> NDArray[np.float64]:
    """Return the (4, 4) `world_from_lidar` of a suite, by its calibration or the true one."""
    number, both = data.select(agents={agent})[0], data.calibrations[agent]
    mounts = both.assumed if assumed else both.true
    return data.world_from_agent(number) @ mounts.agent_from_sensor[lidar]


def _background(data: Dataset, agent: str, lidar: str) -> NDArray[np.float32]:
    """Return the returns (N, 4) of the static background in a few sweeps of a suite, its own frame."""
    behind = pole_backgrounds(data, agent)[lidar]
    sweeps = [data.frame(number).lidar[lidar] for number in data.select(agents={agent})[:SWEEPS]]
    return np.concatenate([sweep[~behind.in_front(sweep)] for sweep in sweeps])


def _detect_cars(data: Dataset) -> Found:
    """Return the cars that the road detector finds in every sweep of the suites."""
    network = load_road_network()
    read = frame_reader(data, network.config.foreground)
    return {
        (number, lidar): detect(network, read(number).lidar[lidar], score_threshold=THRESHOLD)
        for agent, lidar in SUITES
        for number in data.select(agents={agent})
    }


def _count_found(
    data: Dataset, found: Found, world_from_first: NDArray[np.float64], placed: dict[str, list[NDArray[np.float64]]]
) -> tuple[tuple[int, ...], dict[str, tuple[int, ...]]]:
    """Return the cars in each interval of `EDGES_M` and those that each arm finds, over all spins.

    A car counts where one of the suites has `MIN_RETURNS` from it. Boxes are compared in the first suite's frame.
    """
    cars = np.zeros(len(EDGES_M) - 1, dtype=np.int64)
    hits = {arm: np.zeros_like(cars) for arm in placed}
    frames = {(data.keys[n].scene, data.keys[n].index, data.keys[n].agent): n for n in range(len(data))}
    for scene, spin in dict.fromkeys((key.scene, key.index) for key in data.keys):
        views = [(frames[scene, spin, agent], lidar) for agent, lidar in SUITES]
        boxes = [found[view] for view in views]
        targets = list_cars(data, views).transform(inverse(world_from_first))
        distance = np.linalg.norm(targets.center[:, :2], axis=1)
        cars += np.histogram(distance, EDGES_M)[0]
        for arm, poses in placed.items():
            told = [BoxReport(f"suite{row}", 0.0, boxes[row].transform(pose)) for row, pose in enumerate(poses)]
            labels = average_boxes(told, 0.0).boxes
            target = assign_targets(labels, targets, OVERLAP, "bev")
            hits[arm] += np.histogram(distance[target[target >= 0]], EDGES_M)[0]
    return tuple(cars.tolist()), {arm: tuple(counts.tolist()) for arm, counts in hits.items()}


def list_cars(data: Dataset, views: Sequence[tuple[int, str]]) -> Boxes:
    """Return the cars of one spin, world frame, with `MIN_RETURNS` of one of the `views`: frame number and LiDAR."""
    truth = data.frame(views[0][0]).annotations
    most = np.zeros(len(truth), dtype=np.int64)
    for number, lidar in views:
        frame = data.frame(number)
        points = transform_points(frame.world_from_sensor(lidar), frame.lidar[lidar][:, :3].astype(np.float64))
        most = np.maximum(most, points_in_boxes(points, truth.boxes).sum(axis=1))
    seen = truth.boxes[np.isin(truth.boxes.label, CARS) & (most >= MIN_RETURNS)]
    return replace(seen, label=np.full(len(seen), "Car"))


def find_range(edges_m: Sequence[float], cars: Sequence[int], found: Sequence[int]) -> float:
    """Return the far edge of the last interval in which the share `REACHED` of the cars is found; 0 where in none.

    cars, found: in each interval between `edges_m`. What is nearer counts not: right below a sensor is a blind spot.
    """
    every, own = np.array(cars), np.array(found)
    good = np.flatnonzero((own >= REACHED * every) & (every > 0))
    return float(edges_m[good[-1] + 1]) if len(good) else 0.0

"""Fig. 4 of Wang et al. (IEEE Network 37(3), 2023): suites of a crossing and a street registered, associated and fused.

Two LiDARs stand at a crossing of `grid`, one on each side, a third on the straight street that leads away from it. The
pose of each is off from its calibration. The second and third are registered to the first by generalised ICP on the
static background; then the road detector's boxes of all three are averaged. Two cameras are mounted next to the first
LiDAR and two next to the third, with calibration errors as well. Their cars are associated with those of the LiDAR,
which corrects their extrinsics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.fusion.average import BoxReport, average_boxes
from flcav.fusion.registration import Offset, measure_offset, register_clouds
from flcav.fusion.road import MIN_RETURNS, THRESHOLD, load_road_network
from flcav.geometry import Boxes, inverse, points_in_boxes, transform_points
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.agents import frame_reader, pole_backgrounds
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.predict import detect
from flcav.perception.objects.truth import CARS
from flcav.report import style
from flcav.reproductions.fig4.cameras import CALIBRATED, CORRECTED, CameraResult, associate_camera, tabulate_cameras
from flcav.runs.provenance import Provenance, provenance
from flcav.sensors.rig import RIGS, CalibrationError
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.markdown import format_table
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
SWEEPS = 4  # of each suite: the returns of their static background are registered
EDGES_M = tuple(range(0, 91, 10))  # of distance from the first suite
OVERLAP = 0.5  # least bird's-eye IoU with a box for a car to count as found
ARMS = ("first suite alone", "three suites as calibrated", "three suites registered")
REACHED = 0.8  # least recall within an arm's range

Found = Mapping[tuple[int, str], Boxes]  # cars in a sweep, LiDAR frame, by frame number and LiDAR


@dataclass(frozen=True)
class Suite:
    """Errors of a suite's pose in the frame of the first suite, before and after the registration."""

    name: str
    apart_m: float  # from the first suite
    before: Offset
    after: Offset


@dataclass(frozen=True)
class Fig4(Record):
    """Pose errors of registered suites, the share of cars found against distance, and the cameras' associations."""

    suites: tuple[Suite, ...]  # the second and the third
    cars: tuple[int, ...]  # seen by any suite, in each interval of `EDGES_M`
    found: dict[str, tuple[int, ...]]  # by arm: of these, how many it finds
    range_m: dict[str, float]  # by arm: distance up to which it finds the share `REACHED` of the cars; 0 where nowhere
    cameras: tuple[CameraResult, ...]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return residuals and ranges in words."""
        sentences = [
            f"{suite.name}, {suite.apart_m:.0f} m away: off by {suite.before.position_cm:.0f} cm and "
            f"{suite.before.rotation_deg:.2f} degrees as calibrated, {suite.after.position_cm:.1f} cm and "
            f"{suite.after.rotation_deg:.2f} degrees registered"
            for suite in self.suites
        ]
        sentences += [f"{arm}: {REACHED:.0%} of the cars are found up to {self.range_m[arm]:.0f} m" for arm in ARMS]
        for camera in self.cameras:
            before, after = (camera.by_extrinsics[name] for name in (CALIBRATED, CORRECTED))
            sentences.append(
                f"{camera.name}: of {camera.cars} cars {before.found} are rightly associated as calibrated, off by "
                f"{before.off.rotation_deg:.2f} degrees, {after.found} corrected, off by {after.off.rotation_deg:.2f}"
                + ("" if camera.settled else "; the pairs had not settled")
            )
        return sentences


def fig4(out: Path, progress: Report = ignore_progress) -> tuple[Fig4, dict[str, bytes]]:
    """Record the suites into `out`; return the figure's numbers, and its picture as a PNG by file name.

    Raises `InputError` where small_gicp is not installed.
    """
    record(EmbeddedSource(parse_config(Recipe, RECIPE, "fig4")), out / "data", progress=progress)
    data = Dataset.open(out / "data")
    truth = [_pose(data, agent, lidar, assumed=False) for agent, lidar in SUITES]
    calibrated = [_pose(data, agent, lidar, assumed=True) for agent, lidar in SUITES]
    clouds = [_background(data, agent, lidar) for agent, lidar in SUITES]
    guess = [inverse(calibrated[0]) @ world_from_lidar for world_from_lidar in calibrated]
    exact = [inverse(truth[0]) @ world_from_lidar for world_from_lidar in truth]
    registered = [np.eye(4), *(register_clouds(clouds[0], c, g) for c, g in zip(clouds[1:], guess[1:], strict=True))]
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
    shares = {arm: [f / c if c else None for f, c in zip(hits, cars, strict=True)] for arm, hits in found.items()}
    return result, {"fig4.png": style.png(draw_suites(shown, NAMES, EDGES_M, shares))}


def _pose(data: Dataset, agent: str, lidar: str, *, assumed: bool) -> NDArray[np.float64]:
    """Return the (4, 4) `world_from_lidar` of a suite, by its calibration or the true one."""
    number, both = data.select(agents={agent})[0], data.calibrations[agent]
    mounts = both.assumed if assumed else both.true
    return data.world_from_agent(number) @ mounts.agent_from_sensor[lidar]


def _background(data: Dataset, agent: str, lidar: str) -> NDArray[np.float32]:
    """Return the returns (N, 4) of the static background in `SWEEPS` sweeps of a suite, LiDAR frame."""
    background = pole_backgrounds(data, agent)[lidar]
    sweeps = [data.frame(number).lidar[lidar] for number in data.select(agents={agent})[:SWEEPS]]
    return np.concatenate([sweep[~background.in_front(sweep)] for sweep in sweeps])


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
    """Return how many cars are in each interval of `EDGES_M`, and how many of them each arm finds, over all spins.

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
            reports = [BoxReport(f"suite{row}", 0.0, boxes[row].transform(pose)) for row, pose in enumerate(poses)]
            labels = average_boxes(reports, 0.0).boxes
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

    cars, found: in each interval between `edges_m`. Nearer intervals may hold less: right below a sensor is a blind
    spot.
    """
    cars_in, found_in = np.array(cars), np.array(found)
    good = np.flatnonzero((found_in >= REACHED * cars_in) & (cars_in > 0))
    return float(edges_m[good[-1] + 1]) if len(good) else 0.0


SUITE_COLOURS = (style.BLUE, style.VERMILLION, style.GREEN)
ARM_COLOURS = (style.MUTED, style.ORANGE, style.BLUE)
BAND_M = (-5.2, 0.5)  # heights relative to the first suite's LiDAR that are drawn: walls and trees without the ground
VIEW_M = (-22.0, 62.0, -48.0, 36.0)  # least and most x, least and most y in the first suite's frame
CLOSE_M = 6.0  # half the edge of the close-up


@dataclass(frozen=True)
class Shown:
    """A map to draw: the clouds of all suites in the frame of the first one."""

    title: str
    clouds: Sequence[NDArray]  # (N, 3) each
    places: Sequence[NDArray]  # (3,) of each suite


@style.styled
def draw_suites(
    shown: Sequence[Shown],
    names: Sequence[str],
    edges_m: Sequence[float],
    shares: Mapping[str, Sequence[float | None]],
) -> Figure:
    """Return the figure: a map of the clouds for each of `shown`, with a close-up below; recall against distance.

    shares: by arm, in the intervals between `edges_m`; None where there is nothing to find.
    """
    figure = style.canvas(9.6, 6.4)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.25, 1))
    corner = _choose_corner(shown[-1].clouds)
    for column, view in enumerate(shown):
        wide, near = figure.add_subplot(grid[0, column]), figure.add_subplot(grid[1, column])
        for cloud, colour in zip(view.clouds, SUITE_COLOURS, strict=True):
            in_band = cloud[(cloud[:, 2] > BAND_M[0]) & (cloud[:, 2] < BAND_M[1])]
            wide.plot(*in_band[:, :2].T, ".", color=colour, markersize=0.7, markeredgewidth=0)
            near.plot(*in_band[:, :2].T, ".", color=colour, markersize=2.2, markeredgewidth=0)
        for number, ((x, y, _), colour) in enumerate(zip(view.places, SUITE_COLOURS, strict=True), start=1):
            wide.plot(x, y, "o", markersize=12, color=colour, markeredgecolor="white")
            wide.text(x, y, str(number), color="white", ha="center", va="center_baseline", fontsize=style.SMALL)
        wide.set(xlim=VIEW_M[:2], ylim=VIEW_M[2:], aspect="equal", title=view.title)
        x, y = corner
        near.set(xlim=(x - CLOSE_M, x + CLOSE_M), ylim=(y - CLOSE_M, y + CLOSE_M), aspect="equal", title="close-up")
        wide.plot(*_square(x, y), color=style.INK, linewidth=1)
        for axes, bar_m in ((wide, 20), (near, 5)):
            style.hide_axes(axes)
            style.scale_bar(axes, bar_m)
    axes, below = figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2])
    middle = (np.array(edges_m[:-1]) + np.array(edges_m[1:])) / 2
    for (arm, values), colour in zip(shares.items(), ARM_COLOURS, strict=True):
        shares_of_arm = np.array([np.nan if value is None else value for value in values])
        axes.plot(middle, shares_of_arm, "o-", color=colour, markersize=4, label=arm)
    axes.set(
        ylim=(0, 1.02), xlim=(0, edges_m[-1]), xlabel="distance from the first suite [m]", title="share of cars found"
    )
    axes.grid(axis="y")
    below.legend(handles=axes.get_lines(), loc="upper left", frameon=False)  # curves fill the axes themselves
    style.hide_axes(below)
    handles = [
        axes.plot([], [], "o", color=colour, label=f"{number}: {name}")[0]
        for number, (name, colour) in enumerate(zip(names, SUITE_COLOURS, strict=True), start=1)
    ]
    style.key(figure, handles)
    return figure


def _choose_corner(clouds: Sequence[NDArray]) -> tuple[float, float]:
    """Return the place x, y in view where two suites' clouds overlap most."""
    counts = []
    for cloud in clouds:
        drawn = cloud[(cloud[:, 2] > BAND_M[0]) & (cloud[:, 2] < BAND_M[1])]
        counts.append(np.histogram2d(*drawn[:, :2].T, bins=(14, 14), range=(VIEW_M[:2], VIEW_M[2:]))[0])
    common = np.sort(np.stack(counts), axis=0)[-2]  # points of the suite with second most: large where two have many
    row, column = np.unravel_index(int(common.argmax()), common.shape)
    step = (VIEW_M[1] - VIEW_M[0]) / 14, (VIEW_M[3] - VIEW_M[2]) / 14
    return VIEW_M[0] + (row + 0.5) * step[0], VIEW_M[2] + (column + 0.5) * step[1]


def _square(x: float, y: float) -> tuple[NDArray, NDArray]:
    ends = np.array((-CLOSE_M, CLOSE_M, CLOSE_M, -CLOSE_M, -CLOSE_M))
    return x + ends, y + np.roll(ends, 1)


def fig4_tables(results: Fig4) -> dict[str, str]:
    """Return Markdown by name: residuals, range, cameras."""
    rows = [
        [
            suite.name,
            f"{suite.apart_m:.0f}",
            f"{suite.before.position_cm:.0f} cm, {suite.before.rotation_deg:.2f}°",
            f"{suite.after.position_cm:.2f} cm, {suite.after.rotation_deg:.3f}°",
        ]
        for suite in results.suites
    ]
    intervals = list(pairwise(EDGES_M))
    found = [
        [
            arm,
            *(f"{f / c:.2f}" if c else "" for f, c in zip(results.found[arm], results.cars)),
            f"{results.range_m[arm]:.0f}",
        ]
        for arm in ARMS
    ]
    header = ("share of cars found", *(f"{low}–{high} m" for low, high in intervals), "range [m]")
    return {
        "residuals": format_table(("suite", "from the first [m]", "off as calibrated", "off as registered"), rows),
        "range": format_table(header, [["cars", *results.cars, ""], *found]),
        "cameras": tabulate_cameras(results.cameras),
    }


def _run(out: Path, options: Options) -> Outcome[Fig4]:
    with options.show_progress(options.title) as report:
        results, pictures = fig4(out, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(Fig4, _run, fig4_tables, takes=())

"""AP50 of the road average against errors of poses, clocks and radio: naive, weighted by uncertainty, pose graph.

Labels are evaluated online: those of a spin are averaged from the messages that have arrived by then. AP ranks the
labels of all scenes and spins together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.fusion.average import Navigation, RoadAverage, Sighting, average_boxes, report_boxes
from flcav.fusion.distillation import MapContext, build_context, snap_to_map
from flcav.fusion.pose_graph import correct_poses, posts_of, segment_posts
from flcav.fusion.road import load_road_network, road_detector
from flcav.geometry import Boxes, concatenate, inverse, pose, transform_points, wrap_angle, yaw_of
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.agents import POLE, kind_of
from flcav.perception.metrics import average_precision, match
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.networks import resolve_network
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.predict import detect
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import choose_lidar, ground_truth
from flcav.report import style
from flcav.report.charts.roadside import draw_errors
from flcav.runs.provenance import Provenance, provenance
from flcav.sensors.frame import Frame
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.streams import stream
from flcav.storage.markdown import format_table
from flcav.storage.records import Record
from flcav.world.map.lanes import map_layers


@dataclass(frozen=True)
class Errors:
    """Standard deviations of the errors of vehicles, and latency and loss of the messages of all agents."""

    position_m: float = 0.0  # along x and along y, redrawn at each spin
    constant_m: float = 0.0  # along x and along y, constant over a scene
    heading_deg: float = 0.0  # redrawn at each spin
    latency_s: float = 0.0  # delay of every message
    loss: float = 0.0  # probability that a message is lost
    clock_s: float = 0.0  # offset of a vehicle's clock, constant over a scene

    @property
    def navigation(self) -> Navigation:
        """Return the accuracy that a vehicle's navigation states: at least a centimetre and .001 rad."""
        sigma_m = np.hypot(self.position_m, self.constant_m)
        return Navigation(max(float(sigma_m), 0.01), max(float(np.radians(self.heading_deg)), 0.001))


def apply_errors(sightings: Sequence[Sighting], errors: Errors, rng: np.random.Generator) -> list[Sighting]:
    """Return the sightings of a scene that arrive, with errors in the poses and clocks of vehicles.

    A generator draws the same numbers for errors of all sizes, so that sizes can be compared.
    """
    agents = sorted({sighting.agent for sighting in sightings})
    constant = {agent: rng.standard_normal(3) for agent in agents}
    arrived = []
    for sighting in sightings:
        drawn, lost = rng.standard_normal(3), rng.random() < errors.loss
        if lost:
            continue
        if sighting.navigation is not None:
            fixed = constant[sighting.agent]
            dx, dy = errors.position_m * drawn[:2] + errors.constant_m * fixed[:2]
            turned = pose(0, 0, 0, float(np.radians(errors.heading_deg) * drawn[2]))
            off = sighting.world_from_agent @ turned
            off[:2, 3] = sighting.world_from_agent[:2, 3] + (dx, dy)
            clock_s = sighting.time_s + errors.clock_s * float(fixed[2])
            sighting = replace(sighting, world_from_agent=off, time_s=clock_s, navigation=errors.navigation)
        arrived.append(sighting)
    return arrived


SCORE = 0.1  # lowest score of a detection that an agent sends
EXACT = Navigation(0.01, 0.001)  # [m], [rad]
CAR = "Car"


@dataclass(frozen=True)
class Truth:
    """Cars at one spin, world frame: targets, which the sensors could find, and neutral ones."""

    targets: Boxes
    neutral: Boxes


@dataclass(frozen=True)
class SightedScene:
    """The sightings of all agents in one scene, in the order of their spins, and the ground truth at each spin."""

    sightings: tuple[Sighting, ...]
    spin: tuple[int, ...]  # of each sighting
    truth: Mapping[int, Truth]  # by spin
    time_s: Mapping[int, float]


def read_scenes(data: Dataset, progress: Report = ignore_progress) -> dict[str, SightedScene]:
    """Return the scenes of a dataset by name: detections by the package's networks, posts segmented from sweeps.

    Cars are targets where they have five returns or more of a sensor, within the range of its network.
    """
    vehicles = resolve_network(OBJECTS, None)
    find, road = road_detector(data, SCORE), load_road_network().config
    rows: dict[str, list[tuple[int, Sighting]]] = {}
    tracks: dict[tuple[str, int], dict[str, tuple[Boxes, bool]]] = {}
    times: dict[tuple[str, int], float] = {}
    for number, key in enumerate(data.keys):
        frame = data.frame(number)
        if kind_of(key.agent) == POLE:
            found = find(number)
            found = replace(found, label=np.full(len(found), CAR))
            cars = found.transform(inverse(frame.world_from_agent))
            sighting = Sighting(key.agent, key.time_s, frame.world_from_agent, cars)
        else:
            lidar = choose_lidar(frame)
            agent_from_lidar = frame.agent_from_sensor[lidar]
            found = detect(vehicles, frame.lidar[lidar], score_threshold=SCORE)
            posts = segment_posts(transform_points(agent_from_lidar, frame.lidar[lidar][:, :3]), 0.0)
            cars = found[found.label == CAR].transform(agent_from_lidar)
            sighting = Sighting(key.agent, key.time_s, frame.world_from_agent, cars, posts, EXACT)
        rows.setdefault(key.scene, []).append((key.index, sighting))
        times[key.scene, key.index] = key.time_s
        seen = tracks.setdefault((key.scene, key.index), {})
        _add_truth(seen, frame, road if kind_of(key.agent) == POLE else vehicles.config)
        progress(number + 1, len(data), "")
    return {
        scene: SightedScene(
            tuple(sighting for _, sighting in sightings),
            tuple(spin for spin, _ in sightings),
            {spin: _truth(seen) for (name, spin), seen in tracks.items() if name == scene},
            {spin: time_s for (name, spin), time_s in times.items() if name == scene},
        )
        for scene, sightings in rows.items()
    }


def _add_truth(seen: dict[str, tuple[Boxes, bool]], frame: Frame, config: SecondConfig) -> None:
    """Add the cars of a frame to `seen`, by track, world frame; True for those that some agent so far could find."""
    truth = ground_truth(frame, config)
    for row in np.flatnonzero((truth.boxes.label == CAR) | truth.lookalike):
        track = str(frame.annotations.track[row])
        box = replace(frame.annotations.boxes[[row]], label=np.array([CAR]))
        target = bool(truth.target[row])
        if track not in seen or target:
            seen[track] = box, target


def _truth(seen: Mapping[str, tuple[Boxes, bool]]) -> Truth:
    return Truth(
        concatenate([box for box, target in seen.values() if target]),
        concatenate([box for box, target in seen.values() if not target]),
    )


RECIPE = {
    "town": "grid",
    "seed": 8101,
    "split": "test",
    "scenes": 3,
    "spins_per_scene": 12,
    "every_s": 0.5,
    "cavs": 4,
    "poles": "all",
    "vehicle_rig": "kitti_lidar",
}
WINDOW_S = 1.5  # time before a spin whose sightings are averaged
SPINS = (3, 7, 11)  # at which labels are evaluated
NAIVE, WEIGHTED, GRAPH = "naive", "weighted by uncertainty", "pose graph"
ARMS = (NAIVE, WEIGHTED, GRAPH)
SEEDS = 5
BOTH = "position .5 m, heading 2°"
KNOBS: Mapping[str, Mapping[float, Errors]] = {
    "position, white [m]": {size: Errors(position_m=size) for size in (0.0, 0.25, 0.5, 1.0)},
    "position, constant [m]": {size: Errors(constant_m=size) for size in (0.0, 0.5, 1.0)},
    "heading [°]": {size: Errors(heading_deg=size) for size in (0.0, 2.0, 4.0)},
    "latency [s]": {size: Errors(latency_s=size) for size in (0.0, 0.5, 1.0)},
    "share of messages lost": {size: Errors(loss=size) for size in (0.0, 0.25, 0.5)},
    "clock offset [s]": {size: Errors(clock_s=size) for size in (0.0, 0.2, 0.4)},
}
JOINT = Errors(position_m=0.5, heading_deg=2.0)
CORRECTED: Mapping[str, Errors] = {  # errors of which the residuals after the pose graph are measured
    BOTH: JOINT,
    "position .5 m, constant": Errors(constant_m=0.5),
    "clock .2 s": Errors(clock_s=0.2),
    "clock .4 s": Errors(clock_s=0.4),
}


@dataclass(frozen=True)
class Point:
    """AP50 of one arm at one size of an error."""

    size: float
    ap50: tuple[float, ...]  # by seed

    @property
    def mean(self) -> float:
        """Return the mean over seeds."""
        return float(np.mean(self.ap50))


@dataclass(frozen=True)
class Snapped:
    """Labels at exact poses, before and after their headings are snapped to the map."""

    matched: int  # labels that match a car
    heading_deg: tuple[float, float]  # mean error of their heading, before and after
    reversed_: tuple[int, int]  # labels that face the wrong way, before and after
    ap50: tuple[float, float]


@dataclass(frozen=True)
class Residual:
    """Mean absolute errors of the poses and times of vehicles' sightings."""

    position_cm: float
    heading_deg: float
    clock_ms: float


@dataclass(frozen=True)
class RoadAverageResult(Record):
    """AP50 of the road average against each error, by arm."""

    cars: int  # targets over all evaluated spins
    knobs: Mapping[str, Mapping[str, tuple[Point, ...]]]  # by knob and arm
    joint: Mapping[str, Point]  # at `JOINT`, by arm
    clean: Mapping[str, float]  # without errors, by arm
    snapped: Snapped
    residuals: Mapping[str, tuple[Residual, Residual]]  # by name in `CORRECTED`: as stated, and after the pose graph
    provenance: Provenance

    @property
    def won_back(self) -> float:
        """Return the share of naive averaging's loss at `JOINT` that the pose graph wins back."""
        lost = self.clean[NAIVE] - self.joint[NAIVE].mean
        return (self.joint[GRAPH].mean - self.joint[NAIVE].mean) / lost

    def sentences(self) -> list[str]:
        """Return the main numbers as sentences."""
        clean = ", ".join(f"{arm} {self.clean[arm]:.3f}" for arm in ARMS)
        joint = ", ".join(f"{arm} {self.joint[arm].mean:.3f}" for arm in ARMS)
        return [
            f"AP50 of the labels without errors: {clean}",
            f"at {BOTH}, {SEEDS} seeds: {joint}; the pose graph wins back {self.won_back:.0%} of the loss",
        ]

    def pictures(self) -> dict[str, bytes]:
        """Return the chart of all errors and sizes as a PNG, by file name."""
        panels = {
            knob: {arm: [(p.size, p.mean, min(p.ap50), max(p.ap50)) for p in self.knobs[knob][arm]] for arm in ARMS}
            for knob in KNOBS
        }
        return {"knobs.png": style.png(draw_errors(panels))}


def evaluate_road_average(out: Path, progress: Report = ignore_progress) -> tuple[RoadAverageResult, dict[str, bytes]]:
    """Record scenes into `out`, and detect in all frames; return the results, and PNG files by name."""
    record(EmbeddedSource(parse_config(Recipe, RECIPE, "road-average")), out / "data")
    data = Dataset.open(out / "data")
    town = data.town()
    assert town is not None  # one of the package's
    scenes, posts = read_scenes(data), posts_of(town)
    clean = {arm: _precision(scenes, Errors(), arm, posts, 0) for arm in ARMS}
    jobs = [(knob, size, errors) for knob, sizes in KNOBS.items() for size, errors in sizes.items()]
    knobs: dict[str, dict[str, list[Point]]] = {knob: {arm: [] for arm in ARMS} for knob in KNOBS}
    for done, (knob, size, errors) in enumerate(jobs):
        for arm in ARMS:
            knobs[knob][arm].append(_point(scenes, size, errors, arm, posts, clean[arm]))
        progress(done + 1, len(jobs) + 1, knob)
    results = RoadAverageResult(
        cars=sum(len(scene.truth[spin].targets) for scene in scenes.values() for spin in SPINS),
        knobs={knob: {arm: tuple(points) for arm, points in arms.items()} for knob, arms in knobs.items()},
        joint={arm: _point(scenes, 0.5, JOINT, arm, posts, clean[arm]) for arm in ARMS},
        clean=clean,
        snapped=_snap(scenes, build_context(map_layers(town))),
        residuals={name: _correct(scenes, errors, posts) for name, errors in CORRECTED.items()},
        provenance=provenance(),
    )
    return results, results.pictures()


def fuse(sightings: list[Sighting], posts: np.ndarray, at_s: float, arm: str) -> RoadAverage:
    """Return the road average at `at_s` by one of `ARMS` from the sightings of a window."""
    if arm == NAIVE:
        sightings = [replace(sighting, navigation=None) for sighting in sightings]
    elif arm == GRAPH:
        sightings = correct_poses(sightings, posts, at_s)
    return average_boxes([report_boxes(sighting) for sighting in sightings], at_s)


def _point(
    scenes: Mapping[str, SightedScene], size: float, errors: Errors, arm: str, posts: np.ndarray, clean: float
) -> Point:
    if errors == Errors():
        return Point(size, (clean,) * SEEDS)
    return Point(size, tuple(_precision(scenes, errors, arm, posts, seed) for seed in range(SEEDS)))


def _precision(scenes: Mapping[str, SightedScene], errors: Errors, arm: str, posts: np.ndarray, seed: int) -> float:
    found, targets, neutral = [], [], []
    for name, scene in scenes.items():
        arrived = apply_errors(scene.sightings, errors, stream(seed, "road average", name))
        for spin in SPINS:
            at_s = scene.time_s[spin]
            late_s = at_s - errors.latency_s
            slack_s = 3 * errors.clock_s  # time stamps have the errors of the clocks
            window = [s for s in arrived if at_s - WINDOW_S - slack_s - 1e-6 <= s.time_s <= late_s + slack_s + 1e-6]
            found.append(fuse(window, posts, at_s, arm).boxes)
            targets.append(scene.truth[spin].targets)
            neutral.append(scene.truth[spin].neutral)
    return average_precision(match(found, targets, neutral, 0.5, "bev"))


def _correct(scenes: Mapping[str, SightedScene], errors: Errors, posts: np.ndarray) -> tuple[Residual, Residual]:
    """Return the residuals of vehicles as stated and after the pose graph; `errors` loses no messages."""
    true: list[Sighting] = []
    stated: list[Sighting] = []
    corrected: list[Sighting] = []
    for seed in range(SEEDS):
        for name, scene in scenes.items():
            arrived = apply_errors(scene.sightings, errors, stream(seed, "road average", name))
            for spin in SPINS:
                at_s = scene.time_s[spin]
                window = [n for n, s in enumerate(scene.sightings) if at_s - WINDOW_S - 1e-6 <= s.time_s <= at_s + 1e-6]
                true += [scene.sightings[n] for n in window]
                stated += [arrived[n] for n in window]
                corrected += correct_poses([arrived[n] for n in window], posts, at_s)
    return measure_residual(true, stated), measure_residual(true, corrected)


def measure_residual(true: Sequence[Sighting], stated: Sequence[Sighting]) -> Residual:
    """Return the mean absolute errors of the poses and times of vehicles as `stated`, against `true`."""
    pairs = [(a, b) for a, b in zip(true, stated, strict=True) if a.navigation is not None]
    off_m = [np.linalg.norm((b.world_from_agent - a.world_from_agent)[:2, 3]) for a, b in pairs]
    turned = [abs(yaw_of(inverse(a.world_from_agent) @ b.world_from_agent)) for a, b in pairs]
    late_s = [abs(b.time_s - a.time_s) for a, b in pairs]
    return Residual(100 * float(np.mean(off_m)), float(np.degrees(np.mean(turned))), 1000 * float(np.mean(late_s)))


def _snap(scenes: Mapping[str, SightedScene], context: MapContext) -> Snapped:
    labels: tuple[list[Boxes], list[Boxes]] = ([], [])
    targets, neutral, off = [], [], []
    for scene in scenes.values():
        for spin in SPINS:
            at_s = scene.time_s[spin]
            window = [s for s in scene.sightings if at_s - WINDOW_S - 1e-6 <= s.time_s <= at_s + 1e-6]
            average = average_boxes([report_boxes(sighting) for sighting in window], at_s)
            after = snap_to_map(average.boxes, average.velocity, context)
            truth = scene.truth[spin]
            target = assign_targets(average.boxes, truth.targets, 0.5, "bev")
            hit = target >= 0
            yaw = truth.targets.yaw[target[hit]]
            off.append([np.abs(wrap_angle(boxes.yaw[hit] - yaw)) for boxes in (average.boxes, after)])
            for boxes_of, boxes in zip(labels, (average.boxes, after), strict=True):
                boxes_of.append(boxes)
            targets.append(truth.targets)
            neutral.append(truth.neutral)
    errors = np.degrees(np.concatenate(off, axis=1))
    first, second = (average_precision(match(boxes, targets, neutral, 0.5, "bev")) for boxes in labels)
    mean, turned = errors.mean(axis=1), (errors > 90).sum(axis=1)
    return Snapped(errors.shape[1], (float(mean[0]), float(mean[1])), (int(turned[0]), int(turned[1])), (first, second))


WHEN = ("as stated", "after the pose graph")


def average_tables(results: RoadAverageResult) -> dict[str, str]:
    """Return Markdown by name: joint, knobs, map, residuals."""
    joint = [[arm, f"{results.clean[arm]:.3f}", _describe(results.joint[arm])] for arm in ARMS]
    rows = [
        [knob, f"{point.size:g}", *(_describe(results.knobs[knob][arm][row]) for arm in ARMS)]
        for knob in KNOBS
        for row, point in enumerate(results.knobs[knob][GRAPH])
    ]
    snapped = results.snapped
    context = [
        ["without the map", f"{snapped.heading_deg[0]:.2f}", snapped.reversed_[0], f"{snapped.ap50[0]:.3f}"],
        ["snapped to lanes", f"{snapped.heading_deg[1]:.2f}", snapped.reversed_[1], f"{snapped.ap50[1]:.3f}"],
    ]
    return {
        "joint": format_table(("AP50", "no errors", f"{BOTH}: mean (range over seeds)"), joint),
        "knobs": format_table(("error: AP50, mean (range over seeds)", "size", *ARMS), rows),
        "map": format_table(("labels", "mean heading error [°]", f"reversed of {snapped.matched}", "AP50"), context),
        "residuals": _residuals(results.residuals),
    }


def _describe(point: Point) -> str:
    """Return the mean over seeds, with their range where they differ."""
    low, high = min(point.ap50), max(point.ap50)
    return f"{point.mean:.3f}" + (f" ({low:.3f} to {high:.3f})" if high > low else "")


def _residuals(residuals: Mapping[str, tuple[Residual, Residual]]) -> str:
    rows = [
        [
            name,
            *(f"{residual.position_cm:.1f}" for residual in pair),
            *(f"{residual.heading_deg:.2f}" for residual in pair),
            *(f"{residual.clock_ms:.0f}" for residual in pair),
        ]
        for name, pair in residuals.items()
    ]
    heads = [f"{measure}, {when}" for measure in ("position [cm]", "heading [°]", "clock [ms]") for when in WHEN]
    return format_table(("errors", *heads), rows)


def _run(out: Path, options: Options) -> Outcome[RoadAverageResult]:
    with options.show_progress(options.title) as report:
        results, pictures = evaluate_road_average(out, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(RoadAverageResult, _run, average_tables, takes=())

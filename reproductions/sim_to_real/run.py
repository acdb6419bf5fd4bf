"""Sim-to-real gap: statistics of simulated and real clouds, and AP on real sweeps of a detector trained in simulation.

Real frames, of KITTI or of an imported dataset, are compared with two recordings of the same simulated scenes: with the
LiDAR of the `kitti` rig, and with one that has only its beams, on Lambertian surfaces. The detector is the package's
own.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.formats.kitti.files import KittiFolder
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import RUN, Experiment, Options, Outcome
from flcav.experiments.study import open_split, record_split
from flcav.geometry import Boxes, inverse
from flcav.perception.agents import POLE, kind_of
from flcav.perception.images import kitti_view
from flcav.perception.kitti_benchmark import is_kitti, select_shown, truth_of
from flcav.perception.metrics import interval_words, match
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.metrics.operating_point import FoundAtDistance, describe_counts
from flcav.perception.networks import resolve_network
from flcav.perception.objects.evaluate import count_objects, score_detections
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import (
    LOWEST_SCORE,
    ObjectFound,
    boxes_to_rows,
    detect,
    detect_in,
    look_around,
    rows_to_boxes,
)
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import CARS, FrameTruth, asked_of, choose_lidar, select_class
from flcav.perception.ops.boxes import Kind
from flcav.report import style
from flcav.report.pictures.clouds import real_frame
from flcav.reproductions.sim_to_real.clouds import (
    CloudNumbers,
    CloudSeries,
    Labelled,
    SeenCar,
    cloud_statistics,
    summarise_clouds,
)
from flcav.runs.engine import Notify, Step, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.storage.markdown import format_table
from flcav.storage.records import LEFT_OUT, Class, Record

RECIPE: dict[str, Any] = {  # of the simulated scenes
    "town": "suburb",
    "seed": 21,
    "scenes": 4,
    "warmup_s": 60.0,
    "spins_per_scene": 3,
    "every_s": 8.0,
    "cavs": 2,
}
RIGS: dict[str, Any] = {
    "simulated": "kitti_lidar",
    "beams alone": {"lidars": {"velodyne": {"mount": {"z": 1.73}, "settings": {"beams": "hdl64e"}}}},
}
REAL = "KITTI"
LIDAR = "velodyne"
SHOWN = 0.3  # lowest score of detections that are counted, and listed by frame


@dataclass(frozen=True)
class RealScore:
    """Detections of one class in real frames, matched at one threshold of one kind of IoU."""

    label: Class
    kind: Kind
    iou: float
    targets: int
    found: int  # with a score of `SHOWN` or more, as those of `false_positives`
    false_positives: int
    ap: float | None  # None without targets
    low: Annotated[float | None, LEFT_OUT] = None  # 95 % interval of AP over sweeps; None of one sweep
    high: Annotated[float | None, LEFT_OUT] = None


@dataclass(frozen=True)
class LabelledCar:
    """A labelled car of a real frame."""

    distance_m: float
    found_at: tuple[float, ...]  # thresholds of IoU at which a detection matches it


@dataclass(frozen=True)
class FrameResult:
    """Detections and cars in a real frame; the boxes of KITTI's labels are not copied."""

    frame: str
    boxes: tuple[ObjectFound, ...]
    cars: tuple[LabelledCar, ...]


@dataclass(frozen=True)
class SimToReal(Record):
    """Results of the experiment: statistics of clouds, detections by class, and by real frame."""

    clouds: Mapping[str, CloudNumbers]  # by origin: `REAL`, a dataset, or a name in `RIGS`
    scores: tuple[RealScore, ...]
    frames: tuple[FrameResult, ...]
    provenance: Provenance
    counts: Annotated[tuple[FoundAtDistance, ...] | None, LEFT_OUT] = None  # true and false detections, by distance


@dataclass(frozen=True)
class RealSweep:
    """A real sweep with the detections of a network and the ground truth, LiDAR frame."""

    name: str
    points: NDArray[np.float32]  # (N, 4)
    found: Boxes  # scores of `LOWEST_SCORE` or more
    truth: FrameTruth


def run_sim_to_real(
    network: Second,
    real: Path,
    out: Path,
    *,
    around: bool = False,
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
) -> SimToReal:
    """Compare simulated clouds with those of the folder `real`, and evaluate `network` on its frames.

    `real` is a folder in KITTI's layout, where detections outside the image do not count, or a dataset, such as an
    imported one. With `around`, the network detects in all directions. Simulated frames are recorded in `out` by
    `run_steps`. Raises `InputError` where `real` is neither, and for `around` with KITTI, whose labels lie ahead.
    """
    sweeps = [*read_sweeps(network, real, around)]
    steps = [
        Step(name.replace(" ", "-"), record_split, {"recipe": {**RECIPE, "vehicle_rig": rig}})
        for name, rig in RIGS.items()
    ]
    run_steps(steps, out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    origin = REAL if is_kitti(real) else real.resolve().name
    clouds = {origin: summarise_clouds((sweep.points, select_class(sweep.truth.targets, "Car")) for sweep in sweeps)}
    for name, step in zip(RIGS, steps, strict=True):
        data = open_split(out / step.name)
        clouds[name] = summarise_clouds(labelled(data, number) for number in range(len(data)))
    found, truths = [sweep.found for sweep in sweeps], [sweep.truth for sweep in sweeps]
    counts = count_objects(found, truths, network.config.classes)
    frames = tuple(map(tell_frame, sweeps))
    return SimToReal(clouds, score_sweeps(network, sweeps), frames, provenance(RECIPE["seed"]), counts)


def read_sweeps(network: Second, real: Path, around: bool = False) -> Iterator[RealSweep]:
    """Yield the sweeps of the folder `real`, see `run_sim_to_real`, with the detections of `network`."""
    if is_kitti(real):
        if around:
            raise InputError(f"{real}: KITTI's labels lie ahead, in the image; leave --around out")
        folder = KittiFolder.open(real, pictures=False)
        for number in range(len(folder)):
            frame = folder.frame(number)
            found = select_shown(detect(network, frame.points, score_threshold=LOWEST_SCORE), frame)
            yield RealSweep(frame.name, frame.points, found, truth_of(frame))
        return
    data = Dataset.open(real)
    data.check_labelled(OBJECTS.name)
    detector = look_around(network) if around else network
    for number in data.select(agents={key.agent for key in data.keys if kind_of(key.agent) != POLE}):
        frame = data.frame(number)
        (found,) = detect_in(detector, [frame], score_threshold=LOWEST_SCORE)
        yield RealSweep(frame.key, frame.lidar[choose_lidar(frame)], found, asked_of(frame, detector.config))


def labelled(data: Dataset, number: int) -> Labelled:
    """Return the cloud (N, 4) of a recorded frame and the boxes of its cars and vans, LiDAR frame."""
    frame = data.frame(number)
    boxes = frame.annotations.boxes.transform(inverse(frame.world_from_sensor(LIDAR)))
    return frame.lidar[LIDAR], boxes[np.isin(boxes.label, CARS)]


def score_sweeps(network: Second, sweeps: Sequence[RealSweep]) -> tuple[RealScore, ...]:
    """Return AP by class, kind of IoU and threshold over real sweeps, with intervals over them."""
    found, truths = [sweep.found for sweep in sweeps], [sweep.truth for sweep in sweeps]
    classes = network.config.classes
    alone = [replace(truth, scene=str(number)) for number, truth in enumerate(truths)]  # every sweep is a scene
    scores = []
    for row in score_detections(found, alone, classes):
        detections, targets, neutral = (
            [select_class(boxes, row.label) for boxes in side]
            for side in (found, [truth.targets for truth in truths], [truth.neutral for truth in truths])
        )
        matches = match(detections, targets, neutral, row.iou, row.kind)
        counted = matches.hit[matches.score >= SHOWN]
        hits, wrong = int(counted.sum()), int((~counted).sum())
        scores.append(RealScore(row.label, row.kind, row.iou, row.targets, hits, wrong, row.ap, row.low, row.high))
    return tuple(scores)


def draw_clouds(results: SimToReal) -> bytes:
    """Return a PNG of the statistics of all clouds."""
    return style.png(cloud_statistics({name: _series(numbers) for name, numbers in results.clouds.items()}))


def draw_frame(real: Path, story: FrameResult) -> bytes | None:
    """Return a PNG of one frame of the results: cloud from above and image, with labelled cars and detections.

    Return None for a frame of KITTI without an image, and for other data.
    """
    if not is_kitti(real):
        return None
    folder = KittiFolder.open(real, pictures=False)
    frame = folder.frame(folder.names.index(story.frame))
    if not frame.image.size:
        return None
    view = kitti_view(frame.image, frame.calibration)
    cars, hit = (
        select_class(frame.objects.boxes, "Car"),
        np.array([0.5 in car.found_at for car in story.cars], dtype=bool),
    )
    return style.png(real_frame(story.frame, frame.points, view, cars, hit, rows_to_boxes(story.boxes)))


def _series(numbers: CloudNumbers) -> CloudSeries:
    street = [(float(np.mean([float(m) for m in row.ahead_m.split("-")])), row.intensity) for row in numbers.ground]
    cars = [(car.distance_m, car.returns) for car in numbers.cars]
    return CloudSeries(numbers.returns_per_range, numbers.intensity_quantiles, street, cars)


def tell_frame(sweep: RealSweep) -> FrameResult:
    """Return the sweep's detections, and the distance of each labelled car with the IoU thresholds that find it."""
    found, cars = sweep.found, select_class(sweep.truth.targets, "Car")
    score = found.score if found.score is not None else np.ones(len(found))
    found = found[score >= SHOWN]
    distances = np.hypot(cars.center[:, 0], cars.center[:, 1]).round(1).tolist()
    hit = {overlap: assign_targets(select_class(found, "Car"), cars, overlap).tolist() for overlap in (0.5, 0.7)}
    labelled = tuple(
        LabelledCar(distance, tuple(overlap for overlap, targets in hit.items() if number in targets))
        for number, distance in enumerate(distances)
    )
    return FrameResult(sweep.name, boxes_to_rows(found), labelled)


def tables(results: SimToReal) -> dict[str, str]:
    """Return Markdown by name: detections, cars, clouds."""
    clouds = results.clouds
    return {
        "detections": format_table(
            ("class", "overlap (IoU)", "labelled", "true positives", "false positives", "AP R40"),
            [
                (row.label, f"{row.kind} at {row.iou}", row.targets, *_found(row))
                for row in results.scores
                if row.targets
            ],
        ),
        "cars": format_table(
            ("frame", "distance of the car [m]", "detected at IoU"),
            [(story.frame, *_car(car)) for story in results.frames for car in story.cars],
        ),
        "clouds": format_table(("", *clouds), _clouds(clouds)),
    }


def _found(row: RealScore) -> tuple[int, int, str]:
    return row.found, row.false_positives, "" if row.ap is None else f"{row.ap:.3f}"


def _car(car: LabelledCar) -> tuple[str, str]:
    return f"{car.distance_m:.1f}", ", ".join(map(str, car.found_at)) or "no"


def _clouds(clouds: Mapping[str, CloudNumbers]) -> list[list[str]]:
    columns = list(clouds.values())
    rows = [["returns per frame", *(f"{c.returns:.0f}" for c in columns)]]
    for name in sorted(columns[0].returns_per_range, key=lambda limits: float(limits.split("-")[0])):
        rows.append([f"of them at {name}", *(f"{c.returns_per_range[name]:.0f}" for c in columns)])
    for place, share in enumerate((5, 25, 50, 75, 95)):
        rows.append([f"intensity, {share}th percentile", *(f"{c.intensity_quantiles[place]:.2f}" for c in columns)])
    rows.append(["returns without intensity", *(f"{c.without_intensity:.0%}" for c in columns)])
    for ahead_m in (street.ahead_m for street in columns[0].ground):
        sections = [next((street for street in c.ground if street.ahead_m == ahead_m), None) for c in columns]
        for what, values in (
            ("height", [street and street.height_m for street in sections]),
            ("interquartile range of height", [street and street.spread_m for street in sections]),
            ("intensity", [street and street.intensity for street in sections]),
        ):
            cells = ["" if value is None else f"{value:.2f}" for value in values]
            rows.append([f"street {ahead_m} m ahead, {what}", *cells])
    rows.append(["cars: median length, width, height [m]", *(_sizes(c.cars) for c in columns)])
    return rows


def _sizes(cars: Sequence[SeenCar]) -> str:
    if not cars:
        return ""
    sides = np.median([(car.length_m, car.width_m, car.height_m) for car in cars], axis=0)
    return ", ".join(f"{side:.2f}" for side in sides)


def _run(out: Path, options: Options) -> Outcome[SimToReal]:
    real = options.kitti or options.data
    if real is None or (options.kitti and options.data):
        raise InputError("sim-to-real needs real frames: --kitti, a folder in KITTI's layout, or --data, a dataset")
    network = resolve_network(OBJECTS, options.weights)
    with options.show_steps(options.title) as notify:
        results = run_sim_to_real(network, real, out, around=options.around, **options.how(notify))
    frames = {f"{story.frame}.png": draw_frame(real, story) for story in results.frames}
    pictures = {name: picture for name, picture in frames.items() if picture is not None}
    return Outcome(results, {"clouds.png": draw_clouds(results), **pictures}, describe_scores(results))


def describe_scores(results: SimToReal) -> list[str]:
    """Return the scores of the detector in real frames as sentences."""
    scores = [
        f"{row.label} {row.kind} at IoU {row.iou}: {row.found} of {row.targets} found, {row.false_positives} false, "
        f"AP {row.ap:.3f} {interval_words(row.low, row.high)}"
        for row in results.scores
        if row.targets
    ]
    return [*scores, *describe_counts(results.counts or ())]


EXPERIMENT = Experiment(SimToReal, _run, tables, takes=(*RUN, "kitti", "data", "around", "weights"))

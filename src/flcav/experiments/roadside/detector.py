"""The trained road detector in towns that it was not trained in, at the threshold fixed in those it was."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.maps import import_map
from flcav.experiments.roadside.labels import RoadLabels, measure_road_labels
from flcav.fusion.detector import THRESHOLD, road_detector
from flcav.fusion.road import MIN_RETURNS
from flcav.geometry import Boxes
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.agents import POLE, kind_of
from flcav.perception.metrics import match
from flcav.perception.objects.truth import CARS, LOOKALIKE
from flcav.report import style
from flcav.report.charts.roadside import draw_recall
from flcav.runs.provenance import Provenance, provenance
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.bootstrap import bootstrap_over_scenes
from flcav.statistics.estimates import Estimate
from flcav.statistics.streams import stream
from flcav.storage.records import Record

OVERLAP = 0.5  # bird's-eye IoU of a car that was found
WITHIN_M = 30.0  # horizontal distance of a car from the pole
LEAST_PRECISION = (
    0.98  # on the validation towns, by which the threshold was fixed: three points above the aim elsewhere
)
BINS_M = tuple(range(0, 41, 5))  # of distance, for the recall of each
SHARED = {"cavs": 0, "poles": "all", "every_s": 6.0, "spins_per_scene": 2}
VALIDATION: Mapping[str, Mapping[str, Any]] = {
    "suburb": {"seed": 7202, "scenes": 8},
    "arterial": {"seed": 7201, "scenes": 6},
}
IMPORTED = "quarter"  # map of the package
TESTS: Mapping[str, Mapping[str, Any]] = {
    "grid": {"seed": 7321, "scenes": 10},
    "ring": {"seed": 7322, "scenes": 10},
    "hilly_grid": {"seed": 7323, "scenes": 5},
    IMPORTED: {"seed": 7324, "scenes": 10},
}


@dataclass(frozen=True)
class TownScore:
    """Recall and precision of the road detector in one town."""

    town: str
    seen: bool  # whether the detector was trained in this town, on other scenes
    frames: int
    cars: int  # within `WITHIN_M` and with `MIN_RETURNS` of that pole
    recall: Estimate  # intervals over scenes
    detections: int  # within `WITHIN_M`, true or false
    precision: Estimate
    by_distance: tuple[tuple[int, int], ...]  # cars and found cars in each interval of `BINS_M`


@dataclass(frozen=True)
class RoadDetectorResult(Record):
    """Scores of the road detector in validation and test towns."""

    threshold: float  # lowest score of a label, see `flcav.fusion.detector`
    fitted: float  # lowest threshold with `LEAST_PRECISION` on the validation towns, as computed here
    towns: tuple[TownScore, ...]
    labels: RoadLabels  # that vehicles get
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the scores in words, a sentence per town."""
        return [
            f"{each.town}{' (trained there)' if each.seen else ''}: {each.cars} cars within {WITHIN_M:g} m, recall "
            f"{each.recall.describe()}, precision {each.precision.describe()}"
            for each in self.towns
        ]

    def pictures(self) -> dict[str, bytes]:
        """Return the picture of recall against distance as PNG, by file name."""
        lines = {
            each.town: [(found / cars if cars else None) for cars, found in each.by_distance] for each in self.towns
        }
        unseen = [each.town for each in self.towns if not each.seen]
        return {"recall.png": style.png(draw_recall(BINS_M, lines, unseen, WITHIN_M))}


@dataclass(frozen=True)
class _Frames:
    """Detections and cars of the roadside frames of a town."""

    scene: list[str]
    found: list[Boxes]  # score: of the detector
    targets: list[Boxes]
    neutral: list[Boxes]
    place: list[NDArray[np.float64]]  # (2,) of the pole


def evaluate_road_detector(
    out: Path, progress: Report = ignore_progress
) -> tuple[RoadDetectorResult, dict[str, bytes]]:
    """Record roadside frames of validation and test towns into `out`; return the detector's scores, and pictures."""
    towns = {**VALIDATION, **TESTS}
    import_map(IMPORTED, out / "towns")
    frames: dict[str, _Frames] = {}
    for number, (town, fields) in enumerate(towns.items()):
        folder = out / town
        split = "validation" if town in VALIDATION else "test"
        recipe = parse_config(Recipe, {**SHARED, **fields, "town": town, "split": split}, town)
        record(EmbeddedSource(recipe, out / "towns"), folder)
        frames[town] = detect_frames(Dataset.open(folder))
        progress(number + 1, len(towns), town)
    results = RoadDetectorResult(
        threshold=THRESHOLD,
        fitted=fit_threshold([frames[town] for town in VALIDATION]),
        towns=tuple(score_town(town, town in VALIDATION, each) for town, each in frames.items()),
        labels=measure_road_labels(out / "labels"),
        provenance=provenance(),
    )
    return results, results.pictures()


def detect_frames(data: Dataset, lowest: float = 0.1) -> _Frames:
    """Return detections of score `lowest` or more and ground truth of all frames of poles.

    Cars within `WITHIN_M` of the pole with `MIN_RETURNS` are targets; other cars, trucks and buses are neutral.
    """
    find, rows = road_detector(data, lowest), _Frames([], [], [], [], [])
    for number, key in enumerate(data.keys):
        if kind_of(key.agent) != POLE:
            continue
        truth, place = data.frame(number).annotations, data.world_from_agent(number)[:2, 3]
        near = np.linalg.norm(truth.boxes.center[:, :2] - place, axis=1) <= WITHIN_M
        car = np.isin(truth.boxes.label, CARS)
        target = car & near & (truth.returns >= MIN_RETURNS)
        rows.scene.append(key.scene)
        rows.found.append(find(number))
        rows.targets.append(truth.boxes[target])
        rows.neutral.append(truth.boxes[(car & ~target) | np.isin(truth.boxes.label, list(LOOKALIKE))])
        rows.place.append(place)
    return rows


def fit_threshold(towns: Sequence[_Frames]) -> float:
    """Return the lowest score with a precision of `LEAST_PRECISION` among detections within `WITHIN_M`; else 1."""
    found = [near for each in towns for near in _near(each, 0.0)]
    targets = [boxes for each in towns for boxes in each.targets]
    matches = match(found, targets, [boxes for each in towns for boxes in each.neutral], OVERLAP, "bev")
    precision = np.cumsum(matches.hit) / np.arange(1, len(matches.hit) + 1)
    good = np.flatnonzero(precision >= LEAST_PRECISION)
    return float(matches.score[good[-1]]) if len(good) else 1.0


def score_town(town: str, seen: bool, frames: _Frames, threshold: float = THRESHOLD) -> TownScore:
    """Return recall and precision at the threshold, with intervals over scenes."""
    every = _above(frames, threshold)
    matches = match(every, frames.targets, frames.neutral, OVERLAP, "bev")
    hits = np.bincount(matches.frame[matches.hit], minlength=len(every))
    near = match(_near(frames, threshold), frames.targets, frames.neutral, OVERLAP, "bev")
    right = np.bincount(near.frame[near.hit], minlength=len(every))
    told = np.bincount(near.frame, minlength=len(every))
    cars = np.array([len(boxes) for boxes in frames.targets])

    def share(above: NDArray[np.int64], below: NDArray[np.int64], name: str) -> Estimate:
        def measure(counts: NDArray[np.int64]) -> NDArray[np.float64]:
            return (counts @ above) / np.maximum(counts @ below, 1)

        rng = stream(0, "road detector", town, name)
        return Estimate(
            float(above.sum() / max(below.sum(), 1)), *bootstrap_over_scenes(measure, frames.scene, rng=rng)
        )

    return TownScore(
        town=town,
        seen=seen,
        frames=len(every),
        cars=int(cars.sum()),
        recall=share(hits, cars, "recall"),
        detections=int(told.sum()),
        precision=share(right, told, "precision"),
        by_distance=_by_distance(frames, every),
    )


def _near(frames: _Frames, threshold: float) -> list[Boxes]:
    """Return the detections of each frame with the threshold's score within `WITHIN_M` of the pole."""
    return [
        boxes[np.linalg.norm(boxes.center[:, :2] - place, axis=1) <= WITHIN_M]
        for boxes, place in zip(_above(frames, threshold), frames.place, strict=True)
    ]


def _above(frames: _Frames, threshold: float) -> list[Boxes]:
    return [boxes if boxes.score is None else boxes[boxes.score >= threshold] for boxes in frames.found]


def _by_distance(frames: _Frames, found: Sequence[Boxes]) -> tuple[tuple[int, int], ...]:
    """Return cars and found cars in each interval of `BINS_M`."""
    counts = np.zeros((2, len(BINS_M) - 1), dtype=np.int64)
    for boxes, targets, place in zip(found, frames.targets, frames.place, strict=True):
        for low, high in pairwise(BINS_M):
            apart = np.linalg.norm(targets.center[:, :2] - place, axis=1)
            own = targets[(apart >= low) & (apart < high)]
            hits = match([boxes], [own], [Boxes.empty()], OVERLAP, "bev").hit.sum()
            counts[:, BINS_M.index(low)] += len(own), hits
    return tuple((int(cars), int(hits)) for cars, hits in counts.T)

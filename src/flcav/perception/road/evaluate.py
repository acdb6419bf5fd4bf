"""Measures of road perception: IoU by class, F1 of lane lines by CULane's rule, and their error on the ground.

Outcomes are kept by image, so that every measure can be bootstrapped over scenes and taken by weather. Ground beyond
the labels' reach does not count.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import shapely

from flcav.arrays import Array, Bytes, Ints
from flcav.dataset.ground import DatasetGround
from flcav.dataset.road_labels import IGNORED, ROAD_CLASSES, RoadLabels, SeenLine, label_road
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.metrics.lane_lines import f1_score, match_lines
from flcav.perception.outcomes import Counted, Measure, Outcomes, Times, Values
from flcav.perception.road.lines import GroundPlane, TracedLine, trace_lines
from flcav.perception.road.model import RoadConfig, RoadNetwork
from flcav.perception.road.predict import segment_picture
from flcav.perception.road.samples import list_pictures, read_recorded_picture
from flcav.perception.task import Evaluated
from flcav.sensors.frame import Frame
from flcav.statistics.bootstrap import REDRAWS
from flcav.storage.records import Class
from flcav.world.weather import find_nearest_class

SCORE = 0.9  # least score of a lane line, by the F1 on validation scenes
RANGES_M = (0.0, 10.0, 20.0, 40.0)  # borders of the ranges of the error on the ground
NIGHT, DAY = "night", "day"  # by civil twilight
HITS, FOUND, WANTED, SAME_KIND = "hits", "found", "wanted", "same_kind"
CONFUSION, OFF_M, POINTS, WEATHER, LIGHT = "confusion", "off_m", "points", "weather", "light"


@dataclass(frozen=True)
class ClassOverlap:
    """Intersection over union of a class; None where it neither is nor is found."""

    label: Class
    iou: float | None
    share: float  # of the pixels that count


@dataclass(frozen=True)
class GroundError:
    """Error of lane lines that match, across them on the ground; None where there are none."""

    from_m: float  # distance from the camera
    to_m: float
    mean_m: float | None
    points: int  # of the found lines, that lie in the range


@dataclass(frozen=True)
class Condition:
    """The measures in one weather, or by one light; None where there is nothing to find."""

    name: str
    pictures: int
    f1: float | None
    miou: float | None


@dataclass(frozen=True)
class RoadEvaluation(Evaluated):
    """Measures of road perception on some images; None where there is nothing to find."""

    f1: float | None  # of lane lines, by CULane's rule
    precision: float | None
    recall: float | None
    same_kind: float | None  # share of the matching lines whose kind, solid or broken, is right
    wanted: int  # number of lane lines
    found: int
    miou: float | None  # mean of the classes' IoU, background included
    classes: tuple[ClassOverlap, ...]
    ground: tuple[GroundError, ...]
    conditions: tuple[Condition, ...]  # the weathers' nearest classes, then day and night
    pictures: int
    scenes: int

    @property
    def score(self) -> float:
        """Return the F1 of lane lines; 0 where there are none."""
        return self.f1 or 0.0

    def numbers(self) -> Mapping[str, float]:
        """Return F1, mean IoU, the errors on the ground, IoU by class, and F1 by condition, as far as they exist."""
        named = {"lane F1": self.f1, "mIoU": self.miou}
        named |= {f"ground error {row.from_m:g} to {row.to_m:g} m": row.mean_m for row in self.ground}
        named |= {f"IoU {row.label}": row.iou for row in self.classes}
        named |= {f"lane F1, {row.name}": row.f1 for row in self.conditions}
        return {name: value for name, value in named.items() if value is not None}

    def lines(self) -> list[str]:
        """Return the measures of lane lines, of classes, on the ground, and by condition."""
        seen = f"{plural(self.pictures, 'picture')} of {plural(self.scenes, 'scene')}"
        lane = f"lane F1 {_known(self.f1)} (precision {_known(self.precision)}, recall {_known(self.recall)})"
        lines = [f"{seen}: {lane}, mIoU {_known(self.miou)}"]
        lines.append(f"{self.wanted} lane lines, {self.found} found; kind right of {_known(self.same_kind)}")
        lines += [f"{row.label:<11}IoU {_known(row.iou)}  ({row.share:.2%} of the pixels)" for row in self.classes]
        for row in self.ground:
            off = "nothing found" if row.mean_m is None else f"{row.mean_m:.2f} m aside"
            lines.append(f"{row.from_m:g} to {row.to_m:g} m: {off} ({plural(row.points, 'point')})")
        for row in self.conditions:
            lines.append(f"{row.name:<11}lane F1 {_known(row.f1)}, mIoU {_known(row.miou)}  ({row.pictures} pictures)")
        return lines


def _known(value: float | None) -> str:
    return "unknown (nothing to find)" if value is None else f"{value:.3f}"


def count_pixels(truth: Bytes, found: Bytes) -> Ints:
    """Return the confusion matrix (classes, classes) of class images (H, W): rows are the truth, IGNORED left out."""
    classes = len(ROAD_CLASSES)
    counted = truth != IGNORED
    pairs = truth[counted].astype(np.int64) * classes + found[counted]
    return np.bincount(pairs, minlength=classes**2).reshape(classes, classes)


def overlaps(confusion: Ints) -> Array:
    """Return the IoU (..., classes) from confusion matrices (..., classes, classes); NaN of a class without pixels."""
    both = np.diagonal(confusion, axis1=-2, axis2=-1)
    either = confusion.sum(axis=-1) + confusion.sum(axis=-2) - both
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(either > 0, both / either, np.nan)


def mean_overlap(confusion: Ints) -> Array:
    """Return the mean IoU (...) of the classes that occur in confusion matrices (..., classes, classes)."""
    by_class = overlaps(confusion)
    known = np.isfinite(by_class)
    return np.where(known, by_class, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)


def measure_offsets(found: TracedLine, wanted: SeenLine, eye: Array) -> tuple[Array, Ints]:
    """Return the sums of distances [m] of a found line's points from the true line, and their numbers, by `RANGES_M`.

    Both lines are level, in the agent's frame; `eye` (2,) is the camera's place there. Points beyond the ends of the
    true line do not count.
    """
    assert found.ground is not None
    points = shapely.points(found.ground)
    line = shapely.LineString(wanted.ground[:, :2])
    along = shapely.line_locate_point(line, points)
    inner = (along > 0) & (along < line.length)
    away = np.hypot(*(found.ground - eye).T)
    off = np.asarray(shapely.distance(line, points))
    where = [inner & (away >= low) & (away < high) for low, high in pairwise(RANGES_M)]
    return np.array([off[part].sum() for part in where]), np.array([int(part.sum()) for part in where])


class RoadOutcomes:
    """Measure of the road task: the F1 of lane lines by CULane's rule."""

    measure_name = "lane F1"
    redraws = REDRAWS
    threshold = SCORE

    @property
    def further_measures(self) -> Mapping[str, Measure]:
        """Return the mean IoU."""
        return {"mIoU": _measure_overlap}

    def outcomes(
        self,
        network: RoadNetwork,
        data: Dataset,
        frames: Sequence[int],
        progress: Report = ignore_progress,
        asked: RoadConfig | None = None,
    ) -> Outcomes:
        """Return the numbers of lines, of pixels by class, and the errors on the ground of each image."""
        pairs = list_pictures(data, frames)
        rows: dict[str, list] = {
            name: [] for name in (HITS, FOUND, WANTED, SAME_KIND, CONFUSION, OFF_M, POINTS, WEATHER, LIGHT)
        }
        ground = DatasetGround(data)
        for done, (number, camera) in enumerate(pairs, start=1):
            frame, truth = data.frame(number), _labels(data, number, camera)
            shares, classes = segment_picture(network, read_recorded_picture(data, number, camera))
            plane = GroundPlane.of(frame, camera, ground.height_of(number))
            traced = [line for line in trace_lines(shares, plane) if line.score >= self.threshold]
            for name, value in _compare(traced, truth, plane).items():
                rows[name].append(value)
            rows[CONFUSION].append(count_pixels(truth.classes, classes))
            rows[WEATHER].append(_weather(frame))
            rows[LIGHT].append(_light(frame))
            progress(done, len(pairs), "")
        scenes = np.array([data.keys[number].scene for number, _ in pairs])
        return Outcomes(scenes, {name: np.array(values) for name, values in rows.items()})

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the F1 of each bootstrap sample; NaN without lane lines."""
        return f1_score(*(times @ outcomes.arrays[name] for name in (HITS, FOUND, WANTED)))

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return the mean IoU, and the numbers of lane lines and of images."""
        arrays = outcomes.arrays
        miou = float(mean_overlap(arrays[CONFUSION].sum(axis=0)))
        return {"mIoU": miou, "targets": float(arrays[WANTED].sum()), "pictures": float(len(outcomes.scene))}

    def count(self, outcomes: Outcomes) -> Counted:
        """Return the numbers of lane lines, of those found, and of lines found where there is none."""
        hits, found, wanted = (int(outcomes.arrays[name].sum()) for name in (HITS, FOUND, WANTED))
        return Counted("lane lines", wanted, hits, found - hits)


def summarise(outcomes: Outcomes) -> RoadEvaluation:
    """Return the evaluation of the images of these outcomes."""
    arrays = outcomes.arrays
    hits, found, wanted = (int(arrays[name].sum()) for name in (HITS, FOUND, WANTED))
    confusion = arrays[CONFUSION].sum(axis=0)
    by_class, shares = overlaps(confusion), confusion.sum(axis=1) / max(confusion.sum(), 1)
    off, points = arrays[OFF_M].sum(axis=0), arrays[POINTS].sum(axis=0)
    every = np.ones(len(outcomes.scene), np.bool_)
    return RoadEvaluation(
        f1=_f1(arrays, every),
        precision=hits / found if found else None,
        recall=hits / wanted if wanted else None,
        same_kind=int(arrays[SAME_KIND].sum()) / hits if hits else None,
        wanted=wanted,
        found=found,
        miou=float(mean_overlap(confusion)),
        classes=tuple(
            ClassOverlap(name, None if np.isnan(iou) else float(iou), float(share))
            for name, iou, share in zip(ROAD_CLASSES, by_class, shares, strict=True)
        ),
        ground=tuple(
            GroundError(low, high, float(total / count) if count else None, int(count))
            for (low, high), total, count in zip(pairwise(RANGES_M), off, points, strict=True)
        ),
        conditions=tuple(
            Condition(
                str(name), int(part.sum()), _f1(arrays, part), float(mean_overlap(arrays[CONFUSION][part].sum(0)))
            )
            for kind in (WEATHER, LIGHT)
            for name in dict.fromkeys(arrays[kind].tolist())
            if name
            for part in [arrays[kind] == name]
        ),
        pictures=len(outcomes.scene),
        scenes=len(set(outcomes.scene.tolist())),
    )


def _measure_overlap(outcomes: Outcomes, times: Times) -> Values:
    confusion = outcomes.arrays[CONFUSION]
    drawn = times @ confusion.reshape(len(confusion), -1)
    return mean_overlap(drawn.reshape(-1, *confusion.shape[1:]))


def _f1(arrays: Mapping[str, np.ndarray], part: np.ndarray) -> float | None:
    value = float(f1_score(*(arrays[name][part].sum() for name in (HITS, FOUND, WANTED))))
    return None if np.isnan(value) else value


def _compare(traced: Sequence[TracedLine], truth: RoadLabels, plane: GroundPlane) -> dict[str, object]:
    """Return the numbers of an image's lines and the errors of those that match, by the names of the outcomes."""
    height, width = truth.classes.shape
    pairs = match_lines([line.pixels for line in traced], [line.pixels for line in truth.lines], (width, height))
    off, points = np.zeros(len(RANGES_M) - 1), np.zeros(len(RANGES_M) - 1, np.int64)
    for one, other in pairs:
        more, count = measure_offsets(traced[one], truth.lines[other], plane.agent_from_camera[:2, 3])
        off, points = off + more, points + count
    same = sum(traced[one].solid == (truth.lines[other].kind == "solid") for one, other in pairs)
    return {
        **{HITS: len(pairs), FOUND: len(traced), WANTED: len(truth.lines), SAME_KIND: same},
        **{OFF_M: off, POINTS: points},
    }


def _weather(frame: Frame) -> str:
    return "" if frame.weather is None else find_nearest_class(frame.weather)


def _light(frame: Frame) -> str:
    if frame.weather is None:
        return ""
    return f"by {NIGHT if frame.weather.night else DAY}"


@lru_cache(maxsize=512)
def _labels(data: Dataset, number: int, camera: str) -> RoadLabels:
    """Return the labels of an image, cached, since every validation of a training asks for the same ones."""
    return label_road(data, number, camera)

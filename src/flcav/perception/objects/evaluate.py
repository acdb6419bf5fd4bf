"""Evaluation of an object detector: AP and AOS per class, broken down by distance, occlusion and weather; calibration.

AP is computed in 3D and in bird's-eye view, at IoU 0.5 and 0.7, together with a count of near cars at one score.
Matches are kept per frame, to recompute average precision on resampled scenes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Ints, Mask
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, concatenate
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics import (
    FoundCars,
    Matches,
    average_precision,
    bootstrap_interval,
    count_found_cars,
    interval_words,
    match_at_each,
    orientation_similarity,
    right_headings,
    round_or_none,
    weighted_precision,
)
from flcav.perception.metrics.operating_point import DISTANCES_M, FoundAtDistance, count_by_distance, describe_counts
from flcav.perception.metrics.tracks import TracksEvaluation
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.modalities import frames_beside
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import OVERLAP, Reliability, detect_frames
from flcav.perception.objects.truth import (
    QUARTERS,
    FrameTruth,
    TargetCriteria,
    describe_range,
    select_class,
    select_sides,
    share_range,
)
from flcav.perception.objects.velocities import VelocityError
from flcav.perception.ops.boxes import Kind
from flcav.perception.outcomes import Counted, Measure, Outcomes, Times, Values
from flcav.perception.task import Evaluated
from flcav.statistics.bootstrap import REDRAWS
from flcav.statistics.streams import stream
from flcav.storage.records import LEFT_OUT, Class
from flcav.world.weather import WEATHER_CLASSES

OVERLAPS: tuple[tuple[Kind, float], ...] = (("3d", 0.5), ("3d", 0.7), ("bev", 0.5), ("bev", 0.7))
OCCLUSIONS = ((0.0, 0.2), (0.2, 0.6), (0.6, 1.01))  # from, to: occluded share
BORDER_M = 2.0  # detections up to this far outside a range of distances are kept, as they may match objects in it


@dataclass(frozen=True)
class BreakdownRow:
    """Average precision of a class in a part of a breakdown, for one kind of overlap and IoU threshold."""

    by: str  # distance | occlusion | weather
    slice: str  # name of the part
    label: Class
    kind: Kind
    iou: float  # from which a detection is a true positive
    ap: float | None  # AP|R40, [0, 1]
    targets: int  # in the part


@dataclass(frozen=True)
class Score:
    """AP and AOS of a class for one kind of overlap and IoU threshold; None where there are no targets."""

    label: Class
    kind: Kind
    iou: float  # from which a detection is a true positive
    ap: float | None  # average precision AP|R40, [0, 1]
    low: float | None  # 95 % interval of AP over scenes; None where one scene holds all targets
    high: float | None
    aos: float | None  # average orientation similarity, [0, ap]
    right_headings: float | None  # share of true positives with a heading error below 90 degrees; None without any
    targets: int
    hidden: int  # objects in range without a return


@dataclass(frozen=True, kw_only=True)
class ObjectsEvaluation(Evaluated):
    """Evaluation of a network on a set of frames: AP and AOS, near cars, breakdown, calibration, tracking."""

    frames: int
    scenes: int
    scores: tuple[Score, ...]  # class by class
    rules: Annotated[TargetCriteria | None, LEFT_OUT] = None  # target criteria; None in results of earlier versions
    near: Annotated[FoundCars | None, LEFT_OUT] = None  # None without class Car, and in earlier results
    counts: Annotated[tuple[FoundAtDistance, ...] | None, LEFT_OUT] = None  # None in earlier results
    slices: tuple[BreakdownRow, ...]  # breakdown of AP
    trust: tuple[Reliability, ...]  # calibration of scores and variances, one per class
    tracks: Annotated[TracksEvaluation | None, LEFT_OUT] = None  # None unless requested
    velocities: Annotated[tuple[VelocityError, ...] | None, LEFT_OUT] = None  # None where no speeds are predicted

    @property
    def score(self) -> float:
        """Return the mean AP in 3D at IoU 0.5 over the classes with targets; 0 where there are none."""
        known = [row.ap for row in self.scores if (row.kind, row.iou) == ("3d", 0.5) and row.ap is not None]
        return float(np.mean(known)) if known else 0.0

    def numbers(self) -> Mapping[str, float]:
        """Return the known metrics, by name, of all classes.

        AP for every kind of overlap and IoU; AOS and the share of right headings in 3D at IoU 0.5; expected calibration
        error; MOTA and AMOTA where tracks were evaluated; median velocity error [m/s] where speeds are predicted.
        """
        ap = {f"{row.label} AP {row.kind} at {row.iou}": row.ap for row in self.scores}
        headings = {
            f"{row.label} {name}": value
            for row in self.scores
            if (row.kind, row.iou) == ("3d", 0.5)
            for name, value in (("AOS 3d at 0.5", row.aos), ("right headings", row.right_headings))
        }
        errors = {f"{row.label} calibration error": row.ece for row in self.trust}
        tracks = {
            f"{row.label} {name}": value
            for row in (self.tracks.scores if self.tracks else ())
            for name, value in (("MOTA", row.mota), ("AMOTA", row.amota))
        }
        speeds = {f"{row.label} velocity error": row.median_m_s for row in self.velocities or ()}
        known = ap | headings | errors | tracks | speeds
        return {name: value for name, value in known.items() if value is not None}

    def lines(self) -> list[str]:
        """Return the evaluation in words.

        These are frames and target criteria; a line per class, kind of overlap and IoU; near cars; a line per class and
        part of the breakdown; calibration errors; tracking.
        """
        lines = [
            f"{plural(self.frames, 'frame')} of {plural(self.scenes, 'scene')}",
            *(self.rules.lines() if self.rules else ()),
        ]
        for row in self.scores:
            found = "nothing to find"
            if row.ap is not None:
                found = f"AP {row.ap:.3f} {interval_words(row.low, row.high)}  AOS {row.aos:.3f}"
            if row.right_headings is not None:
                found += f", {row.right_headings:.0%} of those found head the right way"
            counts = f"objects: {row.targets}, and {row.hidden} without a return"
            lines.append(f"{row.label:<12}{row.kind:>4} IoU {row.iou:.1f}  {found}  ({counts})")
        lines += [] if self.near is None else [str(self.near)]
        lines += [] if self.counts is None else describe_counts(self.counts)
        lines += [f"at IoU {OVERLAP:g} by distance, occlusion and weather:", *format_breakdown(self.slices, OVERLAP)]
        for row in self.trust:
            if row.ece is not None:
                lines.append(f"{row.label:<12}expected calibration error {row.ece:.3f}")
        for row in self.velocities or ():
            moving = "" if row.median_m_s is None else f", of moving ones {row.median_m_s:.2f} m/s"
            standing = "" if row.standing_m_s is None else f", of standing ones {row.standing_m_s:.2f} m/s"
            counts = f"{row.moving} and {row.standing} of those found"
            lines.append(f"{row.label:<12}median velocity error{moving}{standing} ({counts})")
        return [*lines, *(self.tracks.lines() if self.tracks else ())]


def score_detections(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: tuple[str, ...], *, seed: int = 0
) -> tuple[Score, ...]:
    """Return AP and AOS with intervals, by class, kind of overlap and IoU threshold (`OVERLAPS`).

    `detections` (LiDAR frame) and `truths` run over the same frames; `seed` is that of the bootstrap over scenes.
    Raises `InputError` where there are no frames.
    """
    if not truths:
        raise InputError("evaluation on 0 frames: at least one is wanted")
    scenes = tuple(truth.scene for truth in truths)
    scores = []
    for name in classes:
        found, targets, neutral = select_sides(detections, truths, name)
        hidden = sum(len(select_class(truth.hidden, name)) for truth in truths)
        for (kind, overlap), matches in zip(OVERLAPS, match_at_each(found, targets, neutral, OVERLAPS), strict=True):
            low, high = bootstrap_interval(matches, scenes, rng=stream(seed, "bootstrap"))
            ap, aos, right = average_precision(matches), orientation_similarity(matches), right_headings(matches)
            numbers = map(round_or_none, (ap, low, high, aos, right))
            scores.append(Score(name, kind, overlap, *numbers, targets=sum(map(len, targets)), hidden=hidden))
    return tuple(scores)


def count_cars(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: Sequence[str], *, around: bool
) -> FoundCars | None:
    """Return the counts of near cars, found and false, see `count_found_cars`; None without class Car.

    `detections` (LiDAR frame) and `truths` run over the same frames; `around` is whether the network looked to all four
    sides.
    """
    if "Car" not in classes:
        return None
    return count_found_cars(*select_sides(detections, truths, "Car"), looks=QUARTERS if around else 1)


def count_objects(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: Sequence[str], *, seed: int = 0
) -> tuple[FoundAtDistance, ...]:
    """Return the counts of found objects and false detections of all classes by distance, see `count_by_distance`."""
    rows: list[FoundAtDistance] = []
    for label in classes:
        scenes = [truth.scene for truth in truths]
        rng = stream(seed, "counts", label)
        rows += count_by_distance(*select_sides(detections, truths, label), scenes, label, rng)
    return tuple(rows)


class BreakdownPart(NamedTuple):
    """A part of a breakdown: the objects in a range of distance or occlusion, or the frames of a weather."""

    by: str  # distance | occlusion | weather
    name: str  # of the part: "0-20 m", "20%-60%", "fog"
    detections: list[Boxes]  # of each frame
    wanted: list[Mask]  # of each frame (targets,): whether the target is in the part; others are neutral
    frames: Ints  # indices of the frames in the part


def break_down(
    detections: Sequence[Boxes], truths: Sequence[FrameTruth], classes: Sequence[str]
) -> tuple[BreakdownRow, ...]:
    """Return the breakdown of AP: a row per part, class with targets in it, kind of overlap and IoU threshold.

    `detections` (LiDAR frame) and `truths` run over the same frames.
    """
    rows = []
    for part in split_parts(detections, truths):
        for label in classes:
            of_class = [select_class(boxes, label) for boxes in part.detections]
            is_class = [truth.targets.label == label for truth in truths]
            targets = [t.targets[o & w] for t, o, w in zip(truths, is_class, part.wanted, strict=True)]
            count = sum(len(targets[frame]) for frame in part.frames)
            if not count:
                continue
            others = [t.targets[o & ~w] for t, o, w in zip(truths, is_class, part.wanted, strict=True)]
            neutral = [concatenate([select_class(t.neutral, label), o]) for t, o in zip(truths, others, strict=True)]
            by_overlap = match_at_each(of_class, targets, neutral, OVERLAPS)
            for (kind, overlap), matches in zip(OVERLAPS, by_overlap, strict=True):
                ap = average_precision(matches, part.frames)
                rows.append(BreakdownRow(part.by, part.name, label, kind, overlap, round_or_none(ap), count))
    return tuple(rows)


def format_breakdown(rows: Sequence[BreakdownRow], overlap: float) -> list[str]:
    """Return a breakdown at IoU `overlap` in words: a line per class and part, class by class."""
    chosen = [row for row in rows if row.iou == overlap]
    ap = {(row.label, row.by, row.slice, row.kind): row.ap for row in chosen}
    known = {(row.label, row.by, row.slice): row.targets for row in chosen}
    labels = list(dict.fromkeys(row.label for row in chosen))
    return [
        f"{label:<12}{by:<11}{name.replace('_', ' '):<12}AP 3d {ap[label, by, name, '3d']:.3f}"
        f"  bev {ap[label, by, name, 'bev']:.3f}  (objects: {targets})"
        for (label, by, name), targets in sorted(known.items(), key=lambda each: labels.index(each[0][0]))
    ]


def split_parts(detections: Sequence[Boxes], truths: Sequence[FrameTruth]) -> Iterator[BreakdownPart]:
    """Yield the parts of the breakdown, by distance, occlusion and weather.

    Occlusion is left out unless every frame has it, weather unless the frames have several.
    """
    everything = np.arange(len(truths))
    for low, high in DISTANCES_M:
        near = [_between(_distance(boxes), low - BORDER_M, high + BORDER_M) for boxes in detections]
        found = [boxes[kept] for boxes, kept in zip(detections, near, strict=True)]
        wanted = [_between(_distance(truth.targets), low, high) for truth in truths]
        yield BreakdownPart("distance", f"{low}-{high} m", found, wanted, everything)
    hidden = [truth.occlusion for truth in truths if truth.occlusion is not None]
    if len(hidden) == len(truths):
        for low, high in OCCLUSIONS:
            wanted = [_between(share, low, high) for share in hidden]
            yield BreakdownPart("occlusion", f"{low:.0%}-{min(high, 1):.0%}", list(detections), wanted, everything)
    seen = {truth.weather for truth in truths}
    weathers = [name for name in WEATHER_CLASSES if name in seen]
    for name in weathers if len(weathers) > 1 else ():
        wanted = [np.ones(len(truth.targets), dtype=bool) for truth in truths]
        frames = np.flatnonzero([truth.weather == name for truth in truths])
        yield BreakdownPart("weather", name, list(detections), wanted, frames)


def _distance(boxes: Boxes) -> Array:
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1])


def _between(value: Array, low: float, high: float) -> Mask:
    return (value >= low) & (value < high)


CLASSES, HIDDEN = "classes", "hidden"
MEASURED = "3d50"
KEPT: Mapping[str, tuple[Kind, float]] = {MEASURED: ("3d", 0.5), "3d70": ("3d", 0.7), "bev50": ("bev", 0.5)}


class ObjectsOutcomes:
    """Mean average precision: AP|R40 in 3D at IoU 0.5, the mean over classes, from matches kept per frame."""

    measure_name = "AP50"
    redraws = REDRAWS

    def describe_targets(self, config: SecondConfig) -> str:
        """Return the classes and the range of a network in words."""
        return describe_range(config)

    def share_targets(self, configs: Sequence[SecondConfig]) -> SecondConfig:
        """Return a configuration with the classes and the range of all `configs`; raises as `share_range` does."""
        return share_range(configs)

    def outcomes(
        self,
        network: Second,
        data: Dataset,
        frames: Sequence[int],
        progress: Report = ignore_progress,
        asked: SecondConfig | None = None,
    ) -> Outcomes:
        """Return the matches of each class and kind of overlap (`KEPT`), by frame, and the number of hidden objects.

        asked: the classes and the range that count, see `detect_frames`; None: the network's. Raises `InputError`
        where there are no frames, or one has no LiDAR.
        """
        read = frames_beside(data, network.config, frames)
        found, truths = detect_frames(network, map(read, frames), asked, total=len(frames), progress=progress)
        classes = (asked or network.config).classes
        if not truths:
            raise InputError("evaluation on 0 frames: at least one is wanted")
        hidden = [sum(int((truth.hidden.label == name).sum()) for truth in truths) for name in classes]
        arrays: dict[str, NDArray] = {CLASSES: np.array(classes), HIDDEN: np.array(hidden)}
        for name in classes:
            by_overlap = match_at_each(*select_sides(found, truths, name), [*KEPT.values()])
            for key, matches in zip(KEPT, by_overlap, strict=True):
                arrays |= {f"{name}/{key}/{field}": value for field, value in vars(matches).items()}
        return Outcomes(np.array([truth.scene for truth in truths]), arrays)

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the mean AP (n,) over the classes with targets, for n resamples of the frames `times` (n, F).

        NaN where no class has targets.
        """
        return self._mean_precision(outcomes, MEASURED, times)

    @property
    def further_measures(self) -> Mapping[str, Measure]:
        """Return AP in 3D at IoU 0.7, for which boxes have to be accurate."""
        return {"AP70": lambda outcomes, times: self._mean_precision(outcomes, "3d70", times)}

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return further metrics by name, means over the classes with targets; None where there are none.

        AP in 3D at IoU 0.7 and in bird's-eye view at 0.5, AOS, the share of right headings, and the numbers of targets
        and hidden objects. Of several classes also AP in 3D at IoU 0.5 of each.
        """
        once = np.ones((1, len(outcomes.scene)), dtype=np.int64)
        per_class = [read_matches(outcomes, name) for name in outcomes.arrays[CLASSES]]
        known = [matches for matches in per_class if matches.targets.any()]
        right = [share for matches in known if not np.isnan(share := right_headings(matches))]
        return {
            "AP70": _number(self._mean_precision(outcomes, "3d70", once)[0]),
            "BEV AP50": _number(self._mean_precision(outcomes, "bev50", once)[0]),
            "AOS50": float(np.mean([orientation_similarity(matches) for matches in known])) if known else None,
            "right headings": float(np.mean(right)) if right else None,
            "targets": float(sum(int(matches.targets.sum()) for matches in per_class)),
            "hidden": float(outcomes.arrays[HIDDEN].sum()),
            **(_precision_by_class(outcomes, once) if len(per_class) > 1 else {}),
        }

    def count(self, outcomes: Outcomes) -> Counted:
        """Return the numbers of targets, of those found at IoU 0.5 in 3D, and of false detections, over all classes.

        Detections below the score `THRESHOLD` do not count.
        """
        classes = outcomes.arrays[CLASSES].tolist()
        matches = [read_matches(outcomes, name) for name in classes]
        hit = np.concatenate([each.hit[each.score >= THRESHOLD] for each in matches])
        targets = sum(int(each.targets.sum()) for each in matches)
        return Counted("cars" if classes == ["Car"] else "road users", targets, int(hit.sum()), int((~hit).sum()))

    def _mean_precision(self, outcomes: Outcomes, key: str, times: Times) -> Values:
        per_class = [weighted_precision(read_matches(outcomes, name, key), times) for name in outcomes.arrays[CLASSES]]
        known = ~np.isnan(per_class)
        with np.errstate(invalid="ignore"):
            return np.where(known, per_class, 0.0).sum(axis=0) / known.sum(axis=0)


def _precision_by_class(outcomes: Outcomes, times: Times) -> dict[str, float | None]:
    """Return AP in 3D at IoU 0.5 of each class, as "AP50 NAME"; None where it has no targets."""
    names = outcomes.arrays[CLASSES].tolist()
    return {f"AP50 {name}": _number(weighted_precision(read_matches(outcomes, name), times)[0]) for name in names}


def read_matches(outcomes: Outcomes, name: str, key: str = MEASURED) -> Matches:
    """Return the matches of class `name` for `key`, a kind of overlap and IoU in `KEPT`."""
    return Matches(**{field.name: outcomes.arrays[f"{name}/{key}/{field.name}"] for field in fields(Matches)})


def join_outcomes(parts: Sequence[Outcomes]) -> Outcomes:
    """Return the outcomes of a network on the frames of several tests, one after another, as those of one test.

    Scenes of different parts are different scenes: their names begin with the number of the part.
    """
    scenes = np.array([f"{number}/{scene}" for number, each in enumerate(parts) for scene in each.scene])
    arrays: dict[str, NDArray] = {
        CLASSES: parts[0].arrays[CLASSES],
        HIDDEN: np.sum([each.arrays[HIDDEN] for each in parts], axis=0),
    }
    before = np.cumsum([0, *(len(each.scene) for each in parts)])
    for label in parts[0].arrays[CLASSES]:
        for key in KEPT:
            matches = [read_matches(part, str(label), key) for part in parts]
            columns = [vars(each) for each in matches]
            joined = {name: np.concatenate([each[name] for each in columns]) for name in columns[0]}
            joined["frame"] = np.concatenate([each.frame + first for each, first in zip(matches, before)])
            order = np.argsort(-joined["score"], kind="stable")
            joined |= {name: joined[name][order] for name in ("score", "hit", "turned", "frame")}
            arrays |= {f"{label}/{key}/{name}": value for name, value in joined.items()}
    return Outcomes(scenes, arrays)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)

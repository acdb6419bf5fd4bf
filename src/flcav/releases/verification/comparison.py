"""Paired comparison of two networks over scenes: the overall measure, and guards of slices.

The bootstrap resamples whole scenes, the same for both networks. The overall claim is non-inferiority (Piaggio et al.,
JAMA 308, 2012): the one-sided lower bound of the difference at .05 is above minus the margin. There are many guards, so
that the same claim for all of them would refuse good networks by chance; they only protect against large losses. A
guard has a `Limit`, and is lost if the upper bound of the candidate's distance to the limit is below 0. The bound holds
at .05 for all guards together (Bonferroni), by Student's t with the bootstrap's standard error. A guard is not judged
if the driving network itself reaches almost nothing, since shares of that vary by chance.

This module has the guards by AP, which ranks detections of all scores; `guards` has those of single classes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import stdtrit

from flcav.geometry import Boxes, wrap_angle
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics import Matches, weighted_precision
from flcav.perception.metrics.detection import join_frames, lies_on, match_greedily, on_neutral
from flcav.perception.metrics.operating_point import DISTANCES_M
from flcav.perception.objects.evaluate import BORDER_M, OCCLUSIONS
from flcav.perception.objects.truth import FrameTruth, select_class
from flcav.perception.ops.boxes import iou
from flcav.releases.verification.records import LEAST_MEASURE, Comparison, Judgement
from flcav.releases.verification.testing import ConditionResults
from flcav.statistics.bootstrap import REDRAWS
from flcav.statistics.estimates import TAILS
from flcav.statistics.streams import stream

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Overlaps:
    """The overlaps of the D detections of one class in a frame with its T targets and with neutral objects."""

    score: NDArray[np.float64]  # (D,) decreasing
    iou: NDArray[np.float64]  # (D, T) of volumes
    turned: NDArray[np.float64]  # (D, T) difference of headings [rad], in [0, pi]
    covered: Mask  # (D, T) whether at least half of the detection's footprint lies on the target
    neutral: Mask  # (D,) the same for a neutral object
    detections: NDArray[np.int64]  # (D,) indices into the frame's detections of all classes
    targets: NDArray[np.int64]  # (T,) indices into the frame's targets of all classes


def measure_overlaps(detections: Boxes, truth: FrameTruth, label: str) -> Overlaps:
    """Return the overlaps of the detections of one class in a frame."""
    rows, among = np.flatnonzero(detections.label == label), np.flatnonzero(truth.targets.label == label)
    if detections.score is not None:
        rows = rows[np.argsort(-detections.score[rows], kind="stable")]
    found, targets = detections[rows], truth.targets[among]
    known = iou(torch.from_numpy(found.array()), torch.from_numpy(targets.array())).numpy()
    return Overlaps(
        score=np.zeros(0) if found.score is None else found.score,
        iou=known,
        turned=np.abs(wrap_angle(found.yaw[:, None] - targets.yaw)),
        covered=lies_on(found, targets),
        neutral=on_neutral(found, select_class(truth.neutral, label)),
        detections=rows,
        targets=among,
    )


def match_overlaps(
    overlaps: Sequence[Overlaps], least: float, wanted: Sequence[Mask] | None = None, kept: Sequence[Mask] | None = None
) -> Matches:
    """Return the matches at an IoU of `least` or more, for all targets or those of a slice.

    wanted: masks per frame (T,), targets in the slice. kept: masks per frame (D,), detections that count in it.
    """
    parts = [
        _match_frame(each, least, None if wanted is None else wanted[number], None if kept is None else kept[number])
        for number, each in enumerate(overlaps)
    ]
    targets = np.array([count for _, _, count in parts], dtype=np.int64)
    return join_frames([(score, turned) for score, turned, _ in parts], targets)


def match_detections(each: Overlaps, least: float, inside: Mask, rows: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the targets (R,) of the detections `rows` (R,), -1 for none, matched greedily by score.

    least: lowest IoU of a match. inside: (T,) targets that can be matched. rows: increasing.
    """
    return match_greedily(np.where(inside, each.iou, -1.0), least, rows)[rows]


def _match_frame(
    each: Overlaps, least: float, wanted: Mask | None, kept: Mask | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return a frame's counted detections, as scores and heading errors [rad] (NaN: no match), and its targets."""
    inside = np.ones(len(each.targets), bool) if wanted is None else wanted[each.targets]
    rows = np.arange(len(each.score)) if kept is None else np.flatnonzero(kept[each.detections])
    found = match_detections(each, least, inside, rows)
    hit = found >= 0
    turned = np.full(len(rows), np.nan)
    turned[hit] = each.turned[rows[hit], found[hit]]
    ignored = each.neutral | each.covered[:, ~inside].any(axis=1)
    counts = hit | ~ignored[rows]
    return each.score[rows][counts], turned[counts], int(inside.sum())


LEVEL = 0.05  # one-sided
KEPT = 0.8  # share of the driving network's measure that every slice must keep
LEAST_TARGETS = 10  # in a slice that is compared
LEAST_OF_GUARD = 5  # scenes of a guard that is judged
LEAST_SCENES = 10  # of a verification: with fewer, bootstrap intervals are too narrow
Times = NDArray[np.int64]
Values = NDArray[np.float64]
Measure = Callable[[Times], Values]


@dataclass(frozen=True)
class Limit:
    """The limit of the candidate's measure: `share` times the driving network's, plus `more`.

    It is a lower limit or, with `falling`, where lower values are better, an upper one.
    """

    share: float = KEPT
    more: float = 0.0
    falling: bool = False

    @property
    def is_share(self) -> bool:
        """Return whether the limit is a plain share of the driving network's measure."""
        return not self.falling and self.more == 0

    def spare(self, driving: Values, candidate: Values) -> Values:
        """Return the margin (n,) by which the candidate is better than the limit."""
        return (candidate - self.share * driving - self.more) * (-1 if self.falling else 1)


@dataclass(frozen=True)
class GuardPair:
    """A measure of both networks on the same frames, as functions of multiplicities of frames (n, F) to values (n,)."""

    by: str
    name: str
    driving: Measure
    candidate: Measure
    scene: NDArray[np.str_]  # (F,)
    scenes: int  # of the slice
    targets: int
    limit: Limit = Limit()


def draw_scenes(scene: NDArray[np.str_], redraws: int = REDRAWS) -> Times:
    """Return the multiplicities (redraws, F) of F frames in bootstrap samples of their scenes (F,)."""
    names, index = np.unique(scene, return_inverse=True)
    rng = stream(0, "release", "whole", "AP50")
    return rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=redraws)[:, index]


def compare_pair(pair: GuardPair, times: Times, guards: int = 1) -> tuple[Comparison, float]:
    """Return the comparison of a pair, and the standard error of the difference over scenes.

    times: (n, F) bootstrap samples, see `draw_scenes`. guards: number of guards judged together, by which the level is
    divided (Bonferroni).
    """
    # both networks are measured on the same resampled scenes, so that their common variation cancels
    once = np.ones((1, len(pair.scene)), np.int64)
    old, new = pair.driving(once), pair.candidate(once)
    before, after = pair.driving(times), pair.candidate(times)
    known = np.isfinite(before) & np.isfinite(after)
    before, after = before[known], after[known]
    judgement: Judgement = "open"
    spare = None
    weak = pair.limit.is_share and not old[0] >= LEAST_MEASURE
    if len(after) and pair.scenes >= LEAST_OF_GUARD and not weak:
        error = float(pair.limit.spare(before, after).std())
        mean = float(pair.limit.spare(old, new)[0])
        spare = mean + error * float(stdtrit(pair.scenes - 1, 1 - LEVEL / guards))
        least = mean - error * float(stdtrit(pair.scenes - 1, 1 - LEVEL))
        judgement = "lost" if spare < 0 else "kept" if least >= 0 else "open"
    interval, change = (np.nan, np.nan), (np.nan, np.nan)
    if len(after):
        interval, change = np.quantile(after, TAILS), np.quantile(after - before, (LEVEL, 1 - LEVEL))
    compared = Comparison(
        by=pair.by,
        name=pair.name,
        targets=pair.targets,
        scenes=pair.scenes,
        driving=float(old[0]),
        candidate=float(new[0]),
        candidate_low=float(interval[0]),
        candidate_high=float(interval[1]),
        low=float(change[0]),
        high=float(change[1]),
        spare=spare,
        judgement=judgement,
    )
    return compared, float((after - before).std()) if len(after) else float("nan")


@dataclass(frozen=True)
class MeasuredNetwork:
    """The results of a network, with overlaps per frame by class with targets."""

    tested: ConditionResults
    overlaps: dict[str, list[Overlaps]]


def measure_results(tested: ConditionResults) -> MeasuredNetwork:
    """Return results with the overlaps of all detections, from which every slice is matched."""
    labels = sorted({str(label) for truth in tested.truths for label in truth.targets.label})
    pairs = [*zip(tested.detections, tested.truths, strict=True)]
    return MeasuredNetwork(tested, {label: [measure_overlaps(*pair, label) for pair in pairs] for label in labels})


def pair_whole(
    driving: MeasuredNetwork, candidate: MeasuredNetwork, by: str = "whole", name: str = "AP50"
) -> GuardPair:
    """Return the pair of the mean AP50 over classes on all frames."""
    return _pair(by, name, _match(driving), _match(candidate), driving)


def pair_slices(driving: MeasuredNetwork, candidate: MeasuredNetwork) -> Iterator[GuardPair]:
    """Yield the pairs by class, distance, occlusion, weather, scenario, town and cell of the domain, and by measure."""
    both = (driving, candidate)
    old, new = (_match(each) for each in both)
    for label in old:
        sides = [{label: each[label]} for each in (old, new)]
        yield _pair("class", label, sides[0], sides[1], driving)
    for by, name, wanted, within in _ranges(driving.tested):
        sides = [_match(each, 0.5, wanted, within) for each in both]
        yield _pair(by, name, sides[0], sides[1], driving)
        yield _pair("found", name, sides[0], sides[1], driving, measure=_recall)
    for by, name, frames in list_frame_slices(candidate.tested):
        yield _pair(by, name, old, new, driving, frames)
        if by != "cell":
            yield _pair("found", name, old, new, driving, frames, _recall)
    yield _pair("measure", "AP70: accurate boxes", _match(driving, 0.7), _match(candidate, 0.7), driving)
    yield _pair("measure", "AOS: right headings", old, new, driving, measure=_orientation)
    yield _pair("measure", f"found from score {THRESHOLD:g} on", old, new, driving, measure=_recall)
    yield _pair("measure", f"right from score {THRESHOLD:g} on", old, new, driving, measure=_precision)


def _ranges(tested: ConditionResults) -> Iterator[tuple[str, str, list[Mask], tuple[float, float] | None]]:
    """Yield the slices of targets: kind, name, masks of targets per frame, range of counted detections [m]."""
    for low, high in DISTANCES_M:
        wanted = [_between(_distance(truth.targets), low, high) for truth in tested.truths]
        yield "distance", f"{low}-{high} m", wanted, (low - BORDER_M, high + BORDER_M)
    hidden = [truth.occlusion for truth in tested.truths if truth.occlusion is not None]
    for low, high in OCCLUSIONS if len(hidden) == len(tested.truths) else ():
        yield "occlusion", f"{low:.0%}-{min(high, 1):.0%}", [_between(share, low, high) for share in hidden], None


def list_frame_slices(tested: ConditionResults) -> Iterator[tuple[str, str, NDArray[np.bool_]]]:
    """Yield the slices of frames, for kinds with several: kind, name, mask of the frames (F,)."""
    names = {
        "weather": [truth.weather or "" for truth in tested.truths],
        "scenario": [each.scenario for each in tested.frames],
        "town": [each.town for each in tested.frames],
        "cell": [each.cell for each in tested.frames],
    }
    for by, labels in names.items():
        known = sorted({name for name in labels if name})
        for name in known if len(known) > 1 else ():
            yield by, name, np.array([each == name for each in labels])


def _distance(boxes: Boxes) -> Values:
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1])


def _between(value: Values, low: float, high: float) -> Mask:
    return (value >= low) & (value < high)


def _match(
    measured: MeasuredNetwork,
    least: float = 0.5,
    wanted: Sequence[Mask] | None = None,
    within: tuple[float, float] | None = None,
) -> dict[str, Matches]:
    """Return the matches by class; wanted: targets of a slice; within: range of counted detections [m]."""
    kept = None if within is None else [_between(_distance(boxes), *within) for boxes in measured.tested.detections]
    return {label: match_overlaps(each, least, wanted, kept) for label, each in measured.overlaps.items()}


def _pair(
    by: str,
    name: str,
    old: dict[str, Matches],
    new: dict[str, Matches],
    driving: MeasuredNetwork,
    inside: Mask | None = None,
    measure: Callable[[Matches, Times], Values] = weighted_precision,
) -> GuardPair:
    """Return the pair over the classes with targets in a slice; inside: (F,) frames in the slice."""
    scene = np.array([truth.scene for truth in driving.tested.truths])
    counted = np.ones(len(scene), np.int64) if inside is None else inside.astype(np.int64)

    def mean(matches: dict[str, Matches]) -> Measure:
        return lambda times: _mean(matches, times * counted, measure)

    targets = sum(int((each.targets * counted).sum()) for each in old.values())
    return GuardPair(by, name, mean(old), mean(new), scene, len(np.unique(scene[counted > 0])), targets)


def _mean(matches: dict[str, Matches], times: Times, measure: Callable[[Matches, Times], Values]) -> Values:
    """Return the means (n,) over the classes with targets; NaN without any."""
    if not matches:
        return np.full(len(times), np.nan)
    each = np.array([measure(one, times) for one in matches.values()])
    known = np.isfinite(each)
    with np.errstate(invalid="ignore"):
        return np.where(known, each, 0.0).sum(axis=0) / known.sum(axis=0)


def _orientation(matches: Matches, times: Times) -> Values:
    """Return the average orientation similarity (n,), AOS (Geiger et al., CVPR 2012)."""
    return weighted_precision(matches, times, (1 + np.cos(np.nan_to_num(matches.turned))) / 2)


def _recall(matches: Matches, times: Times) -> Values:
    """Return the recall (n,) at the score threshold in use."""
    hits = np.bincount(matches.frame[matches.hit & (matches.score >= THRESHOLD)], minlength=len(matches.targets))
    with np.errstate(invalid="ignore"):
        return times @ hits / (times @ matches.targets)


def _precision(matches: Matches, times: Times) -> Values:
    """Return the precision (n,) at the score threshold in use; 0 without detections."""
    used = matches.score >= THRESHOLD
    hits = np.bincount(matches.frame[matches.hit & used], minlength=len(matches.targets))
    every = np.bincount(matches.frame[used], minlength=len(matches.targets))
    return times @ hits / np.maximum(times @ every, 1)

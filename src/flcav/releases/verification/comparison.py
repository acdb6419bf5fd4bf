"""Paired comparison of two networks over scenes: on the whole, and slice by slice.

The bootstrap draws whole scenes, the same for both networks. On the whole, non-inferiority is claimed (Piaggio et al.,
JAMA 308, 2012): the lower bound of the difference at .05, one-sided, lies above minus the margin. Slices are many, so
that the same claim would refuse good networks by chance: they guard against catastrophes alone. A slice is lost where
the candidate keeps less than a share of the driving network's measure, and the test says so at .05. One of `FIRST` of
which it keeps less than half is in doubt even where the test does not say so. Where the driving network itself reaches
next to nothing, shares of it are lost and won by chance: such a slice is not judged. Average precision ranks, so that
scores which fall below their use in one slice do not show in it: what is found at that score is guarded, too.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics import Matches, weighted_precision
from flcav.perception.metrics.operating_point import DISTANCES_M
from flcav.perception.objects.evaluate import BORDER_M, OCCLUSIONS
from flcav.releases.verification.matching import Mask, Overlaps, match_overlaps, measure_overlaps
from flcav.releases.verification.records import LEAST_MEASURE, Comparison, Judgement
from flcav.releases.verification.testing import ConditionResults
from flcav.statistics.bootstrap import REDRAWS, bootstrap_over_scenes
from flcav.statistics.estimates import TAILS
from flcav.statistics.streams import stream

LEVEL = 0.05  # one-sided
KEPT = 0.8  # share of the driving network's measure that every slice keeps
DOUBTED = 0.5  # share below which a slice of `FIRST` is in doubt
FIRST = ("class", "distance", "weather", "scenario", "town")
LEAST_TARGETS = 10  # of a slice that is compared
LEAST_SCENES = 10  # of a verification: the bootstrap of fewer is too sure of itself
Times = NDArray[np.int64]
Values = NDArray[np.float64]
Measure = Callable[[Times], Values]


@dataclass(frozen=True)
class Pair:
    """A measure of both networks on the same frames: (n, F) multiplicities of frames in, (n,) values out."""

    by: str
    name: str
    driving: Measure
    candidate: Measure
    scene: NDArray[np.str_]  # (F,)
    scenes: int  # of the slice
    targets: int


def compare(pair: Pair, redraws: int = REDRAWS) -> tuple[Comparison, float]:
    """Return the comparison of a pair and the standard error of the difference over scenes."""
    rng = stream(0, "release", pair.by, pair.name)
    drawn: list[Values] = []

    def both(times: Times) -> Values:
        drawn[:] = [pair.driving(times), pair.candidate(times)]
        return drawn[1] - drawn[0]

    once = np.ones((1, len(pair.scene)), np.int64)
    old, new = float(pair.driving(once)[0]), float(pair.candidate(once)[0])
    low, high = bootstrap_over_scenes(both, pair.scene, redraws, rng=rng, tails=(LEVEL, 1 - LEVEL))
    known = np.isfinite(drawn[1] - drawn[0])
    before, after = drawn[0][known], drawn[1][known]
    judgement: Judgement = "open"
    if len(after) and old >= LEAST_MEASURE:
        least, most = np.quantile(after - KEPT * before, (LEVEL, 1 - LEVEL))
        doubted = pair.by in FIRST and new < DOUBTED * old
        judgement = "lost" if most < 0 else "kept" if least >= 0 else "doubted" if doubted else "open"
    own = np.quantile(after, TAILS) if len(after) else (np.nan, np.nan)
    error = float((after - before).std()) if len(after) else float("nan")
    bounds = (float(own[0]), float(own[1]), low, high)
    return Comparison(pair.by, pair.name, pair.targets, pair.scenes, old, new, *bounds, judgement), error


@dataclass(frozen=True)
class Measured:
    """Results of a network, with the overlaps frame by frame of each class with targets."""

    tested: ConditionResults
    overlaps: dict[str, list[Overlaps]]


def measure_results(tested: ConditionResults) -> Measured:
    """Return results with the overlaps of all detections, which every slice is matched from."""
    labels = sorted({str(label) for truth in tested.truths for label in truth.targets.label})
    pairs = [*zip(tested.detections, tested.truths, strict=True)]
    return Measured(tested, {label: [measure_overlaps(*pair, label) for pair in pairs] for label in labels})


def pair_whole(driving: Measured, candidate: Measured, by: str = "whole", name: str = "AP50") -> Pair:
    """Return the pair of the mean AP50 over classes on all frames."""
    return _pair(by, name, _match(driving), _match(candidate), driving)


def pair_slices(driving: Measured, candidate: Measured) -> Iterator[Pair]:
    """Yield the pairs by class, distance, occlusion, weather, scenario, town and cell of the domain, and by measure."""
    both = (driving, candidate)
    old, new = (_match(each) for each in both)
    for label in old:
        sides = [{label: each[label]} for each in (old, new)]
        yield _pair("class", label, sides[0], sides[1], driving)
        yield _pair("found", label, sides[0], sides[1], driving, measure=_recall)
    for by, name, wanted, within in _ranges(driving.tested):
        sides = [_match(each, 0.5, wanted, within) for each in both]
        yield _pair(by, name, sides[0], sides[1], driving)
        yield _pair("found", name, sides[0], sides[1], driving, measure=_recall)
    for by, name, frames in _groups(candidate.tested):
        yield _pair(by, name, old, new, driving, frames)
        if by != "cell":
            yield _pair("found", name, old, new, driving, frames, _recall)
    yield _pair("measure", "AP70: accurate boxes", _match(driving, 0.7), _match(candidate, 0.7), driving)
    yield _pair("measure", "AOS: right headings", old, new, driving, measure=_orientation)
    yield _pair("measure", f"found from score {THRESHOLD:g} on", old, new, driving, measure=_recall)
    yield _pair("measure", f"right from score {THRESHOLD:g} on", old, new, driving, measure=_precision)


def _ranges(tested: ConditionResults) -> Iterator[tuple[str, str, list[Mask], tuple[float, float] | None]]:
    """Yield the slices of targets: by, name, which targets, and the distances of detections that count there."""
    for low, high in DISTANCES_M:
        wanted = [_between(_distance(truth.targets), low, high) for truth in tested.truths]
        yield "distance", f"{low}-{high} m", wanted, (low - BORDER_M, high + BORDER_M)
    hidden = [truth.occlusion for truth in tested.truths if truth.occlusion is not None]
    for low, high in OCCLUSIONS if len(hidden) == len(tested.truths) else ():
        yield "occlusion", f"{low:.0%}-{min(high, 1):.0%}", [_between(share, low, high) for share in hidden], None


def _groups(tested: ConditionResults) -> Iterator[tuple[str, str, NDArray[np.bool_]]]:
    """Yield the slices of frames, where there are several of a kind: by, name, which frames (F,)."""
    names = {
        "weather": [truth.weather or "" for truth in tested.truths],
        "scenario": [each.scenario for each in tested.frames],
        "town": [each.town for each in tested.frames],
        "cell": [each.cell for each in tested.frames],
    }
    for by, own in names.items():
        known = sorted({name for name in own if name})
        for name in known if len(known) > 1 else ():
            yield by, name, np.array([each == name for each in own])


def _distance(boxes: Boxes) -> Values:
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1])


def _between(value: Values, low: float, high: float) -> Mask:
    return (value >= low) & (value < high)


def _match(
    measured: Measured,
    least: float = 0.5,
    wanted: Sequence[Mask] | None = None,
    within: tuple[float, float] | None = None,
) -> dict[str, Matches]:
    """Return the matches of each class; wanted: targets of a slice; within: distances of detections that count."""
    kept = None if within is None else [_between(_distance(boxes), *within) for boxes in measured.tested.detections]
    return {label: match_overlaps(each, least, wanted, kept) for label, each in measured.overlaps.items()}


def _pair(
    by: str,
    name: str,
    old: dict[str, Matches],
    new: dict[str, Matches],
    driving: Measured,
    inside: Mask | None = None,
    measure: Callable[[Matches, Times], Values] = weighted_precision,
) -> Pair:
    """Return a pair over the classes with targets in the slice; inside: (F,) frames that are in it."""
    scene = np.array([truth.scene for truth in driving.tested.truths])
    counted = np.ones(len(scene), np.int64) if inside is None else inside.astype(np.int64)

    def mean(matches: dict[str, Matches]) -> Measure:
        return lambda times: _mean(matches, times * counted, measure)

    targets = sum(int((each.targets * counted).sum()) for each in old.values())
    return Pair(by, name, mean(old), mean(new), scene, len(np.unique(scene[counted > 0])), targets)


def _mean(matches: dict[str, Matches], times: Times, measure: Callable[[Matches, Times], Values]) -> Values:
    """Return (n,) the mean over the classes with targets; NaN without any."""
    if not matches:
        return np.full(len(times), np.nan)
    each = np.array([measure(one, times) for one in matches.values()])
    known = np.isfinite(each)
    with np.errstate(invalid="ignore"):
        return np.where(known, each, 0.0).sum(axis=0) / known.sum(axis=0)


def _orientation(matches: Matches, times: Times) -> Values:
    """Return (n,) the average orientation similarity."""
    return weighted_precision(matches, times, (1 + np.cos(np.nan_to_num(matches.turned))) / 2)


def _recall(matches: Matches, times: Times) -> Values:
    """Return (n,) the share of the targets that are found from the score of use on."""
    hits = np.bincount(matches.frame[matches.hit & (matches.score >= THRESHOLD)], minlength=len(matches.targets))
    with np.errstate(invalid="ignore"):
        return times @ hits / (times @ matches.targets)


def _precision(matches: Matches, times: Times) -> Values:
    """Return (n,) the share of right detections among those from the score of use on; 0 where there are none."""
    used = matches.score >= THRESHOLD
    hits = np.bincount(matches.frame[matches.hit & used], minlength=len(matches.targets))
    every = np.bincount(matches.frame[used], minlength=len(matches.targets))
    return times @ hits / np.maximum(times @ every, 1)

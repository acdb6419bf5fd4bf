"""Paired comparison of two networks over scenes: on the whole, and slice by slice.

The bootstrap draws whole scenes, the same for both networks. On the whole, non-inferiority is claimed (Piaggio et al.,
JAMA 308, 2012): the lower bound of the difference at .05, one-sided, lies above minus the margin. Slices are many, so
that the same claim would refuse good networks by chance: they guard against catastrophes alone. A slice is lost where
the candidate keeps less than a share of the driving network's measure, and the test says so at .05.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics import Matches, match, weighted_precision
from flcav.perception.objects.evaluate import BreakdownPart, split_parts
from flcav.perception.objects.truth import select_class
from flcav.releases.verification.records import Comparison, Judgement
from flcav.releases.verification.testing import ConditionResults
from flcav.statistics.bootstrap import REDRAWS, bootstrap_over_scenes
from flcav.statistics.streams import stream

LEVEL = 0.05  # one-sided
KEPT = 0.8  # share of the driving network's measure that every slice keeps
LEAST_TARGETS = 10  # of a slice that is compared
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
    kept = drawn[1] - KEPT * drawn[0]
    kept = kept[np.isfinite(kept)]
    judgement: Judgement = "open"
    if len(kept) and old > 0:
        least, most = np.quantile(kept, (LEVEL, 1 - LEVEL))
        judgement = "lost" if most < 0 else "kept" if least >= 0 else "open"
    change = drawn[1] - drawn[0]
    error = float(np.nanstd(change)) if np.isfinite(change).any() else float("nan")
    return Comparison(pair.by, pair.name, pair.targets, _scenes(pair), old, new, low, high, judgement), error


def pair_whole(driving: ConditionResults, candidate: ConditionResults, by: str = "whole", name: str = "AP50") -> Pair:
    """Return the pair of the mean AP50 over classes on all frames."""
    return _pair(by, name, _match_all(driving), _match_all(candidate), driving)


def pair_slices(driving: ConditionResults, candidate: ConditionResults) -> Iterator[Pair]:
    """Yield the pairs by class, distance, occlusion, weather, scenario and cell (town and weather), and by measure."""
    old, new = _match_all(driving), _match_all(candidate)
    for label in old:
        yield _pair("class", label, {label: old[label]}, {label: new[label]}, driving)
    for one, other in zip(_parts(driving), _parts(candidate), strict=True):
        whole = all(wanted.all() for wanted in one.wanted)  # of its frames: they are matched already
        sides = (old, new) if whole else (_match_part(driving, one), _match_part(candidate, other))
        yield _pair(one.by, one.name, *sides, driving, one.frames)
    finer = _match_all(driving, 0.7), _match_all(candidate, 0.7)
    yield _pair("measure", "AP70: accurate boxes", *finer, driving)
    yield _pair("measure", "AOS: right headings", old, new, driving, measure=_orientation)
    yield _pair("measure", f"found from score {THRESHOLD:g} on", old, new, driving, measure=_recall)
    yield _pair("measure", f"right from score {THRESHOLD:g} on", old, new, driving, measure=_precision)


def _parts(tested: ConditionResults) -> Iterator[BreakdownPart]:
    yield from split_parts(tested.detections, tested.truths)
    weather = [truth.weather for truth in tested.truths]
    groups = {
        "scenario": [each.scenario for each in tested.frames],
        "cell": [f"{each.town}, {name}" if name else "" for each, name in zip(tested.frames, weather, strict=True)],
    }
    wanted = [np.ones(len(truth.targets), bool) for truth in tested.truths]
    for by, names in groups.items():
        known = [name for name in dict.fromkeys(names) if name]
        for name in known if len(known) > 1 else ():
            frames = np.flatnonzero([each == name for each in names])
            yield BreakdownPart(by, name, list(tested.detections), wanted, frames)


def _match_all(tested: ConditionResults, overlap: float = 0.5) -> dict[str, Matches]:
    targets, neutral = [t.targets for t in tested.truths], [t.neutral for t in tested.truths]
    return _match_classes(tested.detections, targets, neutral, overlap)


def _match_part(tested: ConditionResults, part: BreakdownPart) -> dict[str, Matches]:
    targets = [truth.targets[wanted] for truth, wanted in zip(tested.truths, part.wanted, strict=True)]
    others = [truth.targets[~wanted] for truth, wanted in zip(tested.truths, part.wanted, strict=True)]
    neutral = [concatenate([truth.neutral, other]) for truth, other in zip(tested.truths, others, strict=True)]
    return _match_classes(part.detections, targets, neutral, 0.5)


def _match_classes(
    detections: Sequence[Boxes], targets: Sequence[Boxes], neutral: Sequence[Boxes], overlap: float
) -> dict[str, Matches]:
    """Return the matches of each class with targets."""
    labels = sorted({str(label) for boxes in targets for label in boxes.label})
    found = {}
    for label in labels:
        own = ([select_class(boxes, label) for boxes in side] for side in (detections, targets, neutral))
        found[label] = match(next(own), next(own), next(own), overlap)
    return found


def _pair(
    by: str,
    name: str,
    old: dict[str, Matches],
    new: dict[str, Matches],
    tested: ConditionResults,
    frames: NDArray[np.int64] | None = None,
    measure: Callable[[Matches, Times], Values] = weighted_precision,
) -> Pair:
    scene = np.array([truth.scene for truth in tested.truths])
    inside = np.ones(len(scene), np.int64)
    if frames is not None:
        inside = np.isin(np.arange(len(scene)), frames).astype(np.int64)

    def mean(matches: dict[str, Matches]) -> Measure:
        return lambda times: _mean(matches, times * inside, measure)

    targets = sum(int((each.targets * inside).sum()) for each in old.values())
    return Pair(by, name, mean(old), mean(new), scene, targets)


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


def _scenes(pair: Pair) -> int:
    return len(np.unique(pair.scene))

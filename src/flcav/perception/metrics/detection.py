"""Metrics of detection: greedy matching, average precision at 40 recalls, orientation similarity, calibration error.

Detections are matched to truth by IoU, with neutral objects as in the KITTI benchmark. AP|R40 is the mean over recalls
1/40, 2/40, ..., 1 of the highest precision at that recall or a higher one (Simonelli et al., "Disentangling Monocular
3D Object Detection", ICCV 2019, sec. 5; KITTI's measure since then). Average orientation similarity (AOS) is the same
mean of a weighted precision: a true positive with heading error t counts (1 + cos t) / 2 (Geiger et al., "Are we ready
for autonomous driving? The KITTI vision benchmark suite", CVPR 2012, sec. 2.5, eqs. 1-2). Intervals are bootstrap ones
over scenes, see `flcav.statistics`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit

from flcav.arrays import Array, Ints, Mask
from flcav.geometry import Boxes, wrap_angle
from flcav.perception.ops.boxes import Kind, intersection_area, iou
from flcav.statistics.bootstrap import REDRAWS, bootstrap_over_scenes


@dataclass(frozen=True)
class Matches:
    """True and false positives: the D detections of F frames that count, highest score first.

    Detections that lie on a neutral object are not among them.
    """

    score: Array  # (D,)
    hit: Mask  # (D,) True: true positive; False: false positive
    turned: Array  # (D,) heading error [rad], in [0, pi]; NaN for a false positive
    frame: Ints  # (D,) number of the frame, 0 to F - 1
    targets: Ints  # (F,) number of targets in each frame


def match(
    detections: Sequence[Boxes],
    targets: Sequence[Boxes],
    neutral: Sequence[Boxes],
    overlap: float,
    kind: Kind = "3d",
) -> Matches:
    """Return the true and false positives of a class over frames; the three sequences run over the same frames.

    In each frame, in order of score, a detection is matched to the unmatched target of highest IoU (of `kind`), if that
    is at least `overlap`. An unmatched detection is left out where it lies on a neutral object, see `on_neutral`;
    otherwise it is a false positive. This is the rule of the KITTI benchmark, with greedy assignment by score.

    Raises ValueError where there are detections without scores.
    """
    (matches,) = match_at_each(detections, targets, neutral, [(kind, overlap)])
    return matches


def match_at_each(
    detections: Sequence[Boxes],
    targets: Sequence[Boxes],
    neutral: Sequence[Boxes],
    overlaps: Sequence[tuple[Kind, float]],
) -> Iterator[Matches]:
    """Yield the result of `match` at each of `overlaps`: kinds and least values of IoU, which is computed once."""
    pairs = [
        (one, on, {kind: measure_iou(one, on, kind) for kind, _ in overlaps}, ~on_neutral(one, off))
        for one, on, off in zip(detections, targets, neutral, strict=True)
    ]
    wanted = np.array([len(boxes) for boxes in targets], dtype=np.int64)
    for kind, least in overlaps:
        yield join_frames([_match_frame(one, on, ious[kind], least, aside) for one, on, ious, aside in pairs], wanted)


def join_frames(frames: Sequence[tuple[Array, Array]], targets: Ints) -> Matches:
    """Return the matches of F frames by falling score.

    Args:
        frames: scores (D,) and heading errors (D,) [rad] of each frame's detections; NaN for a false positive.
        targets: (F,) number of targets in each frame.
    """
    frame = np.repeat(np.arange(len(frames)), [len(scores) for scores, _ in frames])
    score, turned = (np.concatenate(column) for column in zip(*frames)) if frames else (np.zeros(0), np.zeros(0))
    order = np.argsort(-score, kind="stable")
    return Matches(score[order], ~np.isnan(turned[order]), turned[order], frame[order], targets)


def assign_targets(detections: Boxes, targets: Boxes, overlap: float, kind: Kind = "3d") -> Ints:
    """Return the index (D,) of the target matched to each detection, -1 for none: `match_greedily` by score.

    `overlap` is the least IoU of `kind` for a match. Raises ValueError where there are detections without scores.
    """
    return _assign(detections, measure_iou(detections, targets, kind), overlap)


def measure_iou(detections: Boxes, targets: Boxes, kind: Kind = "3d") -> Array:
    """Return the IoU (D, T) of `kind` of each detection with each target."""
    if not len(detections) or not len(targets):
        return np.zeros((len(detections), len(targets)))
    return iou(torch.from_numpy(detections.array()), torch.from_numpy(targets.array()), kind).numpy()


def match_greedily(overlap: Array, least: float, order: Iterable[int] | None = None) -> Ints:
    """Return the target (D,) matched to each of D detections, -1 for none.

    One detection after another takes the remaining target that it overlaps most, if by `least` (> 0) or more.

    Args:
        overlap: (D, T) of each detection with each target.
        least: smallest overlap of a match.
        order: order of the detections, by falling score; None: as they stand.
    """
    matched = np.full(len(overlap), -1)
    left = overlap.copy()
    for number in range(len(left)) if order is None else order:
        if left.size and left[number, best := int(left[number].argmax())] >= least:
            matched[number] = best
            left[:, best] = -1
    return matched


def on_neutral(detections: Boxes, neutral: Boxes) -> Mask:
    """Return the mask (D,) of detections with at least half of their footprint on one neutral object.

    The intersection is divided by the area of the detection. IoU would not do: a car detected on a bus covers a small
    part of the bus.
    """
    return np.any(lies_on(detections, neutral), axis=1)


def lies_on(detections: Boxes, objects: Boxes) -> Mask:
    """Return whether (D, N) at least half of a detection's footprint lies on each of N objects."""
    out = np.zeros((len(detections), len(objects)), dtype=bool)
    if not len(objects):
        return out
    radius = np.hypot(detections.size[:, :1], detections.size[:, 1:2]) + np.hypot(
        objects.size[:, 0], objects.size[:, 1]
    )
    distance = np.linalg.norm(detections.center[:, None, :2] - objects.center[None, :, :2], axis=2)
    of, on = np.nonzero(distance < radius / 2)
    rows, boxes = torch.from_numpy(detections.array()[of]), torch.from_numpy(objects.array()[on])
    shared = intersection_area(rows, boxes).numpy()
    out[of, on] = shared >= 0.5 * detections.size[of, 0] * detections.size[of, 1]
    return out


def _match_frame(detections: Boxes, targets: Boxes, ious: Array, least: float, aside: Mask) -> tuple[Array, Array]:
    """Return the scores (D,) of a frame's detections that count, and their heading errors (D,), see `Matches`.

    `aside` (D,) tells the detections that lie on no neutral object.
    """
    target = _assign(detections, ious, least)
    hit = target >= 0
    turned = np.full(len(target), np.nan)
    turned[hit] = np.abs(wrap_angle(detections.yaw[hit] - targets.yaw[target[hit]]))
    counts = hit | aside
    return _scores(detections)[counts], turned[counts]


def _assign(detections: Boxes, ious: Array, least: float) -> Ints:
    return match_greedily(ious, least, np.argsort(-_scores(detections), kind="stable"))


def _scores(detections: Boxes) -> Array:
    if detections.score is None:
        if len(detections):
            raise ValueError("detections without scores cannot be matched")
        return np.zeros(0)
    return detections.score


RECALLS = np.arange(1, 41) / 40
AT_ONCE = 2**15  # bootstrap resamples times detections: arrays of 0.25 MB stay in a processor's cache


def average_precision(matches: Matches, frames: ArrayLike | None = None) -> float:
    """Return the average precision AP|R40 in [0, 1] over `frames`; NaN where they hold no targets.

    `frames` are indices, in which a frame may repeat (None: every frame once).
    """
    return float(weighted_precision(matches, _times(matches, frames))[0])


def orientation_similarity(matches: Matches, frames: ArrayLike | None = None) -> float:
    """Return the average orientation similarity AOS|R40 in [0, AP|R40] over `frames`; NaN where they hold no targets.

    frames: as in `average_precision`.
    """
    worth = (1 + np.cos(np.nan_to_num(matches.turned))) / 2
    return float(weighted_precision(matches, _times(matches, frames), worth)[0])


def right_headings(matches: Matches) -> float:
    """Return the share of true positives with a heading error below 90 degrees; NaN without true positives."""
    return float((matches.turned[matches.hit] < np.pi / 2).mean()) if matches.hit.any() else float("nan")


def bootstrap_interval(
    matches: Matches, scene_of_frame: ArrayLike, n: int = REDRAWS, *, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval (low, high) of AP over `n` resamples of the scenes.

    scene_of_frame (F,): scene of each frame. NaN where fewer than two scenes hold targets.
    """
    if len(np.unique(np.asarray(scene_of_frame)[matches.targets > 0])) < 2:
        return float("nan"), float("nan")
    return bootstrap_over_scenes(lambda times: weighted_precision(matches, times), scene_of_frame, n, rng=rng)


def interval_words(low: float | None, high: float | None) -> str:
    """Return an interval over scenes as text: "[0.123, 0.456]", or that there is none where a limit is None."""
    return "(no interval: one scene)" if low is None or high is None else f"[{low:.3f}, {high:.3f}]"


def round_or_none(value: float) -> float | None:
    """Return the number rounded to six decimals, or None for NaN, which JSON cannot hold."""
    return None if np.isnan(value) else round(value, 6)


def _times(matches: Matches, frames: ArrayLike | None) -> Ints:
    """Return the multiplicity (1, F) of each frame in `frames`."""
    if frames is None:
        return np.ones((1, len(matches.targets)), dtype=np.int64)
    return np.bincount(np.asarray(frames, dtype=np.int64), minlength=len(matches.targets))[None]


def weighted_precision(matches: Matches, times: Ints, worth: Array | float = 1.0) -> Array:
    """Return weighted average precision (n,) of n resamples of the frames; NaN where a resample holds no targets.

    times (n, F): multiplicity of each frame in each resample; worth (D,) or one number: what a true positive adds to
    the precision, 1 for AP, (1 + cos t) / 2 for AOS.
    """
    ends = np.flatnonzero(np.diff(matches.score, append=-np.inf) != 0)  # detections of equal score enter together
    worths = np.where(matches.hit, worth, 0.0)
    block = max(AT_ONCE // max(len(matches.score), 1), 1)
    blocks = (times[start : start + block] for start in range(0, len(times), block))
    return np.concatenate([_average(matches, worths, ends, part) for part in blocks])


def _average(matches: Matches, worths: Array, ends: NDArray[np.intp], times: Ints) -> Array:
    """Return weighted AP (n,) of `times` (n, F); `ends` (E,): index of the last detection of each distinct score."""
    wanted = times @ matches.targets
    # Counts of all thresholds and resamples at once: cumulative sums over detections in order of falling score.
    weight = np.take(times, matches.frame, axis=1)
    hits, detections = np.cumsum(weight * matches.hit, axis=1)[:, ends], np.cumsum(weight, axis=1)[:, ends]
    precision = np.cumsum(weight * worths, axis=1)[:, ends] / np.maximum(detections, 1)
    best_onwards = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    best_onwards = np.column_stack((best_onwards, np.zeros(len(times))))
    needed = RECALLS * wanted[:, None] - 1e-9
    place = np.stack([np.searchsorted(*one) for one in zip(hits, needed)])  # first threshold that reaches the recall
    mean = np.take_along_axis(best_onwards, place, axis=1).mean(axis=1)
    return np.where(wanted > 0, mean, np.nan)


BINS = 10
PULL = 0.01  # weight of the quadratic penalty on the summand and the logarithm of the factor


def calibration_error(score: ArrayLike, hit: ArrayLike, bins: int = BINS) -> float:
    """Return the expected calibration error (ECE) of D detections, in [0, 1]; NaN without detections.

    score (D,) in [0, 1]; hit (D,) whether the detection is correct. The ECE is the mean over detections of |mean score
    - share of hits| in the detection's bin, `bins` of equal width (Naeini et al., "Obtaining well calibrated
    probabilities using Bayesian binning", AAAI 2015).
    """
    scores = np.asarray(score, dtype=np.float64)
    hits = np.asarray(hit, dtype=np.float64)
    if not len(scores):
        return float("nan")
    number = np.minimum((scores * bins).astype(np.int64), bins - 1)
    gap = np.bincount(number, scores - hits, bins)
    return float(np.abs(gap).sum() / len(scores))


def fit_logistic(score: ArrayLike, hit: ArrayLike) -> tuple[float, float]:
    """Return factor (positive) and summand of Platt scaling: calibrated logit = factor * logit + summand.

    Fitted by penalised maximum likelihood to scores (D,) in [0, 1] and hits (D,), with the smoothed targets of Platt,
    "Probabilistic outputs for support vector machines", 1999, sec. 2.2. (1, 0), no change, where all or none are hits.
    """
    x = logit(np.clip(np.asarray(score, dtype=np.float64), 1e-7, 1 - 1e-7))
    hits = np.asarray(hit, dtype=bool)
    right, wrong = int(hits.sum()), int((~hits).sum())
    if not right or not wrong:
        return 1.0, 0.0
    wanted = np.where(hits, (right + 1) / (right + 2), 1 / (wrong + 2))

    def loss(parameters: Array) -> tuple[float, Array]:
        factor = np.exp(parameters[0])
        z = factor * x + parameters[1]
        value = np.logaddexp(0, z) - wanted * z
        slope = expit(z) - wanted
        prior = PULL * parameters
        gradient = np.array(((slope * x).sum() * factor, slope.sum())) + 2 * prior
        return float(value.sum() + (prior * parameters).sum()), gradient

    found = minimize(loss, np.zeros(2), jac=True, method="L-BFGS-B", bounds=((-3, 3), (-10, 10)))
    return float(np.exp(found.x[0])), float(found.x[1])

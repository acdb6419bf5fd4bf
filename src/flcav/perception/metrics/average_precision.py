"""Average precision at 40 recalls, average orientation similarity, and bootstrap intervals of them over scenes.

AP|R40 is the mean over recalls 1/40, 2/40, ..., 1 of the highest precision at that recall or a higher one (Simonelli
et al., "Disentangling Monocular 3D Object Detection", ICCV 2019, sec. 5; KITTI's measure since then). Average
orientation similarity (AOS) is the same mean of a weighted precision: a true positive with heading error t counts
(1 + cos t) / 2 (Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012,
sec. 2.5, eqs. 1-2). Intervals: see `flcav.statistics`.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flcav.perception.metrics.matching import Matches
from flcav.statistics.bootstrap import REDRAWS, bootstrap_over_scenes

RECALLS = np.arange(1, 41) / 40
AT_ONCE = 2**15  # bootstrap resamples times detections: arrays of 0.25 MB stay in a processor's cache


def average_precision(matches: Matches, frames: ArrayLike | None = None) -> float:
    """Return the average precision AP|R40 in [0, 1] over `frames`; NaN where those frames hold no targets.

    frames: indices, in which a frame may repeat (None: each frame once).
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


def _times(matches: Matches, frames: ArrayLike | None) -> NDArray[np.int64]:
    """Return (1, F) the multiplicity of each frame in `frames`."""
    if frames is None:
        return np.ones((1, len(matches.targets)), dtype=np.int64)
    return np.bincount(np.asarray(frames, dtype=np.int64), minlength=len(matches.targets))[None]


def weighted_precision(
    matches: Matches, times: NDArray[np.int64], worth: NDArray[np.float64] | float = 1.0
) -> NDArray[np.float64]:
    """Return weighted average precision (n,) of n resamples of the frames; NaN where a resample holds no targets.

    times (n, F): multiplicity of each frame in each resample; worth (D,) or one number: what a true positive adds to
    the precision, 1 for AP, (1 + cos t) / 2 for AOS.
    """
    ends = np.flatnonzero(np.diff(matches.score, append=-np.inf) != 0)  # detections of equal score enter together
    worths, block = np.where(matches.hit, worth, 0.0), max(AT_ONCE // max(len(matches.score), 1), 1)
    blocks = (times[start : start + block] for start in range(0, len(times), block))
    return np.concatenate([_average(matches, worths, ends, part) for part in blocks])


def _average(
    matches: Matches, worths: NDArray[np.float64], ends: NDArray[np.intp], times: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return weighted AP (n,) of `times` (n, F); `ends` (E,): index of the last detection of each distinct score."""
    wanted = times @ matches.targets
    weight = np.take(times, matches.frame, axis=1)
    hits, detections = np.cumsum(weight * matches.hit, axis=1)[:, ends], np.cumsum(weight, axis=1)[:, ends]
    precision = np.cumsum(weight * worths, axis=1)[:, ends] / np.maximum(detections, 1)
    best_onwards = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    best_onwards = np.column_stack((best_onwards, np.zeros(len(times))))
    needed = RECALLS * wanted[:, None] - 1e-9
    place = np.stack([np.searchsorted(*one) for one in zip(hits, needed)])  # first threshold that reaches the recall
    found = np.take_along_axis(best_onwards, place, axis=1).mean(axis=1)
    return np.where(wanted > 0, found, np.nan)

"""Average precision over 40 recall positions, and how sure one can be of it.

AP|R40 is the mean over recalls 1/40, 2/40, ..., 1 of the best precision reached at that recall or a higher one
(Simonelli et al., "Disentangling Monocular 3D Object Detection", ICCV 2019, sec. 5; KITTI's measure since then).
Average orientation similarity is the same mean of another precision: a hit turned by t counts (1 + cos t) / 2 (Geiger
et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012, sec. 2.5, eqs. 1-2).
Intervals are over scenes, see `flcav.intervals`.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flcav.intervals import REDRAWS, over_scenes
from flcav.perception.metrics.matching import Matches

RECALLS = np.arange(1, 41) / 40
AT_ONCE = 2**15  # redrawings times detections: arrays of 0.25 MB stay in a processor's cache


def average_precision(matches: Matches, frames: ArrayLike | None = None) -> float:
    """Return AP|R40 in [0, 1] over `frames`, an index array in which frames may repeat (None: each frame once).

    NaN where those frames hold nothing to find.
    """
    return float(weighted_precision(matches, _times(matches, frames))[0])


def orientation_similarity(matches: Matches, frames: ArrayLike | None = None) -> float:
    """Return the average orientation similarity (AOS|R40) in [0, AP|R40] over `frames`, as `average_precision` does."""
    worth = (1 + np.cos(np.nan_to_num(matches.turned))) / 2
    return float(weighted_precision(matches, _times(matches, frames), worth)[0])


def right_headings(matches: Matches) -> float:
    """Return the share of hits whose heading is off by less than a right angle; NaN without hits."""
    return float((matches.turned[matches.hit] < np.pi / 2).mean()) if matches.hit.any() else float("nan")


def bootstrap_interval(
    matches: Matches, scene_of_frame: ArrayLike, n: int = REDRAWS, *, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % percentile interval of AP under redrawing of scenes; `scene_of_frame` (F,) names each's scene.

    NaN where fewer than two scenes hold something to find: nothing then says how much scenes differ.
    """
    if len(np.unique(np.asarray(scene_of_frame)[matches.targets > 0])) < 2:
        return float("nan"), float("nan")
    return over_scenes(lambda times: weighted_precision(matches, times), scene_of_frame, n, rng=rng)


def bootstrap_difference(
    before: Matches, after: Matches, scene_of_frame: ArrayLike, n: int = REDRAWS, *, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % percentile interval of AP(after) - AP(before), both on the same redrawn frames."""
    return over_scenes(
        lambda times: weighted_precision(after, times) - weighted_precision(before, times), scene_of_frame, n, rng=rng
    )


def interval_words(low: float | None, high: float | None) -> str:
    """Return an interval over scenes in brackets; None is one that a single scene leaves unknown."""
    return "(no interval: one scene)" if low is None or high is None else f"[{low:.3f}, {high:.3f}]"


def _times(matches: Matches, frames: ArrayLike | None) -> NDArray[np.int64]:
    """Return (1, F) how often each frame counts."""
    if frames is None:
        return np.ones((1, len(matches.targets)), dtype=np.int64)
    return np.bincount(np.asarray(frames, dtype=np.int64), minlength=len(matches.targets))[None]


def weighted_precision(
    matches: Matches, times: NDArray[np.int64], worth: NDArray[np.float64] | float = 1.0
) -> NDArray[np.float64]:
    """Return AP (n,) where each frame counts `times` (n, F) and each hit `worth` (D,) towards the precision."""
    ends = np.flatnonzero(np.diff(matches.score, append=-np.inf) != 0)  # equal scores enter together
    worths, block = np.where(matches.hit, worth, 0.0), max(AT_ONCE // max(len(matches.score), 1), 1)
    blocks = (times[start : start + block] for start in range(0, len(times), block))
    return np.concatenate([_average(matches, worths, ends, part) for part in blocks])


def _average(
    matches: Matches, worths: NDArray[np.float64], ends: NDArray[np.intp], times: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return AP (n,) of `times` (n, F); NaN where nothing is to be found. `ends` (E,): the last of equal scores."""
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

"""Average precision over 40 recall positions, and how sure one can be of it.

AP|R40 is the mean over recalls 1/40, 2/40, ..., 1 of the best precision reached at that recall or a higher one
(Simonelli et al., "Disentangling Monocular 3D Object Detection", ICCV 2019, sec. 5; KITTI's measure since then).
Average orientation similarity is the same mean of another precision: a hit turned by t counts (1 + cos t) / 2 (Geiger
et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012, sec. 2.5, eqs. 1-2).
Intervals are percentile bootstraps over scenes: frames of one scene share traffic, so whole scenes are redrawn.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flcav.perception.metrics.matching import Matches

RECALLS = np.arange(1, 41) / 40
CONFIDENCE = 0.95


def average_precision(matches: Matches, frames: ArrayLike | None = None) -> float:
    """Return AP|R40 in [0, 1] over `frames`, an index array in which frames may repeat (None: each frame once).

    NaN where those frames hold nothing to find.
    """
    return _weighted(matches, _times(matches, frames))


def orientation_similarity(matches: Matches, frames: ArrayLike | None = None) -> float:
    """Return the average orientation similarity (AOS|R40) in [0, AP|R40] over `frames`, as `average_precision` does."""
    return _weighted(matches, _times(matches, frames), (1 + np.cos(np.nan_to_num(matches.turned))) / 2)


def right_headings(matches: Matches) -> float:
    """Return the share of hits whose heading is off by less than a right angle; NaN without hits."""
    return float((matches.turned[matches.hit] < np.pi / 2).mean()) if matches.hit.any() else float("nan")


def bootstrap_interval(
    matches: Matches, scene_of_frame: ArrayLike, n: int = 1000, *, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % percentile interval of AP under redrawing of scenes; `scene_of_frame` (F,) names each's scene.

    NaN where fewer than two scenes hold something to find: nothing then says how much scenes differ.
    """
    if len(np.unique(np.asarray(scene_of_frame)[matches.targets > 0])) < 2:
        return float("nan"), float("nan")
    draws = np.array([_weighted(matches, times) for times in _redrawn(scene_of_frame, n, rng)])
    return _interval(draws)


def bootstrap_difference(
    before: Matches, after: Matches, scene_of_frame: ArrayLike, n: int = 1000, *, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % percentile interval of AP(after) - AP(before), both on the same redrawn frames."""
    draws = [_weighted(after, times) - _weighted(before, times) for times in _redrawn(scene_of_frame, n, rng)]
    return _interval(np.array(draws))


def interval_words(low: float | None, high: float | None) -> str:
    """Return an interval over scenes in brackets; None is one that a single scene leaves unknown."""
    return "(no interval: one scene)" if low is None or high is None else f"[{low:.3f}, {high:.3f}]"


def _times(matches: Matches, frames: ArrayLike | None) -> NDArray[np.int64]:
    """Return (F,) how often each frame counts."""
    if frames is None:
        return np.ones(len(matches.targets), dtype=np.int64)
    return np.bincount(np.asarray(frames, dtype=np.int64), minlength=len(matches.targets))


def _weighted(matches: Matches, times: NDArray[np.int64], worth: NDArray[np.float64] | float = 1.0) -> float:
    """Return AP where each frame counts `times` (F,) and each hit `worth` (D,) towards the precision."""
    wanted = int((matches.targets * times).sum())
    if not wanted:
        return float("nan")
    weight = times[matches.frame]
    hits, all_detections = np.cumsum(weight * matches.hit), np.cumsum(weight)
    worths = np.cumsum(weight * matches.hit * worth)
    ends = np.flatnonzero(np.diff(matches.score, append=-np.inf) != 0)  # equal scores enter together
    precision = worths[ends] / np.maximum(all_detections[ends], 1)
    best_onwards = np.maximum.accumulate(precision[::-1])[::-1]
    place = np.searchsorted(hits[ends], RECALLS * wanted - 1e-9)  # first threshold that reaches the recall
    return float(np.append(best_onwards, 0.0)[place].mean())


def _redrawn(scene_of_frame: ArrayLike, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return (n, F) how often each frame occurs in each of n redrawings of the scenes."""
    names, scene = np.unique(np.asarray(scene_of_frame), return_inverse=True)
    times = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=n)
    return times[:, scene]


def _interval(draws: NDArray[np.float64]) -> tuple[float, float]:
    known = draws[np.isfinite(draws)]
    if not len(known):
        return float("nan"), float("nan")
    low, high = np.quantile(known, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)

"""Bootstrap over scenes: frames of one scene share their traffic, so whole scenes are resampled.

Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 13: percentile intervals.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from flcav.arrays import Array, Ints
from flcav.statistics.estimates import TAILS
from flcav.statistics.seeds import OWN_SCENES, SharedScenes

REDRAWS = 1000  # bootstrap resamples


def bootstrap_over_scenes(
    measure: Callable[[Ints], Array],
    scene_of_frame: ArrayLike,
    n: int = REDRAWS,
    *,
    rng: np.random.Generator,
    tails: tuple[float, float] = TAILS,
) -> tuple[float, float]:
    """Return the ends of the percentile interval of a measure, 95 %, from `n` bootstrap resamples of the scenes.

    `measure` maps (n, F) counts, the multiplicity of each of F frames in each resample, to (n,) values, NaN where it is
    undefined; such resamples are left out, and both ends are NaN where none is left. `scene_of_frame` (F,) has the
    scene of each frame; `tails` are the quantiles of the ends.
    """
    names, scene = np.unique(np.asarray(scene_of_frame), return_inverse=True)
    times = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=n)
    draws = measure(times[:, scene])
    known = draws[np.isfinite(draws)]
    if not len(known):
        return float("nan"), float("nan")
    low, high = np.quantile(known, tails)
    return float(low), float(high)


def share_scenes(
    measures: Sequence[Callable[[Ints], Array]],
    scenes_of_frames: Sequence[ArrayLike],
    n: int = REDRAWS,
    *,
    rng: np.random.Generator,
) -> SharedScenes:
    """Return the standard deviation of the mean over seeds that is due to the test scenes that seeds share.

    `measures` and `scenes_of_frames` are those of `bootstrap_over_scenes`, one per seed. A scene's weight is drawn from
    a Poisson distribution of mean 1, the same in all seeds that have it (Poisson bootstrap; Hanley and MacGibbon,
    Computer Methods and Programs in Biomedicine 83, 2006). The variance is the mean covariance between two seeds, at
    least 0.
    """
    scenes = [np.asarray(seed_scenes) for seed_scenes in scenes_of_frames]
    names, counts = np.unique(np.concatenate([np.unique(seed_scenes) for seed_scenes in scenes]), return_counts=True)
    shared = int((counts > 1).sum())
    if not shared:
        return OWN_SCENES
    times = rng.poisson(1.0, size=(n, len(names)))
    draws = np.array(
        [measure(times[:, np.searchsorted(names, of_seed)]) for measure, of_seed in zip(measures, scenes, strict=True)]
    )
    covariance = np.cov(draws[:, np.isfinite(draws).all(axis=0)])
    between = covariance[~np.eye(len(draws), dtype=bool)].mean()
    return SharedScenes(float(np.sqrt(max(between, 0.0))), shared)

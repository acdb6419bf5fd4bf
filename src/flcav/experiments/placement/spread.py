"""Spread of the difference of two poles' gains: between seeds, and by the draw of the test scenes within each."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from flcav.experiments.placement.records import FRAMES, SeedGains
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import Outcomes
from flcav.statistics.streams import stream

DRAWS = 1000  # of the scenes


def spread_over_seeds(seeds: Sequence[SeedGains], frames: str) -> float:
    """Return the standard deviation over seeds of the difference of two poles' gains, variances averaged over pairs.

    Poles that some seed lacks are left out; 0 of a single seed.
    """
    each = [{pole.pole: pole.gain[frames] for pole in seed.poles} for seed in seeds]
    common = sorted(set.intersection(*(set(own) for own in each)))
    gains = np.array([[own[pole] for pole in common] for own in each])
    return float(np.sqrt(average_variance(gains.T))) if len(seeds) > 1 and len(common) > 1 else 0.0


def spread_over_scenes(
    tested: Sequence[Outcomes], counted: Mapping[str, NDArray[np.bool_]], seed: int
) -> dict[str, float]:
    """Return by choice of frames the standard deviation of the difference of two poles' gains over draws of the scenes.

    tested: outcomes of each pole's arm on the same test frames; counted: (F,) whether a frame is of the choice. All
    arms have the same draws (bootstrap), and variances are averaged over pairs of poles. 0 of a single pole.
    """
    if len(tested) < 2:
        return dict.fromkeys(counted, 0.0)
    names, scene = np.unique(tested[0].scene, return_inverse=True)
    drawn = stream(seed, "test-scenes").multinomial(len(names), np.full(len(names), 1 / len(names)), size=DRAWS)
    spread = {}
    for frames, own in counted.items():
        reached = np.array([OBJECTS.measure(each, drawn[:, scene] * own) for each in tested])
        known = reached[:, ~np.isnan(reached).any(axis=0)]  # draws with something to find
        spread[frames] = float(np.sqrt(average_variance(known)))
    return spread


def pool_over_seeds(seeds: Sequence[SeedGains]) -> dict[str, float] | None:
    """Return the root mean square over seeds of `spread_over_scenes`; None where a seed's is not known."""
    known = [seed.scene_sd for seed in seeds if seed.scene_sd is not None]
    if len(known) < len(seeds):
        return None
    return {frames: float(np.sqrt(np.mean([own[frames] ** 2 for own in known]))) for frames in FRAMES}


def average_variance(values: NDArray[np.float64]) -> float:
    """Return the variance over draws of the difference of two rows of `values` (P, n), the mean over all pairs."""
    return float(np.mean([np.var(one - other, ddof=1) for one, other in combinations(values, 2)]))

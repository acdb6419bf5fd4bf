"""Records of the proof of placement: gains by pole, by rule and by seed, and their means over seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flcav.config import Json
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import Outcomes
from flcav.runs.provenance import Provenance
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.streams import stream
from flcav.statistics.verdicts import describe_means
from flcav.storage.records import LEFT_OUT, Record

TOWN, NEAR = "all over the town", "near the errors"  # test frames
FRAMES = (TOWN, NEAR)
RULES = {"vrcsp": "VRCSP", "densest": "traffic density", "random": "random"}  # by the rule in a recipe
COVERAGE, TRAFFIC = "errors covered", "traffic density"  # what may predict a pole's gain,
EXPECTED, ADDED = "expected labels", "labels really added"  # the last only once a sensor stands there
PREDICTORS = (COVERAGE, TRAFFIC, EXPECTED, ADDED)
HALF_WIDTH = 0.02  # of an interval in AP50 that seeds are planned for

ByFrames = Mapping[str, float]  # a number by `TOWN` and `NEAR`


@dataclass(frozen=True)
class Pair:
    """Two candidate poles whose circles of coverage overlap."""

    poles: tuple[int, int]
    apart_m: float
    overlap: float  # share of a circle that lies in the other one


@dataclass(frozen=True)
class PoleGain:
    """Gain in AP of vehicles that learn from the sensor on one pole."""

    pole: int
    predictors: Mapping[str, float]  # by `PREDICTORS`; of traffic the mean number of road users within range
    gain: ByFrames  # in AP50


@dataclass(frozen=True)
class ChoiceGain:
    """Gain in AP of vehicles that learn from the sensors that a rule places."""

    rule: str
    count: int
    poles: tuple[int, ...]  # none: the mean over all single poles
    gain: ByFrames

    @property
    def name(self) -> str:
        """Return "count, rule"."""
        return f"{self.count}, {self.rule}"


@dataclass(frozen=True)
class SeedGains:
    """Gains of one seed in a region, and how well each predictor orders the poles by them."""

    seed: int
    errors: int  # registered
    pretrained: ByFrames  # AP50
    without: ByFrames  # AP50 of edge FL without sensors
    poles: tuple[PoleGain, ...]  # that see road users
    choices: tuple[ChoiceGain, ...]
    correlation: Mapping[str, ByFrames]  # Spearman's, by predictor
    scene_sd: Annotated[ByFrames | None, LEFT_OUT] = None  # of two poles' difference, by the draw of the test scenes


@dataclass(frozen=True)
class Means:
    """Means over seeds of correlations, gains, and VRCSP's advantages, with 95 % intervals."""

    correlation: Mapping[str, Mapping[str, MeanOverSeeds]]  # by predictor and frames
    gain: Mapping[str, Mapping[str, MeanOverSeeds]]  # by "count, rule" and frames
    advantage: Mapping[str, Mapping[str, MeanOverSeeds]]  # of VRCSP over the rule, by "count, rule" and frames

    def sentences(self) -> list[str]:
        """Return correlations and advantages in words."""
        told = [
            f"rank correlation of gain and {predictor}, {frames}: {mean.describe(sign=True)}"
            for predictor, own in self.correlation.items()
            for frames, mean in own.items()
        ]
        return told + [
            f"{name}: VRCSP gains {mean.describe(sign=True)} AP50 more {frames}"
            for name, own in self.advantage.items()
            for frames, mean in own.items()
        ]


@dataclass(frozen=True)
class RegionProof:
    """Gains by pole and by rule in one region, over seeds."""

    town: str
    overlaps: tuple[Pair, ...]  # of all pairs of poles that are nearer than two ranges
    seeds: tuple[SeedGains, ...]
    means: Means
    # Standard deviation of the difference of two poles' gains, over all pairs, between seeds: each has traffic,
    # recordings and trainings of its own, so that it is more than the spread of retraining on the same frames.
    pair_sd: ByFrames
    seeds_wanted: Mapping[str, int | None]  # that make the half-width of such a difference `HALF_WIDTH`
    scene_sd: Annotated[ByFrames | None, LEFT_OUT] = None  # the part of `pair_sd` by the draw of test scenes

    def sentences(self) -> list[str]:
        """Return correlations, advantages and the number of seeds in words."""
        return self.means.sentences() + [
            f"the difference of two poles' gains varies by {self.pair_sd[frames]:.3f} (standard deviation over seeds, "
            f"of other traffic and trainings) {frames}: {wanted} seeds make the half-width {HALF_WIDTH}"
            for frames, wanted in self.seeds_wanted.items()
            if wanted is not None
        ]


@dataclass(frozen=True)
class PlacementProof(Record):
    """Gains by pole and by rule, over seeds, in each region and pooled."""

    range_m: float
    regions: Mapping[str, RegionProof]
    pooled: Means  # over seeds, of the mean over regions; only what all regions have
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return what was found in each region and, of several, over all of them."""
        told = [f"{name}: {sentence}" for name, own in self.regions.items() for sentence in own.sentences()]
        return told + [f"mean over regions: {each}" for each in self.pooled.sentences() if len(self.regions) > 1]


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


def list_claims(results: PlacementProof) -> dict[str, MeanOverSeeds]:
    """Return by claim the mean over seeds that is claimed to be positive."""
    pooled, claims = results.pooled, {}
    seeds = list(zip(*(own.seeds for own in results.regions.values()), strict=True))
    for frames in FRAMES:
        beyond = [float(np.mean([_beyond_traffic(each, frames) for each in seed])) for seed in seeds]
        claims |= {
            f"gain {frames}: rank correlation with errors covered": pooled.correlation[COVERAGE][frames],
            f"gain {frames}: rank correlation with errors covered - with traffic density": mean_over_seeds(beyond),
        }
        for name, mean in pooled.advantage.items():
            count, rule = name.split(", ")
            if rule in RULES.values():
                claims[f"gain {frames}, sensors {count}: VRCSP - {rule}"] = mean[frames]
    return claims


def describe_claims(results: PlacementProof) -> list[str]:
    """Return each claim with its mean and its verdict in words."""
    return describe_means(list_claims(results))


def _beyond_traffic(seed: SeedGains, frames: str) -> float:
    return seed.correlation[COVERAGE][frames] - seed.correlation[TRAFFIC][frames]

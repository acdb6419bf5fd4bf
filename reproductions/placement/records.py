"""Records of the test of placement: gains by pole, by rule and by seed, and their means over seeds."""

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

TOWN, NEAR = "all over the town", "near the errors"  # choices of test frames
FRAMES = (TOWN, NEAR)
RULES = {"vrcsp": "VRCSP", "densest": "traffic density", "random": "random"}  # by the rule in a recipe
# Quantities that may predict a pole's gain. Added labels are known only once a sensor is on the pole.
COVERAGE, TRAFFIC = "errors covered", "traffic density"
EXPECTED, ADDED = "expected labels", "labels really added"
PREDICTORS = (COVERAGE, TRAFFIC, EXPECTED, ADDED)
HALF_WIDTH = 0.02  # of the 95 % interval of a difference in AP50, for which seeds are planned

ByFrames = Mapping[str, float]  # a number by `TOWN` and `NEAR`


@dataclass(frozen=True)
class Pair:
    """Two candidate poles whose circles of coverage overlap."""

    poles: tuple[int, int]
    apart_m: float  # distance of the poles
    overlap: float  # share of a circle's area that lies in the other one


@dataclass(frozen=True)
class PoleGain:
    """Gain in AP50 of vehicles that learn from the sensor on one pole, and its predictors."""

    pole: int
    predictors: Mapping[str, float]  # by `PREDICTORS`; that of traffic is the mean number of road users within range
    gain: ByFrames  # in AP50


@dataclass(frozen=True)
class ChoiceGain:
    """Gain in AP50 of vehicles that learn from the sensors that a rule places."""

    rule: str
    count: int
    poles: tuple[int, ...]  # empty for the mean over all single poles
    gain: ByFrames

    @property
    def name(self) -> str:
        """Return the number of sensors and the rule, as "2, VRCSP"."""
        return f"{self.count}, {self.rule}"


@dataclass(frozen=True)
class SeedGains:
    """Gains in one seed in a region, and the rank correlation of each predictor with the gains of poles."""

    seed: int
    errors: int  # registered
    pretrained: ByFrames  # AP50
    without: ByFrames  # AP50 of edge FL without sensors
    poles: tuple[PoleGain, ...]  # single poles that see road users
    choices: tuple[ChoiceGain, ...]
    correlation: Mapping[str, ByFrames]  # Spearman's, by predictor
    scene_sd: Annotated[ByFrames | None, LEFT_OUT] = None  # see `spread_over_scenes`


@dataclass(frozen=True)
class Means:
    """Means over seeds of correlations, gains, and VRCSP's advantages, with 95 % intervals."""

    correlation: Mapping[str, Mapping[str, MeanOverSeeds]]  # by predictor and frames
    gain: Mapping[str, Mapping[str, MeanOverSeeds]]  # by "count, rule" and frames
    advantage: Mapping[str, Mapping[str, MeanOverSeeds]]  # of VRCSP over the rule, by "count, rule" and frames

    def sentences(self) -> list[str]:
        """Return correlations and advantages as sentences."""
        correlations = [
            f"rank correlation of gain and {predictor}, {frames}: {mean.describe(sign=True)}"
            for predictor, by_frames in self.correlation.items()
            for frames, mean in by_frames.items()
        ]
        return correlations + [
            f"{name}: VRCSP gains {mean.describe(sign=True)} AP50 more {frames}"
            for name, by_frames in self.advantage.items()
            for frames, mean in by_frames.items()
        ]


@dataclass(frozen=True)
class RegionProof:
    """Gains by pole and by rule in one region, over seeds."""

    town: str
    overlaps: tuple[Pair, ...]  # all pairs of poles less than two ranges apart
    seeds: tuple[SeedGains, ...]
    means: Means
    # Standard deviation over seeds of the difference of two poles' gains, over all pairs. Each seed has its own
    # traffic, recordings and trainings, so that it is more than the spread of retraining on the same frames.
    pair_sd: ByFrames
    seeds_wanted: Mapping[str, int | None]  # number for which the interval of such a difference has `HALF_WIDTH`
    scene_sd: Annotated[ByFrames | None, LEFT_OUT] = None  # the part of `pair_sd` by the draw of test scenes

    def sentences(self) -> list[str]:
        """Return correlations, advantages and the number of seeds as sentences."""
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
    pooled: Means  # over seeds of the mean over regions, for the predictors and rules that all regions have
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the sentences of each region and, where there are several, of the mean over them."""
        lines = [f"{name}: {sentence}" for name, region in self.regions.items() for sentence in region.sentences()]
        return lines + [f"mean over regions: {line}" for line in self.pooled.sentences() if len(self.regions) > 1]


DRAWS = 1000  # bootstrap samples of the scenes


def spread_over_seeds(seeds: Sequence[SeedGains], frames: str) -> float:
    """Return the standard deviation over seeds of the difference of two poles' gains, variances averaged over pairs.

    Poles that are missing in some seed are left out. The result is 0 for a single seed or pole.
    """
    gain_of = [{pole.pole: pole.gain[frames] for pole in seed.poles} for seed in seeds]
    common = sorted(set.intersection(*map(set, gain_of)))
    gains = np.array([[by_pole[pole] for pole in common] for by_pole in gain_of])
    return float(np.sqrt(average_variance(gains.T))) if len(seeds) > 1 and len(common) > 1 else 0.0


def spread_over_scenes(
    tested: Sequence[Outcomes], counted: Mapping[str, NDArray[np.bool_]], seed: int
) -> dict[str, float]:
    """Return by choice of frames the standard deviation of the difference of two poles' gains over draws of the scenes.

    tested: outcomes of each pole's arm on the same test frames; counted: (F,) whether a frame belongs to the choice.
    All arms have the same draws (bootstrap), and variances are averaged over pairs of poles. The result is 0 for a
    single pole.
    """
    if len(tested) < 2:
        return dict.fromkeys(counted, 0.0)
    names, scene = np.unique(tested[0].scene, return_inverse=True)
    drawn = stream(seed, "test-scenes").multinomial(len(names), np.full(len(names), 1 / len(names)), size=DRAWS)
    spread = {}
    for frames, is_counted in counted.items():
        reached = np.array([OBJECTS.measure(outcomes, drawn[:, scene] * is_counted) for outcomes in tested])
        known = reached[:, ~np.isnan(reached).any(axis=0)]  # draws with targets
        spread[frames] = float(np.sqrt(average_variance(known)))
    return spread


def pool_over_seeds(seeds: Sequence[SeedGains]) -> dict[str, float] | None:
    """Return the root mean square over seeds of `spread_over_scenes`; None if it is unknown for some seed."""
    known = [seed.scene_sd for seed in seeds if seed.scene_sd is not None]
    if len(known) < len(seeds):
        return None
    return {frames: float(np.sqrt(np.mean([sd[frames] ** 2 for sd in known]))) for frames in FRAMES}


def average_variance(values: NDArray[np.float64]) -> float:
    """Return the variance over draws of the difference of two rows of `values` (P, n), averaged over all pairs."""
    return float(np.mean([np.var(one - other, ddof=1) for one, other in combinations(values, 2)]))


def list_claims(results: PlacementProof) -> dict[str, MeanOverSeeds]:
    """Return the means over seeds that are claimed to be positive, by claim."""
    pooled, claims = results.pooled, {}
    seeds = list(zip(*(region.seeds for region in results.regions.values()), strict=True))
    for frames in FRAMES:
        beyond = [float(np.mean([_beyond_traffic(gains, frames) for gains in regions])) for regions in seeds]
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
    """Return a sentence for each claim, with its mean and its verdict."""
    return describe_means(list_claims(results))


def _beyond_traffic(seed: SeedGains, frames: str) -> float:
    return seed.correlation[COVERAGE][frames] - seed.correlation[TRAFFIC][frames]

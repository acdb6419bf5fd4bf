"""Records of the proof of placement: gains by pole, by rule and by seed, and their means over seeds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from flcav.config import Json
from flcav.runs.provenance import Provenance
from flcav.statistics.seeds import MeanOverSeeds
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

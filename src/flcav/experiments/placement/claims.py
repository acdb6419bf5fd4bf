"""Claims about placement, of means over regions: coverage of errors predicts what vehicles gain, and VRCSP gains more.

Wang et al., IEEE Network 37(3), 2023, finding iii. All are judged together.
"""

import numpy as np

from flcav.experiments.placement.records import COVERAGE, FRAMES, RULES, TRAFFIC, PlacementProof, SeedGains
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import describe_means


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

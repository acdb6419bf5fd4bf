"""Target criteria of an evaluation: range and number of LiDAR returns, stated beside its results."""

import math
from dataclasses import dataclass, replace

from flcav.config import InputError
from flcav.intervals import CONFIDENCE
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.truth import MIN_RETURNS


def narrow_range(config: SecondConfig, text: str) -> SecondConfig:
    """Return `config` with the smaller range `text`: metres ahead, a comma, metres to either side, as in "48,24".

    Networks of different ranges are thus evaluated on the same objects. Raises `InputError` for any other text, and
    where the range exceeds that of the network.
    """
    try:
        ahead, side = map(float, text.split(","))
    except ValueError:
        ahead = side = math.nan
    if not (0 < ahead < math.inf and 0 < side < math.inf):
        raise InputError(f"range '{text}': metres ahead and metres to either side are wanted, as in 48,24")
    x0, y0, z0, x1, y1, z1 = config.range_m
    if x0 > 0 or x1 < ahead or y0 > -side or y1 < side:
        raise InputError(f"range '{text}': the network sees no further than {_extent(config.range_m)}")
    return replace(config, range_m=(0.0, -side, z0, ahead, side, z1))


@dataclass(frozen=True)
class TargetCriteria:
    """Criteria that make an object a target, and the confidence level of intervals."""

    range_m: tuple[float, ...]  # of its centre, LiDAR frame: minima x, y, z, then maxima [m]
    min_returns: int  # LiDAR returns from it
    confidence: float  # in (0, 1)

    def lines(self) -> list[str]:
        """Return the criteria in words: a line on targets, a line on intervals."""
        return [
            f"targets: centre {_extent(self.range_m)}, {self.min_returns} LiDAR returns or more; "
            "others are neutral, and so are trucks and buses beside cars",
            f"intervals: {100 * self.confidence:g} %, over scenes",
        ]


def target_criteria(config: SecondConfig) -> TargetCriteria:
    """Return the target criteria of an evaluation of a network of `config`."""
    return TargetCriteria(tuple(config.range_m), MIN_RETURNS, CONFIDENCE)


def _extent(range_m: tuple[float, ...]) -> str:
    x0, y0, _, x1, y1, _ = range_m
    sides = f"{y1:g} m to either side" if y0 == -y1 else f"{-y0:g} m to the right and {y1:g} m to the left"
    return f"{x0:g} to {x1:g} m ahead and {sides}"

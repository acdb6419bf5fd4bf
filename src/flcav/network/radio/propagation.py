"""Large-scale propagation of V2X links by 3GPP TR 37.885 V15.3.0, clause 6.2: path loss, blockage, shadowing.

A vehicle and a roadside unit of UE type are linked like two vehicles (Table 6.2.1-2). Distances are between the two
antennas, in three dimensions. Losses are in dB.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Environment = Literal["urban", "highway"]

NEAREST_M = 3.0  # nearer links lose what they lose here: TR 36.885, Table A.1.4-1


class PathState(IntEnum):
    """State of the direct path between two antennas (TR 37.885, clause 6.2)."""

    LOS = 0  # free
    NLOSV = 1  # blocked by vehicles alone
    NLOS = 2  # blocked by buildings


@dataclass(frozen=True)
class Law:
    """Path loss of a state, intercept + slope lg(d / m) + frequency lg(f / GHz) [dB], and its log-normal shadowing."""

    intercept_db: float
    slope_db: float
    frequency_db: float
    sigma_db: float  # standard deviation of the shadowing
    correlation_m: float  # distance moved after which the shadowing's correlation is 1/e


# Path loss and sigma: TR 37.885, Table 6.2.1-1; correlation: Table 6.2.3-1 (urban), TR 36.885, Table A.1.4-1 (highway)
LAWS: Mapping[Environment, Mapping[PathState, Law]] = {
    "urban": {
        PathState.LOS: Law(38.77, 16.7, 18.2, 3.0, 10.0),
        PathState.NLOSV: Law(38.77, 16.7, 18.2, 3.0, 13.0),
        PathState.NLOS: Law(36.85, 30.0, 18.9, 4.0, 13.0),
    },
    "highway": {  # has no buildings, and so no NLOS
        PathState.LOS: Law(32.4, 20.0, 20.0, 3.0, 25.0),
        PathState.NLOSV: Law(32.4, 20.0, 20.0, 3.0, 25.0),
    },
}


def path_loss_db(
    distance_m: ArrayLike, state: ArrayLike, frequency_ghz: float, environment: Environment = "urban"
) -> Array:
    """Return the path loss (...) [dB] over distances (...) [m] in states (...), without blockage and shadowing.

    TR 37.885, Table 6.2.1-1. Distances below `NEAREST_M` count as that. Raises ValueError for the state NLOS on a
    highway, which the report does not define.

    >>> path_loss_db([50.0, 100.0], State.NLOS, 5.9).round(1)
    array([102.4, 111.4])
    """
    distance = np.maximum(np.asarray(distance_m, dtype=np.float64), NEAREST_M)
    intercept, slope, frequency = (
        _by_state(state, environment, name) for name in ("intercept_db", "slope_db", "frequency_db")
    )
    return intercept + slope * np.log10(distance) + frequency * np.log10(frequency_ghz)


def shadowing_sigma_db(state: ArrayLike, environment: Environment = "urban") -> Array:
    """Return the standard deviation (...) [dB] of the shadowing in states (...): TR 37.885, Table 6.2.1-1."""
    return _by_state(state, environment, "sigma_db")


def correlation_distance_m(state: ArrayLike, environment: Environment = "urban") -> Array:
    """Return the correlation distance (...) [m] of the shadowing in states (...): TR 37.885, Table 6.2.3-1."""
    return _by_state(state, environment, "correlation_m")


def blockage_moments_db(
    distance_m: ArrayLike, lower_m: ArrayLike, higher_m: ArrayLike, blocker_m: ArrayLike
) -> tuple[Array, Array]:
    """Return mean and standard deviation (...) [dB] of the loss by a vehicle in the direct path of a link.

    `lower_m` and `higher_m` (...) are the heights of the two antennas, `blocker_m` (...) that of the vehicle [m].
    TR 37.885, clause 6.2.1: case 1, both antennas above the vehicle: none; case 2, both below it; case 3, otherwise.
    """
    distance = np.maximum(np.asarray(distance_m, dtype=np.float64), NEAREST_M)
    far = np.maximum(0.0, 15 * np.log10(distance) - 41)
    above, below = np.greater(lower_m, blocker_m), np.less(higher_m, blocker_m)
    mean = np.where(above, 0.0, np.where(below, 9.0, 5.0) + far)
    return mean, np.broadcast_to(np.where(above, 0.0, np.where(below, 4.5, 4.0)), mean.shape)


def blockage_db(
    distance_m: ArrayLike, lower_m: ArrayLike, higher_m: ArrayLike, blocker_m: ArrayLike, draw: ArrayLike
) -> Array:
    """Return the loss (...) [dB] by a vehicle in the direct path, for standard normal draws (...).

    max(0 dB, a log-normal variable): normal in dB, TR 37.885, clause 6.2.1. Heights are as in `blockage_moments_db`.
    """
    mean, sigma = blockage_moments_db(distance_m, lower_m, higher_m, blocker_m)
    return np.maximum(0.0, mean + sigma * np.asarray(draw))


def correlate_along_path(moved_m: Array, correlation_m: Array, draws: Array) -> Array:
    """Return a standard normal process (T, ...) that is correlated along a path, from independent draws (T, ...).

    S(n) = r S(n - 1) + sqrt(1 - r^2) N(n) with r = exp(-D / D_corr): TR 36.885, clause A.1.4, to which TR 37.885,
    clause 6.2.2, refers. `moved_m` (T, ...) is the distance D from the instant before [m], infinite where the path
    begins anew; `correlation_m` (T, ...) is D_corr [m]. Row 0 of `moved_m` is not used.
    """
    process = np.array(draws, dtype=np.float64)
    kept = np.exp(-moved_m / correlation_m)
    for n in range(1, len(process)):
        process[n] = kept[n] * process[n - 1] + np.sqrt(1 - kept[n] ** 2) * draws[n]
    return process


def _by_state(state: ArrayLike, environment: Environment, field: str) -> Array:
    """Return a field of the law of each state (...)."""
    laws = LAWS[environment]
    states = np.asarray(state, dtype=np.int64)
    if unknown := set(np.unique(states).tolist()) - set(laws):
        raise ValueError(f"the {environment} environment has no state {PathState(min(unknown)).name}")
    return np.array([getattr(laws[each], field) if each in laws else np.nan for each in PathState])[states]

"""Link budget of V2X transmissions: path loss, blockage, shadowing, SINR, and the rate by a truncated Shannon bound.

Powers are in dBm, gains and losses in dB. The constants of `Radio` are those of 3GPP's studies of V2X at 5.9 GHz, and
of 3GPP TR 36.942 for the rate of an uplink.

Large-scale propagation of V2X links by 3GPP TR 37.885 V15.3.0, clause 6.2: path loss, blockage, shadowing.

A vehicle and a roadside unit of UE type are linked like two vehicles (Table 6.2.1-2). Distances are between the two
antennas, in three dimensions. Losses are in dB.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from flcav.arrays import Array, Ints, Mask
from flcav.config import Config

Environment = Literal["urban", "highway"]

NEAREST_M = 3.0  # shorter links have the path loss of this distance: TR 36.885, Table A.1.4-1


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

    >>> path_loss_db([50.0, 100.0], PathState.NLOS, 5.9).round(1)
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

    `distance_m` (...) is the length of the path, `lower_m` and `higher_m` (...) are the heights of the two antennas,
    `blocker_m` (...) that of the vehicle [m]. TR 37.885, clause 6.2.1: case 1, both antennas above the vehicle: no
    loss; case 2, both below it; case 3, otherwise.
    """
    distance = np.maximum(np.asarray(distance_m, dtype=np.float64), NEAREST_M)
    far = np.maximum(0.0, 15 * np.log10(distance) - 41)
    above = np.greater(lower_m, blocker_m)
    below = np.less(higher_m, blocker_m)
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
    clause 6.2.2, refers. `moved_m` (T, ...) is the distance D from the previous instant [m], infinite where a new path
    starts; `correlation_m` (T, ...) is D_corr [m]. Row 0 of `moved_m` is not used.
    """
    process = np.array(draws, dtype=np.float64)
    kept = np.exp(-moved_m / correlation_m)
    for n in range(1, len(process)):
        process[n] = kept[n] * process[n - 1] + np.sqrt(1 - kept[n] ** 2) * draws[n]
    return process


def _by_state(state: ArrayLike, environment: Environment, field: str) -> Array:
    """Return a field of the path loss law of each state (...)."""
    laws = LAWS[environment]
    states = np.asarray(state, dtype=np.int64)
    if unknown := set(np.unique(states).tolist()) - set(laws):
        raise ValueError(f"the {environment} environment has no state {PathState(min(unknown)).name}")
    return np.array([getattr(laws[path], field) if path in laws else np.nan for path in PathState])[states]


THERMAL_DBM_HZ = -174.0  # thermal noise at 290 K


class Radio(Config):
    """A V2X radio: carrier, power, receiver, spectral efficiency. Both ends are alike (a roadside unit of UE type)."""

    environment: Environment = "urban"
    frequency_ghz: float = Field(default=5.9, ge=0.5, le=100)
    bandwidth_mhz: float = Field(default=10.0, gt=0, le=1000)  # of each edge server, shared by its vehicles
    power_dbm: float = Field(default=23.0, ge=-50, le=60)  # TR 37.885, clause 6.1.3
    antenna_gain_dbi: float = Field(default=3.0, ge=-50, le=50)  # of each end: TR 36.885, Table A.1.1-1
    noise_figure_db: float = Field(default=9.0, ge=0, le=50)  # TR 36.885, Table A.1.1-1
    attenuation: float = Field(default=0.4, gt=0, le=1)  # alpha, loss of implementation: TR 36.942, Table A.2, uplink
    least_sinr_db: float = Field(default=-10.0, ge=-50, le=50)  # below it nothing arrives: TR 36.942, Table A.2
    most_bps_hz: float = Field(default=2.0, gt=0, le=20)  # 16QAM at rate 3/4: TR 36.942, Table A.2, uplink
    shadowing: bool = True  # whether there is any; without it, and without blockage's spread, losses are medians

    @property
    def bandwidth_hz(self) -> float:
        """Return the bandwidth [Hz]."""
        return self.bandwidth_mhz * 1e6


def noise_dbm(bandwidth_hz: ArrayLike, noise_figure_db: float) -> Array:
    """Return the noise power (...) [dBm] in bandwidths (...) [Hz]: thermal noise at 290 K and the receiver's figure.

    >>> noise_dbm(10e6, 9.0).round(1)
    np.float64(-95.0)
    """
    return THERMAL_DBM_HZ + 10 * np.log10(np.asarray(bandwidth_hz, dtype=np.float64)) + noise_figure_db


def received_dbm(loss_db: ArrayLike, radio: Radio) -> Array:
    """Return the received power (...) [dBm] over links with losses (...) [dB], antenna gains included."""
    return radio.power_dbm + 2 * radio.antenna_gain_dbi - np.asarray(loss_db, dtype=np.float64)


def spectral_efficiency(sinr_db: ArrayLike, radio: Radio) -> Array:
    """Return the spectral efficiency (...) [bit/s/Hz] at SINRs (...) [dB]: TR 36.942, Annex A.1.

    alpha log2(1 + SINR), at most `most_bps_hz`; 0 below `least_sinr_db`.

    >>> spectral_efficiency([-11.0, 0.0, 40.0], Radio())
    array([0. , 0.4, 2. ])
    """
    sinr = np.asarray(sinr_db, dtype=np.float64)
    bound = radio.attenuation * np.log2(1 + 10 ** (np.minimum(sinr, 300.0) / 10))
    return np.where(sinr < radio.least_sinr_db, 0.0, np.minimum(bound, radio.most_bps_hz))


def lone_rate_bps(received: ArrayLike, radio: Radio) -> Array:
    """Return the rates (...) [bit/s] for received powers (...) [dBm] with the whole band and without interference."""
    sinr_db = np.asarray(received, dtype=np.float64) - noise_dbm(radio.bandwidth_hz, radio.noise_figure_db)
    return radio.bandwidth_hz * spectral_efficiency(sinr_db, radio)


def shared_rates_bps(received: Array, server: Ints, active: Mask, radio: Radio) -> Array:
    """Return the rates (V,) [bit/s] of vehicles that transmit simultaneously; 0 where one is not `active` (V,).

    `received` (V, U) is the power of each vehicle at each edge server [dBm], `server` (V,) the column of the vehicle's
    edge server. The n active vehicles of a server have 1/n of the band each, at full power, and are orthogonal. Those
    of the other servers interfere in the same band, with a power that is spread evenly over it on average.
    """
    power = np.where(active[:, None], 10 ** (received / 10), 0.0)  # [mW]
    serving = server[:, None] == np.arange(received.shape[1])
    interference = np.where(serving, 0.0, power).sum(axis=0)  # (U,) in the whole band
    sharing = np.maximum((serving & active[:, None]).sum(axis=0), 1)  # (U,)
    noise = 10 ** (noise_dbm(radio.bandwidth_hz, radio.noise_figure_db) / 10)
    # A vehicle concentrates its power in its share of the band; interference and noise there are that share of all.
    share = 1 / sharing[server]
    signal = power[np.arange(len(server)), server]
    with np.errstate(divide="ignore"):
        sinr_db = 10 * np.log10(signal / (share * (interference + noise)[server]))
    return np.where(active, share * radio.bandwidth_hz * spectral_efficiency(sinr_db, radio), 0.0)

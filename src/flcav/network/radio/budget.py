"""Link budget of V2X transmissions: received power, noise, SINR, and the rate by a truncated Shannon bound.

Powers are in dBm, gains and losses in dB. The constants of `Radio` are those of 3GPP's studies of V2X at 5.9 GHz, and
of 3GPP TR 36.942 for the rate of an uplink.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from flcav.config import Config
from flcav.network.radio.propagation import Environment

Array = NDArray[np.float64]

THERMAL_DBM_HZ = -174.0  # thermal noise at 290 K


class Radio(Config):
    """A V2X radio: carrier, power, receiver, and what it makes of a signal. Both ends are alike (a unit of UE type)."""

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
    """Return the power (...) [dBm] that arrives over links with losses (...) [dB], antennas included."""
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
    """Return the rates (...) [bit/s] of signals (...) [dBm] that have the whole band, without interference."""
    sinr_db = np.asarray(received, dtype=np.float64) - noise_dbm(radio.bandwidth_hz, radio.noise_figure_db)
    return radio.bandwidth_hz * spectral_efficiency(sinr_db, radio)


def shared_rates_bps(
    received: Array, server: NDArray[np.int64], active: NDArray[np.bool_], radio: Radio
) -> NDArray[np.float64]:
    """Return the rates (V,) [bit/s] of vehicles that transmit at once; 0 where one is not `active` (V,).

    `received` (V, U) is the power of each vehicle at each edge server [dBm], `server` (V,) the column of its own. The n
    active vehicles of a server have 1/n of the band each, at full power, and do not disturb each other. Those of the
    other servers use the same band; on average over it their power is spread evenly.
    """
    power = np.where(active[:, None], 10 ** (received / 10), 0.0)  # [mW]
    own = server[:, None] == np.arange(received.shape[1])
    interference = np.where(own, 0.0, power).sum(axis=0)  # (U,) in the whole band
    sharing = np.maximum((own & active[:, None]).sum(axis=0), 1)  # (U,)
    noise = 10 ** (noise_dbm(radio.bandwidth_hz, radio.noise_figure_db) / 10)
    share = 1 / sharing[server]
    signal = power[np.arange(len(server)), server]
    with np.errstate(divide="ignore"):
        sinr_db = 10 * np.log10(signal / (share * (interference + noise)[server]))
    return np.where(active, share * radio.bandwidth_hz * spectral_efficiency(sinr_db, radio), 0.0)

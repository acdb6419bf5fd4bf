"""Noise, SINR and rates against sums over subchannels, written out link by link."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from flcav.config import InputError
from flcav.network.radio import budget
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import Wireline

BOLTZMANN = 1.380649e-23


def test_noise_is_that_of_a_resistor_at_290_kelvin_and_the_receivers_figure():
    watt = BOLTZMANN * 290 * 20e6 * 10**0.9
    assert budget.noise_dbm(20e6, 9.0) == pytest.approx(10 * math.log10(watt * 1000), abs=0.03)


def test_received_power_has_an_antenna_at_each_end():
    assert budget.received_dbm(100.0, Radio(power_dbm=23, antenna_gain_dbi=3)) == pytest.approx(23 + 3 + 3 - 100)


def test_the_rate_of_an_uplink_is_attenuated_and_truncated_shannon():
    """TR 36.942, Annex A: alpha .4, from -10 dB, at most 2 bit/s/Hz, which 10 lg(2^(2/.4) - 1) = 14.91 dB reach."""
    sinr = [-10.01, -10.0, 0.0, 10.0, 14.9, 14.92, 500.0, -math.inf]
    wanted = [0, 0.4 * math.log2(1.1), 0.4, 0.4 * math.log2(11), 0.4 * math.log2(1 + 10**1.49), 2, 2, 0]
    np.testing.assert_allclose(budget.spectral_efficiency(sinr, Radio()), wanted, rtol=1e-12)


def shares(received, server, active, radio):
    """Return the rates by hand: each vehicle's part of the band, and what falls into it from elsewhere."""
    noise_mw_hz = 10 ** ((-174 + radio.noise_figure_db) / 10)
    rates = []
    for vehicle, own in enumerate(server):
        if not active[vehicle]:
            rates.append(0.0)
            continue
        sharing = sum(1 for other in range(len(server)) if active[other] and server[other] == own)
        width = radio.bandwidth_mhz * 1e6 / sharing
        noise = noise_mw_hz * width
        for other in range(len(server)):
            if active[other] and server[other] != own:  # spread over the band: what falls into this width
                noise += 10 ** (received[other][own] / 10) * width / (radio.bandwidth_mhz * 1e6)
        sinr = 10 ** (received[vehicle][own] / 10) / noise
        if sinr < 10 ** (radio.least_sinr_db / 10):
            rates.append(0.0)
        else:
            rates.append(width * min(radio.attenuation * math.log(1 + sinr) / math.log(2), radio.most_bps_hz))
    return rates


def test_vehicles_of_a_server_share_the_band_and_those_of_others_interfere():
    rng = np.random.default_rng(3)
    radio = Radio(most_bps_hz=20)
    for _ in range(30):
        received = rng.uniform(-115, -60, (6, 3))
        server, active = rng.integers(0, 3, 6), rng.random(6) < 0.8
        found = budget.shared_rates_bps(received, server, active, radio)
        np.testing.assert_allclose(found, shares(received, server, active, radio), rtol=1e-9)


def test_alone_a_vehicle_has_the_whole_band():
    received = np.array([[-90.0], [-104.0], [-106.0]])
    for row in received:
        alone = budget.shared_rates_bps(row[None], np.zeros(1, np.int64), np.ones(1, bool), Radio())
        assert budget.lone_rate_bps(row, Radio()).tolist() == pytest.approx(alone.tolist())
    assert budget.lone_rate_bps(received[2], Radio()).tolist() == [0.0]


@pytest.mark.parametrize("field", ["bandwidth_mhz", "frequency_ghz", "attenuation", "most_bps_hz"])
def test_a_radio_without_a_band_or_a_rate_is_refused(field):
    with pytest.raises(ValidationError, match=field):
        Radio.model_validate({field: 0.0})


def test_wireline_takes_its_latency_and_then_eight_bits_a_byte():
    assert Wireline(rate_mbps=50, latency_s=0.1).seconds(12_500_000) == pytest.approx(2.1)
    assert Wireline(latency_s=0.1).seconds(0) == 0.1
    with pytest.raises(ValidationError, match="rate_mbps"):
        Wireline(rate_mbps=0)
    with pytest.raises(InputError, match="a message of -1 bytes"):
        Wireline().seconds(-1)

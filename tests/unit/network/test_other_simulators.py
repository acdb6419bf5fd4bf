"""The constants of the radio are those that other simulators have read from the same reports.

ns-3 has TR 37.885: `ThreeGppV2vUrbanPropagationLossModel` and `...HighwayPropagationLossModel` of
`src/propagation/model/three-gpp-v2v-propagation-loss-model.cc` (nsnam/ns-3-dev-git, 0891fa9). WiLabV2Xsim has
TR 36.885: `MatFilesInit/initiatePhyParameters.m` and `MatFilesSINR/computeChannelGain.m` (V2Xgithub/WiLabV2Xsim,
0eeb610, 1b76966).
SHARC has the uplink of TR 36.942, Annex A, but for its highest rate: `ul_attenuation_factor` and `ul_sinr_min` of its
parameters, and `calculate_imt_tput` (Radio-Spectrum/SHARC).
"""

import math

import numpy as np
import pytest

from flcav.network.radio.budget import LAWS, PathState, Radio, blockage_moments_db, path_loss_db, spectral_efficiency

# ns-3: loss at 1 m and 1 GHz, factors of lg distance and lg frequency, standard deviation of the shadowing [dB]
NS3 = {
    ("urban", PathState.LOS): (38.77, 16.7, 18.2, 3.0),
    ("urban", PathState.NLOSV): (38.77, 16.7, 18.2, 3.0),
    ("urban", PathState.NLOS): (36.85, 30.0, 18.9, 4.0),
    ("highway", PathState.LOS): (32.4, 20.0, 20.0, 3.0),
    ("highway", PathState.NLOSV): (32.4, 20.0, 20.0, 3.0),
}
NS3_CORRELATION_M = {PathState.LOS: 10.0, PathState.NLOSV: 13.0, PathState.NLOS: 13.0}
WILAB = {"power_dbm": 23.0, "antenna_gain_dbi": 3.0, "noise_figure_db": 9.0}  # Ptx_dBm, Gt_dB and Gr_dB, F_dB
WILAB_HIGHWAY_CORRELATION_M, WILAB_URBAN_CORRELATION_M = 25.0, 10.0  # D_corr
SHARC_ATTENUATION, SHARC_LEAST_DB = 0.4, -10.0


@pytest.mark.parametrize(("environment", "state"), NS3)
def test_losses_and_shadowing_are_those_of_ns_3(environment, state):
    intercept, slope, frequency, sigma = NS3[environment, state]
    for metres in (3.0, 40.0, 700.0):
        wanted = intercept + slope * math.log10(metres) + frequency * math.log10(5.9)
        assert path_loss_db(metres, state, 5.9, environment) == pytest.approx(wanted, abs=1e-9)
    assert LAWS[environment][state].sigma_db == sigma
    if environment == "urban":
        assert LAWS[environment][state].correlation_m == NS3_CORRELATION_M[state]


def test_blockage_is_that_of_ns_3():
    """Its blockers are 1.6 m and 3 m high."""
    for metres in (10.0, 541.0, 900.0):
        far = max(0.0, 15 * math.log10(metres) - 41.0)
        for lower, higher, blocker, wanted in (
            (2.0, 5.0, 1.6, (0.0, 0.0)),
            (1.6, 2.0, 3.0, (9.0 + far, 4.5)),
            (1.6, 5.0, 3.0, (5.0 + far, 4.0)),
        ):
            found = blockage_moments_db(metres, lower, higher, blocker)
            np.testing.assert_allclose([each.item() for each in found], wanted, atol=1e-9)


def test_the_link_budget_and_a_highway_s_correlation_are_those_of_wilab():
    radio = Radio()
    assert {name: getattr(radio, name) for name in WILAB} == WILAB
    assert {law.correlation_m for law in LAWS["highway"].values()} == {WILAB_HIGHWAY_CORRELATION_M}
    assert LAWS["urban"][PathState.LOS].correlation_m == WILAB_URBAN_CORRELATION_M


def test_the_rate_is_that_of_sharc_up_to_the_highest():
    radio = Radio()
    sinr_db = np.array([SHARC_LEAST_DB - 0.01, SHARC_LEAST_DB, 0.0, 14.9])
    wanted = SHARC_ATTENUATION * np.log2(1 + 10 ** (0.1 * sinr_db))
    wanted[sinr_db < SHARC_LEAST_DB] = 0
    np.testing.assert_allclose(spectral_efficiency(sinr_db, radio), wanted, rtol=1e-12)

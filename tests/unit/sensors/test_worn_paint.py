"""Wear of road markings: none by default, and at its largest half of the paint is gone."""

import numpy as np

from flcav.sensors.rendering.ground import build_markings, wear
from flcav.sensors.rendering.noise import make_noise
from flcav.world.map.layers import MapLayers

PERIOD_M = 256 / 0.6  # of the noise
NOTHING = MapLayers((), (), (), (), (), ())


def left(worn: float) -> np.ndarray:
    """Return the share of the paint that is left at many places."""
    table = make_noise()
    places = np.random.default_rng(0).uniform(0, PERIOD_M, (2000, 2))
    return np.array([wear(x, y, np.float32(worn), table) for x, y in places])


def test_fresh_paint_is_whole_and_worn_paint_is_half_gone():
    assert build_markings(NOTHING).worn == 0
    assert build_markings(NOTHING, 0.4).worn == np.float32(0.4)
    assert (left(0.0) == 1).all()
    worn = left(1.0)
    assert 0.45 < (worn == 0).mean() < 0.55
    assert worn.max() <= 0.65 + 1e-6
    assert np.allclose(left(0.5), 1 - 0.5 * (1 - worn), atol=1e-6)

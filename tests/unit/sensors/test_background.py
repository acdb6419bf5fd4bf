import numpy as np

from flcav.geometry import unit_vectors
from flcav.sensors.lidar.background import MARGIN_M, learn_background

AZIMUTH, ELEVATION = np.meshgrid(np.radians(np.arange(0, 360, 2.0)), np.radians((-30.0, -20.0, -10.0)))
RAYS = unit_vectors(AZIMUTH.ravel(), ELEVATION.ravel())
FLOOR_M = 6.0 / np.sin(-ELEVATION.ravel())  # ranges to the ground from 6 m up


def sweep(ranges: np.ndarray) -> np.ndarray:
    return np.column_stack((RAYS * ranges[:, None], np.ones(len(RAYS)))).astype(np.float32)


def test_what_is_nearer_than_the_farthest_return_is_in_front() -> None:
    rng = np.random.default_rng(0)
    passing = [np.where(rng.random(len(RAYS)) < 0.3, FLOOR_M * 0.8, FLOOR_M) for _ in range(12)]
    noise = [rng.normal(0, 0.02, len(RAYS)) for _ in range(13)]
    background = learn_background(sweep(ranges + off) for ranges, off in zip(passing, noise))
    car = np.arange(len(RAYS)) % 7 == 0
    now = sweep(np.where(car, FLOOR_M * 0.8, FLOOR_M) + noise[-1])
    np.testing.assert_array_equal(background.in_front(now), car)


def test_what_always_stands_there_is_background() -> None:
    parked = np.where(np.arange(len(RAYS)) % 5 == 0, FLOOR_M * 0.7, FLOOR_M)
    assert not learn_background([sweep(parked)] * 3).in_front(sweep(parked)).any()


def test_returns_where_there_was_none_are_in_front() -> None:
    seen = np.arange(len(RAYS)) % 2 == 0
    background = learn_background([sweep(FLOOR_M)[seen]])
    np.testing.assert_array_equal(background.in_front(sweep(FLOOR_M)), ~seen)
    assert learn_background([]).in_front(sweep(FLOOR_M)).all()


def test_the_margin_is_in_metres() -> None:
    background = learn_background([sweep(FLOOR_M)])
    assert not background.in_front(sweep(FLOOR_M - MARGIN_M + 0.01)).any()
    assert background.in_front(sweep(FLOOR_M - MARGIN_M - 0.01)).all()

import numpy as np
import pytest

from flcav.fusion.registration import measure_offset, register_clouds
from flcav.geometry import inverse, pose, transform_points

pytest.importorskip("small_gicp")


def street(rng: np.random.Generator) -> np.ndarray:
    """Ground, two facades at right angles, and trunks, world frame."""
    ground = np.column_stack((rng.uniform(-20, 20, (3000, 2)), np.zeros(3000)))
    one = np.column_stack((rng.uniform(-20, 20, 1500), np.full(1500, 12.0), rng.uniform(0, 6, 1500)))
    other = np.column_stack((np.full(1500, -14.0), rng.uniform(-20, 20, 1500), rng.uniform(0, 6, 1500)))
    return np.vstack((ground, one, other))


def test_a_miscalibrated_suite_is_registered_to_the_other() -> None:
    rng = np.random.default_rng(0)
    first, second = pose(5, -5, 6, 0.4), pose(-4, 3, 6, -1.0)
    clouds = [transform_points(inverse(at), street(rng)) + rng.normal(0, 0.01, (6000, 3)) for at in (first, second)]
    exact = inverse(first) @ second
    guess = exact @ pose(0.5, -0.4, 0.1, 0.04, 0.01)
    found = register_clouds(clouds[0], clouds[1], guess)
    before, after = measure_offset(exact, guess), measure_offset(exact, found)
    assert before.position_cm > 60
    assert after.position_cm < 3
    assert after.rotation_deg < 0.1


def test_offsets_are_distance_and_angle() -> None:
    off = measure_offset(pose(1, 2, 3, 0.1), pose(1, 2, 3.05, 0.1 + np.radians(3)))
    assert off.position_cm == pytest.approx(5)
    assert off.rotation_deg == pytest.approx(3)

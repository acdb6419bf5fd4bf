"""Which returns a LiDAR detects and where it puts them, against the formulas ray by ray."""

import numpy as np
import pytest

from flcav.sensors.lidar.returns import QUANTILES, detect_returns

LEVELS = len(QUANTILES)
LEAST = 1e-4  # P_min


def detected(
    distance: list[float],
    brightness: list[float],
    chance: float = 0.0,
    keep: float = 1.0,
    noise: int = LEVELS // 2,
    noise_m: float = 0.0,
    noise_share: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    rays = len(distance)
    angle = np.linspace(0, 1, rays)
    directions = np.column_stack((np.cos(angle), np.sin(angle), np.zeros(rays))).astype(np.float32)
    points, actor = np.full((rays, 4), np.nan, np.float32), np.full(rays, -9, np.int32)
    far, bright = np.array(distance, np.float32), np.array(brightness, np.float32)
    count = detect_returns(
        directions,
        far,
        bright,
        np.arange(rays, dtype=np.int32),
        np.float32(1 / LEAST),
        np.float32(keep),
        np.full(rays, chance, np.float32),
        np.full(rays, noise, np.uint16),
        np.float32(noise_m),
        np.float32(noise_share),
        points,
        actor,
    )
    return points[:count], actor[:count]


def test_range_errors_add_in_quadrature_and_grow_with_the_distance() -> None:
    for level in (3, LEVELS // 2, LEVELS - 5):
        for noise_m, share in ((0.02, 0.0), (0.03, 0.004), (0.0, 0.01)):
            points, _ = detected([10.0, 40.0], [1.0, 1.0], noise=level, noise_m=noise_m, noise_share=share)
            wanted = [far + np.hypot(noise_m, share * far) * QUANTILES[level] for far in (10.0, 40.0)]
            assert np.linalg.norm(points[:, :3], axis=1) == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("keep", [1.0, 0.8])
@pytest.mark.parametrize(
    ("power", "share"), [(0.69, 0.0), (0.85, 0.25), (1.0, 0.5), (1.29, 0.983), (1.4, 1.0), (9.0, 1.0)]
)
def test_the_chance_of_a_return_rises_from_seven_to_thirteen_tenths_of_the_least_power(
    power: float, share: float, keep: float
) -> None:
    bright = power * LEAST * 50.0**2
    for off, wanted in ((-0.01, 1), (0.01, 0)):
        chance = keep * share + off
        if chance >= 0:
            assert len(detected([50.0], [bright], chance=chance, keep=keep)[0]) == wanted


def test_points_know_their_ray_s_actor_and_brightness_and_dark_rays_are_none() -> None:
    points, actor = detected([5.0, 6.0, 7.0, 8.0], [0.5, 0.0, 3.0, -1.0])
    assert actor.tolist() == [0, 2]
    assert points[:, 3].tolist() == [0.5, 1.0]
    assert np.linalg.norm(points[:, :3], axis=1) == pytest.approx([5.0, 7.0], abs=0.01)
    assert np.arctan2(points[:, 1], points[:, 0]) == pytest.approx([0, 2 / 3], abs=1e-6)

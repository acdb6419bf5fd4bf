"""In clear weather, with the default settings, a sweep has the bytes it always had."""

from hashlib import sha256
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from flcav.geometry import pose
from flcav.sensors.lidar.lidar import Lidar, scan
from flcav.world.materials import PAINT_REFLECTIVITY, REFLECTIVITY, Material
from flcav.world.rays.packets import Hits
from flcav.world.scene import Scene, Surfaces

FLOOR, WALL, PANE, DOOR, SIGN = range(5)  # planes: the floor z = 0, and x = their distance
DISTANCE = np.array([0.0, 25.0, 6.0, 6.5, 9.0], np.float32)
MATERIAL = np.array([Material.ROAD, Material.WALL, Material.GLASS, Material.PAINT, Material.SIGN], np.uint8)
EYE_M = 1.8


class Planes:
    """A world of planes, met by exact arithmetic: town (instance 0) and one actor (1) behind a pane of glass."""

    def __init__(self) -> None:
        reflectivity = np.tile(REFLECTIVITY, (2, 1))
        reflectivity[1, Material.PAINT] = PAINT_REFLECTIVITY[4]
        normal = np.array([[0, 0, 1], [1, 0, 0], [1, 0, 0], [0.6, 0.8, 0], [1, 0, 0]], np.float32)
        self.surfaces = Surfaces(normal, MATERIAL, np.array([0, 2], np.int64), reflectivity)

    def world_from_instance(self) -> NDArray[np.float64]:
        return np.stack((np.eye(3), [[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]))

    def cast(
        self,
        world_from_rays: NDArray[np.float64],
        directions: NDArray[np.float32],
        *,
        near_m: NDArray[np.float32] | None = None,
        far_m: float = np.inf,
        hidden: int | None = None,
    ) -> Hits:
        near = np.zeros(len(directions), np.float32) if near_m is None else near_m
        best = Hits(*(np.full(len(directions), fill, kind) for fill, kind in ((np.inf, "f4"), (-1, "i4"), (-1, "i4"))))
        with np.errstate(divide="ignore", invalid="ignore"):
            for plane, x in enumerate(DISTANCE):
                along = -np.float32(EYE_M) / directions[:, 2] if plane == FLOOR else x / directions[:, 0]
                aside, height = along * directions[:, 1], EYE_M + along * directions[:, 2]
                met = (along > near) & (along <= far_m) & (along < best.distance)
                if plane in (PANE, DOOR, SIGN):
                    met &= (np.abs(aside) < 2.0) & (height > 0) & (height < 2.5)
                best.distance[met] = along[met]
                best.instance[met] = plane >= PANE
                best.face[met] = plane - 2 * (plane >= PANE)
        return best


def digest(settings: Lidar, seed: int, **options: Any) -> str:
    scene = cast(Scene, Planes())
    points, actor, *_ = scan(scene, pose(0.0, 0.0, EYE_M), settings, np.random.default_rng(seed), **options)
    assert (actor == 0).sum() > 100
    return sha256(points.tobytes() + actor.tobytes()).hexdigest()[:16]


@pytest.mark.parametrize(
    ("settings", "seed", "expected"),
    [
        (Lidar(), 0, "1bf6da2590123983"),
        (
            Lidar(channels=64, azimuth_steps=1024, range_m=100.0, up_deg=2.0, down_deg=-45.0, sensitivity_m=400.0),
            1,
            "881c4127a93e1d20",
        ),
        (
            Lidar(channels=4, azimuth_steps=2000, elevations_deg=(1.0, -2.0, -4.0, -9.0), noise_m=0.05),
            2,
            "566d08ac7f0957b3",
        ),
    ],
)
def test_clear_weather_keeps_its_bytes(settings: Lidar, seed: int, expected: str):
    assert digest(settings, seed) == expected

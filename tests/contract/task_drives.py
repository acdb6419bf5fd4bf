"""Drives that every task can learn from: a car among LiDAR points, painted squares for signs, skies for the weather.

The car also drives for longer than it is watched, for those who ask where it goes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from flcav.geometry import Boxes, pose, transform_points
from flcav.sensors.frame import Annotations, Calibration, CameraImage, Frame, SignViews
from flcav.world.trace import Trace
from flcav.world.weather import WEATHERS

WIDTH, HEIGHT = 96, 64
COLOURS = {"stop": (220, 20, 30), "yield": (240, 220, 30), "speed_30": (30, 60, 220)}
SKIES = {"clear": (60, 120, 240), "fog": (200, 200, 200), "night": (8, 8, 20)}
LIDAR_HEIGHT_M = 1.8
SPEED = 20.0  # of the car [m/s]


@dataclass(frozen=True)
class Drives:
    """A source of one scene per sky; without a sensor where it is told so."""

    spins: int = 4
    lidar: bool = True
    camera: bool = True
    traffic: bool = True

    def describe(self) -> dict[str, Any]:
        return {"town": "suburb", "split": "train", "seed": 0, "spins": self.spins}

    def scenes(self) -> list[str]:
        return list(SKIES)

    def frame_count(self, scene: str) -> int:
        return self.spins

    def frames(self, scene: str):
        return (self.frame(scene, index) for index in range(self.spins))

    def trace(self, scene: str) -> Trace | None:
        if not self.traffic:
            return None
        time_s = np.arange(-25, 36) / 10
        count = len(time_s)
        position = np.stack((12 + SPEED * time_s, np.full(count, 3.0), np.zeros(count)), axis=1)
        return Trace(
            town="suburb",
            time_s=time_s,
            actor=np.array(["veh0"]),
            category=np.array(["car"]),
            shape=np.zeros(1, np.int64),
            size=np.array([(4.4, 1.8, 1.6)]),
            present=np.ones((count, 1), np.bool_),
            position=position[:, None],
            yaw=np.zeros((count, 1)),
            velocity=np.broadcast_to(np.array((SPEED, 0.0, 0.0)), (count, 1, 3)),
            acceleration=np.zeros((count, 1, 3)),
            yaw_rate=np.zeros((count, 1)),
            light=np.zeros(0, np.str_),
            light_state=np.zeros((count, 0), "<U1"),
        )

    def frame(self, scene: str, index: int) -> Frame:
        """Return spin `index` of the scene that is named after its sky."""
        image, signs = _picture(scene, index)
        car = Boxes.from_array([[12 + 2 * index, 3, 0.8, 4.4, 1.8, 1.6, 0.0]], "car")
        mounts = {"top": pose(0, 0, LIDAR_HEIGHT_M)} if self.lidar else {}
        cameras = {"front": np.eye(4)} if self.camera else {}
        calibration = Calibration(
            {**mounts, **cameras},
            intrinsics={name: np.array([[50.0, 0, 47.5], [0, 50.0, 31.5], [0, 0, 1]]) for name in cameras},
            distortion={name: np.zeros(5) for name in cameras},
            offset_ms=dict.fromkeys(cameras, 0.0),
        )
        annotations = Annotations(
            track=np.array(["veh0"]),
            boxes=car,
            velocity=np.zeros((1, 3)),
            acceleration=np.zeros((1, 3)),
            returns=np.array([60 if self.lidar else 0]),
            occlusion=np.zeros(1),
            signs={"front": signs} if self.camera else {},
        )
        return Frame(
            scene,
            index,
            0.1 * index,
            "cav0",
            np.eye(4),
            calibration,
            calibration,
            {"top": _cloud(car)} if self.lidar else {},
            annotations,
            images={"front": image} if self.camera else {},
            weather=WEATHERS[scene],
        )


def _cloud(car: Boxes) -> np.ndarray:
    random = np.random.default_rng(0)
    on_it = transform_points(pose(*car.center[0]), random.uniform(-0.5, 0.5, (60, 3)) * car.size[0])
    around = random.uniform((4, -20, 0), (40, 20, 0.1), (400, 3))
    points = np.concatenate((on_it, around)) - (0, 0, LIDAR_HEIGHT_M)
    return np.pad(points, ((0, 0), (0, 1))).astype(np.float32)


def _picture(scene: str, index: int) -> tuple[CameraImage, SignViews]:
    kinds = list(COLOURS)
    signs = [
        (kinds[index % 3], 6 + 5 * index, 8 + 3 * index, 14),
        (kinds[(index + 1) % 3], 60 - 4 * index, 40 - 2 * index, 18),
    ]
    rgb = np.full((HEIGHT, WIDTH, 3), SKIES[scene], np.uint8)
    rgb[HEIGHT // 2 :] //= 2
    for kind, left, top, side in signs:
        rgb[top : top + side, left : left + side] = COLOURS[kind]
    shape = (HEIGHT, WIDTH)
    image = CameraImage(rgb, np.full(shape, 10, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.uint16))
    views = SignViews(
        kind=np.array([kind for kind, *_ in signs]),
        state=np.array(["", ""]),
        box=np.array([(x, y, x + side, y + side) for _, x, y, side in signs]) - 0.5,  # centres at whole numbers
        pixels=np.array([side * side for *_, side in signs]),
        distance_m=np.full(2, 10.0),
        thing=np.arange(2),
    )
    return image, views

"""A source whose frames can be checked by eye: every actor's box is painted in a colour of its own and full of points.

The pictures are made by projecting the boxes' corners and filling their hulls from far to near, so that they share no
code with the camera of the simulator; the 2D truth is counted from the pictures.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from shapely.geometry import MultiPoint

from flcav.geometry import Boxes, pose
from flcav.sensors.frame import Annotations, Calibration, CameraImage, Frame, SignViews, Views
from flcav.statistics.streams import stream
from flcav.world.weather import Weather

WIDTH, HEIGHT, FOCAL = 320, 160, 200.0
INTRINSICS = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # body_from_optical
# Notes of an import as KITTI, since no ground is painted:
BARE = ("no ground near the LiDAR in most of 4 sweeps, so it is taken to be 1.73 m above it",)
MOUNTS = {
    "lidar": pose(0.1, -0.05, 1.8, 0.02),
    "front": pose(0.6, 0.1, 1.5) @ OPTICAL,
    "back": pose(-0.6, 0.0, 1.5, np.pi) @ OPTICAL,
    "thermal": pose(0.6, 0.1, 1.5) @ OPTICAL,
    "radar": pose(2.0, 0.0, 0.5),
    "gnss": pose(0.0, 0.0, 1.9),
    "imu": pose(-0.3, 0.0, 0.4),
}
ASSUMED_LIDAR = MOUNTS["lidar"] @ pose(0.1, 0.0)
CATEGORIES = ["car", "van", "truck", "bus", "motorcycle", "bicycle", "pedestrian", "car", "car"]
LOCAL = np.array(  # x, y, z, length, width, height, yaw against the agent, whose ground is z = 0
    [
        [12.0, 3.5, 0.75, 4.2, 1.8, 1.5, 0.2],
        [22, -4, 1.0, 4.8, 2.0, 2.0, 3.0],
        [35, 4, 1.6, 8.0, 2.5, 3.2, -0.1],
        [-25, 5, 1.6, 11.0, 2.5, 3.2, 1.2],
        [9, -3, 0.8, 2.1, 0.8, 1.6, -2.0],
        [-9, 2, 0.9, 1.8, 0.6, 1.8, 0.5],
        [10, -1, 0.9, 0.6, 0.6, 1.8, 1.0],
        [17, 5, 0.75, 4.0, 1.8, 1.5, 0.1],  # behind the first
        [3, 40, 0.75, 4.1, 1.8, 1.5, 0.0],  # in no image, without returns
    ]
)
IN_BOX = np.array([60, 50, 0, 30, 20, 10, 15, 5, 0])  # points of the LiDAR; the truck ahead shows and has none
RETURNS = IN_BOX + 3 * (IN_BOX > 0)  # as recorded: of the actor itself, mirrors and all
ECHOES = {0: 2, 5: 1}  # row -> echoes of the radar that lie in its box
SLOPE = {"z": 7.0, "pitch": -0.08, "roll": 0.05}  # of the agents, where they are tilted
TILT = np.stack((np.linspace(-0.1, 0.1, len(LOCAL)), np.linspace(0.06, -0.03, len(LOCAL))), axis=1)
WEATHER = Weather(rain_mm_h=3.0)
SIGNS = (("stop", "", 5), ("speed_60", "", 9), ("signal", "red", 6), ("signal", "green", 4), ("signal", "off", 7))


def colour(row: int) -> tuple[int, int, int]:
    """Return the paint of the actor in this row of the annotations."""
    return 20 * row + 40, 255 - 20 * row, 90


@dataclass(frozen=True)
class PaintedSource:
    """One car, and a pole that has a LiDAR only, among standing actors; three scenes."""

    scene_count: int = 3
    spins: int = 2
    split: str = "train"
    cut: int = 0  # frames that are missing at the end of every scene
    deserted: bool = False  # nobody is there
    cameras: bool = True
    lidar: bool = True
    town: str = "painted"
    tilted: tuple[int, ...] = ()  # scenes where the agents stand on a slope, and each actor on one of its own

    def describe(self) -> dict[str, Any]:
        return {"town": self.town, "seed": 0, "split": self.split}

    def scenes(self) -> list[str]:
        return [f"painted-0-{scene:03d}" for scene in range(self.scene_count)]

    def frame_count(self, scene: str) -> int:
        return 2 * self.spins - self.cut

    def frames(self, scene: str) -> Iterator[Frame]:
        for number in range(self.frame_count(scene)):
            index, agent = divmod(number, 2)
            yield self.frame(scene, index, ("cav0", "pole3")[agent])

    def trace(self, scene: str) -> None:
        return None

    def frame(self, scene: str, index: int, agent: str) -> Frame:
        rng = stream(0, scene, index, agent)
        x, y = rng.uniform(-50, 50, 2)
        tilted = int(scene.rpartition("-")[2]) in self.tilted
        slope = SLOPE if tilted else {}
        world_from_agent = pose(float(x), float(y), yaw=float(rng.uniform(-3, 3)), **slope)
        local = Boxes.from_array(LOCAL, CATEGORIES)
        local = replace(local, tilt=TILT) if tilted else local
        boxes = local.transform(world_from_agent)[: 0 if self.deserted else None]
        cameras = ["front", "back"] if self.cameras and agent == "cav0" else []
        optical = [*cameras, *(["thermal"] if cameras else [])]
        then = world_from_agent @ pose(0.4, 0.03, yaw=0.02)
        pictures = {name: _picture(boxes, then @ MOUNTS[name]) for name in cameras}
        lidar = _points(boxes, world_from_agent @ MOUNTS["lidar"], rng)
        radar = _echoes(boxes, world_from_agent @ MOUNTS["radar"], rng)
        returns = RETURNS[: len(boxes)]
        names = ["lidar", *optical, "radar", "gnss", "imu"] if agent == "cav0" else ["lidar"]
        mounts = {name: MOUNTS[name] for name in names}
        calibration = Calibration(
            mounts,
            intrinsics=dict.fromkeys(optical, INTRINSICS),
            distortion=dict.fromkeys(optical, np.zeros(5)),
            offset_ms=dict.fromkeys(optical, 40.0),
        )
        believed = replace(calibration, agent_from_sensor=mounts | {"lidar": ASSUMED_LIDAR})
        return Frame(
            scene=scene,
            index=index,
            time_s=10 + 0.5 * index,
            agent=agent,
            world_from_agent=world_from_agent,
            calibration=calibration,
            assumed=believed,
            lidar={"lidar": lidar} if self.lidar else {},
            annotations=Annotations(
                track=np.array([f"veh{i}" for i in range(len(boxes))]),
                boxes=boxes,
                velocity=np.tile([1.5, -0.5, 0.0], (len(boxes), 1)),
                acceleration=np.zeros((len(boxes), 3)),
                returns=returns * self.lidar,
                occlusion=np.linspace(0, 1, len(boxes)),
                points={"lidar": returns} | ({"radar": np.arange(len(boxes))} if agent == "cav0" else {}),
                views={name: pictures[name if name in pictures else "front"].views for name in optical},
                signs={name: _signs() for name in cameras},
            ),
            images={name: picture.image for name, picture in pictures.items()},
            infrared={
                name: 28_000 + np.asarray(pictures["front"].image.instance) for name in optical if name not in pictures
            },
            radar={"radar": radar} if agent == "cav0" else {},
            gnss={"gnss": np.array([49.001, 8.402, 113.5])} if agent == "cav0" else {},
            weather=WEATHER,
            agent_at_trigger=dict.fromkeys(optical, then),
            imu={"imu": np.array([0.1, -0.2, 9.81, 0.01, 0.02, -0.03])} if agent == "cav0" else {},
        )


RADAR_RANGES = ((5, 60), (-0.8, 0.8), (-0.1, 0.1), (-10, 10), (-5, 20))


@dataclass(frozen=True)
class _Painted:
    image: CameraImage
    views: Views


def _picture(boxes: Boxes, world_from_camera: NDArray[np.float64]) -> _Painted:
    camera_from_world = np.linalg.inv(world_from_camera)
    corners = boxes.corners() @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    distance = np.linalg.norm(corners.mean(axis=1), axis=1)
    ahead: NDArray[np.bool_] = np.min(corners[..., 2], axis=1) > 0.1
    pixels = corners @ INTRINSICS.T
    pixels = pixels[..., :2] / np.where(ahead[:, None], pixels[..., 2], np.nan)[..., None]
    amodal = np.concatenate((pixels.min(axis=1), pixels.max(axis=1)), axis=1)
    image, instance = Image.new("RGB", (WIDTH, HEIGHT), (10, 10, 10)), Image.new("I", (WIDTH, HEIGHT))
    alone = np.zeros(len(boxes))
    for i in np.argsort(-distance):
        if ahead[i]:
            hull = np.asarray(MultiPoint(pixels[i]).convex_hull.exterior.coords)  # pyright: ignore[reportAttributeAccessIssue]
            outline = [tuple(corner) for corner in hull.tolist()]
            ImageDraw.Draw(image).polygon(outline, fill=colour(i))
            ImageDraw.Draw(instance).polygon(outline, fill=int(i) + 1)
            only = Image.new("I", (WIDTH, HEIGHT))
            ImageDraw.Draw(only).polygon(outline, fill=1)
            alone[i] = np.asarray(only).sum()
    shown = np.array(instance, np.uint16)
    counts = np.bincount(shown.ravel(), minlength=len(boxes) + 1)[1:]
    visible = np.full((len(boxes), 4), np.nan)
    for i in np.flatnonzero(counts):
        rows, columns = np.nonzero(np.equal(shown, i + 1))
        visible[i] = columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5
    low, high = np.maximum(amodal[:, :2], -0.5), np.minimum(amodal[:, 2:], (WIDTH - 0.5, HEIGHT - 0.5))
    wide, tall = np.maximum(high - low, 0).T
    whole = amodal[:, 2:] - amodal[:, :2]
    share = wide * tall / (whole[:, 0] * whole[:, 1])
    views = Views(
        amodal_box=amodal,
        visible_box=visible,
        pixels=counts,
        truncation=np.nan_to_num(1 - share, nan=1.0),
        occlusion=1 - counts / np.maximum(np.maximum(alone, counts), 1),
    )
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    return _Painted(CameraImage(np.asarray(image), depth, np.zeros((HEIGHT, WIDTH), np.uint8), shown), views)


def _points(boxes: Boxes, world_from_lidar: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return points within every box, and on the ground where no box is."""
    inside = []
    for i, count in enumerate(IN_BOX[: len(boxes)]):
        spread = rng.uniform(-0.45, 0.45, (count, 3)) * boxes.size[i]
        turned = spread @ boxes.rotations()[i].T
        inside.append(turned + boxes.center[i])
    angle = rng.uniform(0, 2 * np.pi, 200)
    ground = world_from_lidar @ np.stack((60 * np.cos(angle), 60 * np.sin(angle), 0 * angle - 1.8, 0 * angle + 1))
    world = np.concatenate((*inside, ground[:3].T))
    lidar_from_world = np.linalg.inv(world_from_lidar)
    xyz = world @ lidar_from_world[:3, :3].T + lidar_from_world[:3, 3]
    return np.column_stack((xyz, rng.uniform(0, 1, len(xyz)))).astype(np.float32)


def _echoes(boxes: Boxes, world_from_radar: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return echoes from anywhere, after those from the middle of the boxes that `ACTOR_RCS` names."""
    echoes = np.column_stack([rng.uniform(low, high, 4) for low, high in RADAR_RANGES])
    middle = boxes.center[[row for row, count in ECHOES.items() for _ in range(count) if row < len(boxes)]]
    x, y, z = ((middle - world_from_radar[:3, 3]) @ world_from_radar[:3, :3]).T
    polar = np.stack((np.sqrt(x**2 + y**2 + z**2), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), 0 * x, 0 * x + 3))
    return np.concatenate((polar.T, echoes)).astype(np.float32)


def _signs() -> SignViews:
    count = len(SIGNS)
    left = 20.0 * np.arange(count) - 0.5
    size = np.array([pixels for *_, pixels in SIGNS], np.float64)
    return SignViews(
        kind=np.array([kind for kind, *_ in SIGNS]),
        state=np.array([state for _, state, _ in SIGNS]),
        box=np.stack((left, np.full(count, 9.5), left + size, np.full(count, 10.5)), axis=1),
        pixels=size.astype(np.int64),
        distance_m=np.linspace(10, 50, count),
        thing=np.arange(count),
    )

"""Frames: the sensor data and ground truth of one agent at one instant.

`Frame` is the record that sources of data produce, and that datasets, exporters and tasks consume.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array, Array32, Bytes, Ints, Words
from flcav.geometry import Boxes
from flcav.interface.notebook import Displayed
from flcav.world.weather import Weather

UNKNOWN_PIXELS = -1  # in `Views.pixels`
LONGEST_NAME = 100  # characters of a frame's key, which is part of file names

# Numbers and names of CARLA's semantic tags (0.9.15)
SEMANTICS: dict[str, int] = {
    "unlabeled": 0,
    "road": 1,
    "sidewalk": 2,
    "building": 3,
    "pole": 6,
    "traffic_light": 7,
    "traffic_sign": 8,
    "vegetation": 9,
    "terrain": 10,
    "sky": 11,
    "pedestrian": 12,
    "rider": 13,
    "car": 14,
    "truck": 15,
    "bus": 16,
    "motorcycle": 18,
    "bicycle": 19,
    "static": 20,
    "road_line": 24,
}


def format_key(scene: str, index: int, agent: str) -> str:
    """Return the key of the frame of a scene, spin and agent: see `Frame.key`."""
    return f"{scene}_{index:04d}_{agent}"


@dataclass(frozen=True)
class Calibration:
    """Extrinsics, intrinsics, distortion and trigger times of an agent's sensors, by sensor name.

    Frames of colour and thermal cameras are optical: x right, y down, z forward. Those of other sensors have x forward,
    y left, z up.
    """

    agent_from_sensor: Mapping[str, Array]  # (4, 4) extrinsics [m]
    intrinsics: Mapping[str, Array] = field(default_factory=dict)  # (3, 3) camera matrix [px]
    distortion: Mapping[str, Array] = field(default_factory=dict)  # (5,) k1 k2 p1 p2 k3 as in OpenCV
    offset_ms: Mapping[str, float] = field(default_factory=dict)  # trigger time after the LiDAR spin; 0 where absent


@dataclass(frozen=True)
class CameraImage:
    """A colour image, with ground truth of depth, semantics and instances of its (H, W) pixels; None: unknown."""

    rgb: Bytes  # (H, W, 3) sRGB
    depth_m: Array32 | None = None  # (H, W) z in the optical frame [m]; inf for the sky
    semantic: Bytes | None = None  # (H, W) class: one of SEMANTICS
    instance: NDArray[np.uint16] | None = None
    # (H, W) 1 + row of the frame's annotations, 0 where there is no annotated actor


@dataclass(frozen=True)
class Views:
    """Image annotations of the M annotated actors in one camera [px]; the centre of the first pixel is (0, 0)."""

    amodal_box: Array  # (M, 4) x1 y1 x2 y2 of the whole actor, not clipped to the image; NaN where it is outside
    visible_box: Array  # (M, 4) around its visible pixels, to their outer edges; NaN where there are none
    pixels: Ints  # (M,) number of visible pixels; UNKNOWN_PIXELS where an imported dataset does not have it
    truncation: Array  # (M,) share of the amodal box that is outside the image, 0 to 1
    occlusion: Array
    # (M,) 1 - visible pixels / pixels in a world without other objects; 1 where none is visible, NaN where unknown

    @property
    def shown_box(self) -> Array:
        """Return (M, 4) the visible boxes [px]; for actors with UNKNOWN_PIXELS the amodal ones."""
        return np.where((self.pixels == UNKNOWN_PIXELS)[:, None], self.amodal_box, self.visible_box)


@dataclass(frozen=True)
class SignViews:
    """Image annotations of K traffic signs and signal heads whose front is visible in one camera.

    Pixels as in `Views`.
    """

    kind: Words  # (K,) class: see `flcav.world.static.SignsAndSignals`
    state: Words  # (K,) of a signal: "red", "red_amber", "amber", "green", "off"; of a sign ""
    box: Array  # (K, 4) x1 y1 x2 y2 around its visible pixels, to their outer edges [px]
    pixels: Ints  # (K,) number of visible pixels
    distance_m: Array  # (K,) distance from the camera [m]
    thing: Ints  # (K,) index into the town's signs and signal heads, the same in all scenes

    def __len__(self) -> int:
        return len(self.kind)

    @classmethod
    def none(cls) -> "SignViews":
        """Return the record of a camera without visible signs."""
        none, number = np.zeros(0, np.str_), np.zeros(0, np.int64)
        return cls(none, none, np.zeros((0, 4)), number, np.zeros(0), number)


@dataclass(frozen=True)
class Annotations:
    """Ground truth of one frame: all actors, except the agent itself, that are within range or visible in a camera.

    The range is that of the LiDARs; an actor within it is annotated even if it is occluded. Imported datasets have what
    their format labels; velocity, acceleration and occlusion are NaN where it does not.
    """

    track: Words  # (M,) track ids, the same in all frames of a scene
    boxes: Boxes  # (M,) world frame, at the LiDAR spin; label = actor category (car, van, truck, ...)
    velocity: Array  # (M, 3) world frame [m/s]
    acceleration: Array  # (M, 3) world frame [m/s^2]
    returns: Ints  # (M,) LiDAR returns from the actor in this frame, all LiDARs together
    occlusion: Array  # (M,) for the LiDARs: 1 - visible rays / unoccluded rays; 1 where none is visible
    points: Mapping[str, Ints] = field(default_factory=dict)  # LiDAR or radar -> (M,) its points on the actor
    views: Mapping[str, Views] = field(default_factory=dict)  # colour or thermal camera -> actors in it
    signs: Mapping[str, SignViews] = field(default_factory=dict)  # camera -> signs and signal heads in it

    def __len__(self) -> int:
        return len(self.track)


@dataclass(frozen=True)
class Frame(Displayed):
    """The sensor data, poses, calibration and ground truth of one agent at one LiDAR spin.

    >>> from flcav import Dataset, Frame
    >>> frame: Frame = Dataset.open("data").frame(0)
    >>> frame.agent, frame.lidar["lidar"].shape[1], frame.images["front"].rgb.shape
    ('cav0', 4, (96, 160, 3))
    >>> len(frame.annotations.boxes) == len(frame.annotations.returns)  # ground truth: a box per actor, world frame
    True
    """

    scene: str  # name of the scene, a traffic run; frames of different scenes share no traffic
    index: int  # number of the spin within the scene, common to all agents of the scene
    time_s: float  # simulation time of the spin [s]
    agent: str  # such as "cav0" (a vehicle) or "pole3"
    world_from_agent: Array  # (4, 4) pose at the spin [m]
    calibration: Calibration  # the true calibration
    assumed: Calibration  # the calibration that the agent assumes
    lidar: Mapping[str, Array32]  # LiDAR name -> (N, 4) x, y, z [m], intensity [0, 1]; sensor frame
    annotations: Annotations
    point_times: Mapping[str, Array32] = field(default_factory=dict)
    # LiDAR with a rolling spin -> (N,) times of the points [s] after `time_s`; a point is in the sensor frame at its
    # time: see `flcav.sensors.lidar.rolling`. Points of an imported dataset are motion-compensated, in the sensor frame
    # at `time_s`
    images: Mapping[str, CameraImage] = field(default_factory=dict)
    infrared: Mapping[str, NDArray[np.uint16]] = field(default_factory=dict)  # (H, W) apparent temperature [0.01 K]
    radar: Mapping[str, Array32] = field(default_factory=dict)
    # (N, 5) range [m], azimuth, elevation [rad], Doppler [m/s, + receding], radar cross-section [dBsm]
    gnss: Mapping[str, Array] = field(default_factory=dict)  # (3,) latitude, longitude [degrees], altitude [m]
    imu: Mapping[str, Array] = field(default_factory=dict)  # (6,) specific force [m/s^2], angular rate [rad/s]
    weather: Weather | None = None
    agent_at_trigger: Mapping[str, Array] = field(default_factory=dict)
    # sensor -> (4, 4) world_from_agent at its trigger time [m]; only for vehicles' sensors that trigger off the spin

    def __repr__(self) -> str:
        sensors = [*self.lidar, *self.images, *self.infrared, *self.radar, *self.gnss, *self.imu]
        return f"{type(self).__name__}({self.key!r}, {', '.join(sensors)}, {len(self.annotations.boxes)} boxes)"

    @property
    def key(self) -> str:
        """Return `scene_index_agent`: unique in a dataset, safe as a file name."""
        return format_key(self.scene, self.index, self.agent)

    @property
    def agent_from_sensor(self) -> Mapping[str, Array]:
        """Return the true (4, 4) extrinsics of the sensors, by name."""
        return self.calibration.agent_from_sensor

    def world_from_sensor(self, name: str) -> Array:
        """Return the true (4, 4) pose of sensor `name` at its trigger time, world frame; the ground truth refers to it.

        Raises `KeyError` for an unknown sensor.
        """
        return self.agent_at_trigger.get(name, self.world_from_agent) @ self.calibration.agent_from_sensor[name]

    def assumed_world_from_sensor(self, name: str) -> Array:
        """Return the (4, 4) pose of sensor `name` by the assumed extrinsics, at the true trigger time, world frame.

        Raises `KeyError` for an unknown sensor.
        """
        return self.agent_at_trigger.get(name, self.world_from_agent) @ self.assumed.agent_from_sensor[name]


@dataclass(frozen=True)
class LinkedFrame(Frame):
    """A frame with measurements that are already files in a dataset's encoding: a recording links to them."""

    files: Mapping[str, Path] = field(default_factory=dict)  # LiDAR or camera -> file of its points or image

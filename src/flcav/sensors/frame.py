"""The typed contract between whatever observes and whatever records or learns."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.world.weather import Weather

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Calibration:
    """Where an agent's sensors are, how its cameras project and when they look, by sensor name.

    A camera's frame (an infrared one's too) is optical: x right, y down, z forward; other sensors have x forward,
    y left, z up.
    """

    agent_from_sensor: Mapping[str, Array]  # (4, 4)
    intrinsics: Mapping[str, Array] = field(default_factory=dict)  # (3, 3), of each camera [px]
    distortion: Mapping[str, Array] = field(default_factory=dict)  # (5,) k1 k2 p1 p2 k3 of each camera, as OpenCV's
    offset_ms: Mapping[str, float] = field(default_factory=dict)  # trigger after the LiDAR spin; 0 where not named


@dataclass(frozen=True)
class CameraImage:
    """What a camera sees, and the truth about each of its (H, W) pixels."""

    rgb: NDArray[np.uint8]  # (H, W, 3) sRGB
    depth_m: NDArray[np.float32]  # (H, W) along the optical axis; inf where there is sky
    semantic: NDArray[np.uint8]  # (H, W) class: see `flcav.sensors.camera.camera`
    instance: NDArray[np.uint16]  # (H, W) 1 + row of the frame's annotations, 0 where there is no annotated actor


@dataclass(frozen=True)
class Views:
    """How the M annotated actors appear to one camera; pixels, with the centre of the first one at (0, 0)."""

    amodal_box: Array  # (M, 4) x1 y1 x2 y2 of the whole actor, not clipped to the image; NaN where it does not touch it
    visible_box: Array  # (M, 4) of its visible pixels, their outer edges; NaN where there are none
    pixels: NDArray[np.int64]  # (M,) visible ones
    truncation: Array  # (M,) share of the amodal box outside the image; 1 where that is all
    occlusion: Array  # (M,) 1 - visible pixels / those an empty world would show; 1 where none is visible


@dataclass(frozen=True)
class SignViews:
    """The signs and signal heads whose readable sides show in one camera; pixels as in `Views`."""

    kind: NDArray[np.str_]  # (K,) class: see `flcav.world.static.Things`
    state: NDArray[np.str_]  # (K,) of a signal: "red", "red_amber", "amber", "green", "off"; of a sign ""
    box: Array  # (K, 4) x1 y1 x2 y2 of its visible pixels, their outer edges
    pixels: NDArray[np.int64]  # (K,)
    distance_m: Array  # (K,) from the camera
    thing: NDArray[np.int64]  # (K,) its number in the town, stable over scenes

    def __len__(self) -> int:
        return len(self.kind)


@dataclass(frozen=True)
class Annotations:
    """Ground truth of one frame: every actor within the sensors' range but the agent itself, hit or not."""

    track: NDArray[np.str_]  # (M,) track ids, stable over a scene
    boxes: Boxes  # (M,) world frame, at the LiDAR spin; label = actor category (car, van, truck, ...)
    velocity: Array  # (M, 3) world [m/s]
    acceleration: Array  # (M, 3) world [m/s^2]
    returns: NDArray[np.int64]  # (M,) returns of all LiDARs from the actor in this frame's sweep
    occlusion: Array  # (M,) to the LiDARs: 1 - visible / unoccluded rays; 1 where nothing of it is visible
    points: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)  # LiDAR or radar -> (M,) points on the actor
    views: Mapping[str, Views] = field(default_factory=dict)  # camera, infrared ones too -> how the actors appear
    signs: Mapping[str, SignViews] = field(default_factory=dict)  # camera -> signs and lights in it

    def __len__(self) -> int:
        return len(self.track)


@dataclass(frozen=True)
class Frame:
    """Everything one agent observes at one LiDAR spin.

    >>> from flcav import Dataset, Frame
    >>> frame: Frame = Dataset.open("data").frame(0)
    >>> frame.agent, frame.lidar["lidar"].shape[1], frame.images["front"].rgb.shape
    ('cav0', 4, (96, 160, 3))
    >>> len(frame.annotations.boxes) == len(frame.annotations.returns)  # ground truth: a box per actor, world frame
    True
    """

    scene: str  # one scene is one traffic run; frames of different scenes share no traffic
    index: int  # spin number within the scene; agents of one scene share it
    time_s: float  # simulation time of the spin
    agent: str  # "cav0", "pole3"
    world_from_agent: Array  # (4, 4) at the spin
    calibration: Calibration  # as it is
    assumed: Calibration  # as the agent believes it to be
    lidar: Mapping[str, NDArray[np.float32]]  # LiDAR name -> (N, 4) x, y, z [m], intensity [0, 1]; sensor frame
    annotations: Annotations
    point_times: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    # LiDAR whose spin takes time -> (N,) when each of its points was measured [s] after `time_s`, each in the sensor's
    # frame of its own time: see `flcav.sensors.lidar.rolling`
    images: Mapping[str, CameraImage] = field(default_factory=dict)
    infrared: Mapping[str, NDArray[np.uint16]] = field(default_factory=dict)  # (H, W) apparent temperature [0.01 K]
    radar: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    # (N, 5) range [m], azimuth, elevation [rad], Doppler [m/s, + receding], radar cross-section [dBsm]
    gnss: Mapping[str, Array] = field(default_factory=dict)  # (3,) latitude, longitude [degrees], altitude [m]
    imu: Mapping[str, Array] = field(default_factory=dict)  # (6,) specific force [m/s^2], angular rate [rad/s]
    weather: Weather | None = None
    agent_at_trigger: Mapping[str, Array] = field(default_factory=dict)
    # sensor -> (4, 4) world_from_agent when it looks; only sensors of vehicles that do not look at the spin

    @property
    def key(self) -> str:
        """Return the name of this frame, unique in a dataset and safe in a file name."""
        return f"{self.scene}_{self.index:04d}_{self.agent}"

    @property
    def agent_from_sensor(self) -> Mapping[str, Array]:
        """Return the (4, 4) mounts of the sensors, as they are."""
        return self.calibration.agent_from_sensor

    def world_from_sensor(self, name: str) -> Array:
        """Return the (4, 4) transform of sensor `name`, as it is when it looks, to the world: labels go by it."""
        return self.agent_at_trigger.get(name, self.world_from_agent) @ self.calibration.agent_from_sensor[name]

    def assumed_world_from_sensor(self, name: str) -> Array:
        """Return the (4, 4) transform of sensor `name` to the world as the agent believes it to be."""
        return self.agent_at_trigger.get(name, self.world_from_agent) @ self.assumed.agent_from_sensor[name]

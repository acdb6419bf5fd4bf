"""Everything that a frame holds, as Foxglove's messages; as JSON where Foxglove has no schema.

An agent's topics and frames are below its name: its sensors' frames are children of its own, and that of `world` (ENU,
z up). Transforms are given at the spin, and for every sensor that looks at another time, at that.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from flcav.dataset.formats.mcap.labels import image_annotations, pose_message, scene_update
from flcav.dataset.payloads import encode_png
from flcav.sensors.frame import Frame
from flcav.sensors.radar import echo_directions

LIDAR_FIELDS = ("x", "y", "z", "intensity")
TIME_FIELD = "time"  # of a point [s] after the cloud's time stamp, as ROS drivers of spinning LiDARs have it
RADAR_FIELDS = ("x", "y", "z", "range_m", "azimuth_rad", "elevation_rad", "doppler_m_s", "rcs_dbsm")
IMU_FIELDS = ("linear_acceleration", "angular_velocity")  # specific force [m/s^2], [rad/s], body frame


class Json(NamedTuple):
    """A message that Foxglove has no schema for."""

    kind: str
    values: dict[str, Any]


class Logged(NamedTuple):
    """A message, its topic below the agent's, and when it was measured."""

    topic: str
    message: Message | Json
    time_s: float


def messages(frame: Frame) -> Iterator[Logged]:
    """Yield all that a frame holds."""
    true, spin_s = frame.calibration, frame.time_s

    def looks_s(sensor: str) -> float:
        return spin_s + true.offset_ms.get(sensor, 0.0) / 1000

    def place(sensor: str) -> dict[str, Any]:
        return {"timestamp": _stamp(looks_s(sensor)), "frame_id": f"{frame.agent}/{sensor}"}

    mounts = [(frame.agent, f"{frame.agent}/{name}", mount) for name, mount in true.agent_from_sensor.items()]
    yield Logged("tf", _transforms([("world", frame.agent, frame.world_from_agent), *mounts], spin_s), spin_s)
    for name, world_from_agent in frame.agent_at_trigger.items():
        moved = _transforms([("world", frame.agent, world_from_agent)], looks_s(name))
        yield Logged("tf", moved, looks_s(name))
    for name, points in frame.lidar.items():
        cloud, fields = points, LIDAR_FIELDS
        if name in frame.point_times:
            cloud, fields = np.column_stack((points, frame.point_times[name])), (*LIDAR_FIELDS, TIME_FIELD)
        yield Logged(f"{name}/points", _cloud(cloud, fields, **place(name)), looks_s(name))
    for name, picture in frame.images.items():
        image = CompressedImage(**place(name), data=encode_png(picture.rgb), format="png")
        yield Logged(f"{name}/calibration", _calibration(frame, name, picture.rgb, **place(name)), looks_s(name))
        yield Logged(f"{name}/image", image, looks_s(name))
        yield Logged(f"{name}/labels", image_annotations(frame, name, _stamp(looks_s(name))), looks_s(name))
    for name, picture in frame.infrared.items():
        yield Logged(f"{name}/calibration", _calibration(frame, name, picture, **place(name)), looks_s(name))
        yield Logged(f"{name}/image", _thermal(picture, **place(name)), looks_s(name))
        yield Logged(f"{name}/labels", image_annotations(frame, name, _stamp(looks_s(name))), looks_s(name))
    for name, echoes in frame.radar.items():
        yield Logged(f"{name}/points", _cloud(radar_points(echoes), RADAR_FIELDS, **place(name)), looks_s(name))
    for name, (latitude, longitude, altitude) in frame.gnss.items():
        fix = LocationFix(**place(name), latitude=latitude, longitude=longitude, altitude=altitude)
        yield Logged(f"{name}/fix", fix, looks_s(name))
    for name, reading in frame.imu.items():
        halves = (dict(zip("xyz", half.tolist())) for half in np.split(np.asarray(reading, np.float64), 2))
        imu = Json("Imu", {"frame_id": f"{frame.agent}/{name}", **dict(zip(IMU_FIELDS, halves))})
        yield Logged(f"{name}/imu", imu, looks_s(name))
    if frame.weather is not None:
        yield Logged("weather", Json("Weather", frame.weather.model_dump(mode="json")), spin_s)
    yield Logged("objects", scene_update(frame, _stamp(spin_s)), spin_s)


def radar_points(echoes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (N, 8): x, y, z [m] in the radar's frame before range, azimuth, elevation, Doppler and RCS."""
    return np.concatenate((echoes[:, :1] * echo_directions(echoes), echoes), axis=1).astype(np.float32)


def _cloud(points: NDArray[np.float32], names: tuple[str, ...], **place: Any) -> PointCloud:
    number = PackedElementField.FLOAT32
    fields = [PackedElementField(name=name, offset=4 * i, type=number) for i, name in enumerate(names)]
    data = np.ascontiguousarray(points, dtype="<f4").tobytes()
    return PointCloud(**place, pose=pose_message(np.eye(4)), point_stride=4 * len(names), fields=fields, data=data)


def _calibration(frame: Frame, camera: str, picture: NDArray, **place: Any) -> CameraCalibration:
    intrinsics = frame.calibration.intrinsics[camera]
    return CameraCalibration(
        **place,
        width=picture.shape[1],
        height=picture.shape[0],
        distortion_model="plumb_bob",
        D=frame.calibration.distortion.get(camera, np.zeros(5)).tolist(),
        K=intrinsics.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack((intrinsics, np.zeros(3))).ravel().tolist(),
    )


def _thermal(picture: NDArray[np.uint16], **place: Any) -> RawImage:
    height, width = picture.shape
    data = np.ascontiguousarray(picture, dtype="<u2").tobytes()
    return RawImage(**place, width=width, height=height, encoding="mono16", step=2 * width, data=data)


def _transforms(tree: list[tuple[str, str, NDArray[np.float64]]], time_s: float) -> FrameTransforms:
    """Return parent, child and (4, 4) parent_from_child as one message."""
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=_stamp(time_s),
                parent_frame_id=parent,
                child_frame_id=child,
                translation=pose_message(matrix).position,
                rotation=pose_message(matrix).orientation,
            )
            for parent, child, matrix in tree
        ]
    )


def _stamp(time_s: float) -> Timestamp:
    return Timestamp(seconds=round(time_s * 1e9) // 10**9, nanos=round(time_s * 1e9) % 10**9)

"""A dataset as MCAP files with Foxglove's schemas, one for each scene: opens in Foxglove and whatever reads MCAP.

Everything of an agent is below the topic `/<agent>`, its sensors' frames are children of its own, and that of `world`
(ENU, z up). Times are those of the simulation.
"""

import json
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from numpy.typing import NDArray

from flcav.dataset.formats.colours import COLOURS, OTHER
from flcav.dataset.formats.exporter import ExportOptions, read_frame
from flcav.dataset.formats.mounts import quaternion
from flcav.dataset.payloads import encode_png
from flcav.dataset.store import Dataset
from flcav.geometry import pose
from flcav.progress import Report
from flcav.sensors.frame import Frame

LIDAR_FIELDS = ("x", "y", "z", "intensity")
RADAR_FIELDS = ("x", "y", "z", "range_m", "azimuth_rad", "elevation_rad", "doppler_m_s", "rcs_dbsm")
IMU_FIELDS = ("linear_acceleration", "angular_velocity")  # specific force [m/s^2], [rad/s], body frame


def export_mcap(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Counter[str]:
    """Write `<scene>.mcap` for each scene of `dataset`: see `Exporter`."""
    counts: Counter[str] = Counter(files=0, messages=0, objects=0)
    done = 0
    for scene in dict.fromkeys(key.scene for key in dataset.keys):
        with (out / f"{scene}.mcap").open("wb") as file:
            log = _Log(Writer(file))
            for i in dataset.select(scenes=[scene]):
                frame = read_frame(dataset, i, options)
                for topic, message, offset_ms in messages(frame):
                    log.write(f"/{frame.agent}/{topic}", message, frame.time_s + offset_ms / 1000)
                    counts["messages"] += 1
                counts["objects"] += len(frame.annotations)
                done += 1
                progress(done, len(dataset), "")
            log.writer.finish()
        counts["files"] += 1
    return counts


class _Log:
    """An MCAP file under way: a channel for each topic, opened by its first message."""

    def __init__(self, writer: Writer) -> None:
        writer.start(profile="", library="flcav")
        self.writer = writer
        self._schema = cache(lambda kind: register_schema(writer, kind))
        self._imu = cache(self._imu_schema)
        self._channel = cache(self._open)

    def write(self, topic: str, message: Message | dict[str, Any], time_s: float) -> None:
        stamp = round(time_s * 1e9)
        if isinstance(message, dict):
            channel, data = self._channel(topic, None), json.dumps(message, allow_nan=False).encode()
        else:
            channel, data = self._channel(topic, type(message)), message.SerializeToString(deterministic=True)
        self.writer.add_message(channel, log_time=stamp, publish_time=stamp, data=data)

    def _open(self, topic: str, kind: type[Message] | None) -> int:
        if kind is None:
            return self.writer.register_channel(topic, "json", self._imu())
        return self.writer.register_channel(topic, "protobuf", self._schema(kind))

    def _imu_schema(self) -> int:
        vector = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}}
        schema = {"type": "object", "properties": {"frame_id": {"type": "string"}} | dict.fromkeys(IMU_FIELDS, vector)}
        return self.writer.register_schema("flcav.Imu", "jsonschema", json.dumps(schema).encode())


def messages(frame: Frame) -> Iterator[tuple[str, Message | dict[str, Any], float]]:
    """Yield topic below the agent's, message and trigger time against the spin's [ms] of all that a frame holds."""
    true = frame.calibration
    stamp = {name: _stamp(frame.time_s + offset / 1000) for name, offset in true.offset_ms.items()}
    spin = _stamp(frame.time_s)

    def place(sensor: str) -> dict[str, Any]:
        return {"timestamp": stamp.get(sensor, spin), "frame_id": f"{frame.agent}/{sensor}"}

    def of(sensor: str) -> float:
        return float(true.offset_ms.get(sensor, 0.0))

    mounts = [(frame.agent, f"{frame.agent}/{name}", mount) for name, mount in true.agent_from_sensor.items()]
    yield "tf", _transforms([("world", frame.agent, frame.world_from_agent), *mounts], spin), 0.0
    for name, world_from_agent in frame.agent_at_trigger.items():
        yield "tf", _transforms([("world", frame.agent, world_from_agent)], stamp[name]), of(name)
    for name, points in frame.lidar.items():
        yield f"{name}/points", _cloud(points, LIDAR_FIELDS, **place(name)), of(name)
    for name, picture in frame.images.items():
        height, width = picture.rgb.shape[:2]
        intrinsics = true.intrinsics[name]
        calibration = CameraCalibration(
            **place(name),
            width=width,
            height=height,
            distortion_model="plumb_bob",
            D=true.distortion[name].tolist(),
            K=intrinsics.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.column_stack((intrinsics, np.zeros(3))).ravel().tolist(),
        )
        yield f"{name}/calibration", calibration, of(name)
        yield f"{name}/image", CompressedImage(**place(name), data=encode_png(picture.rgb), format="png"), of(name)
    for name, echoes in frame.radar.items():
        yield f"{name}/points", _cloud(radar_points(echoes), RADAR_FIELDS, **place(name)), of(name)
    for name, (latitude, longitude, altitude) in frame.gnss.items():
        fix = LocationFix(**place(name), latitude=latitude, longitude=longitude, altitude=altitude)
        yield f"{name}/fix", fix, of(name)
    for name, reading in frame.imu.items():
        halves = (dict(zip("xyz", half.tolist())) for half in np.split(np.asarray(reading, np.float64), 2))
        yield f"{name}/imu", {"frame_id": f"{frame.agent}/{name}", **dict(zip(IMU_FIELDS, halves))}, of(name)
    yield "objects", _scene_update(frame, spin), 0.0


def radar_points(echoes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (N, 8): x, y, z [m] in the radar's frame before range, azimuth, elevation, Doppler and RCS."""
    distance, azimuth, elevation = echoes[:, :3].T
    level = distance * np.cos(elevation)
    xyz = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)), axis=1)
    return np.concatenate((xyz, echoes), axis=1).astype(np.float32)


def _cloud(points: NDArray[np.float32], names: tuple[str, ...], **place: Any) -> PointCloud:
    fields = [
        PackedElementField(name=name, offset=4 * i, type=PackedElementField.FLOAT32) for i, name in enumerate(names)
    ]
    data = np.ascontiguousarray(points, dtype="<f4").tobytes()
    return PointCloud(**place, pose=_pose(np.eye(4)), point_stride=4 * len(names), fields=fields, data=data)


def _transforms(tree: list[tuple[str, str, NDArray[np.float64]]], stamp: Timestamp) -> FrameTransforms:
    """Return parent, child and (4, 4) parent_from_child as one message."""
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=stamp,
                parent_frame_id=parent,
                child_frame_id=child,
                translation=_pose(matrix).position,
                rotation=_pose(matrix).orientation,
            )
            for parent, child, matrix in tree
        ]
    )


def _scene_update(frame: Frame, stamp: Timestamp) -> SceneUpdate:
    truth = frame.annotations
    boxes = truth.boxes
    entities = []
    for i, label in enumerate(boxes.label.tolist()):
        red, green, blue = COLOURS.get(label, OTHER)
        cube = CubePrimitive(
            pose=_pose(pose(*boxes.center[i], yaw=boxes.yaw[i])),
            size=Vector3(**dict(zip("xyz", boxes.size[i].tolist()))),
            color=Color(r=red, g=green, b=blue, a=0.4 if truth.returns[i] else 0.15),
        )
        about = {
            "class": label,
            "velocity_m_s": " ".join(f"{value:.3f}" for value in truth.velocity[i]),
            "returns": str(truth.returns[i]),
            "occlusion": f"{truth.occlusion[i]:.3f}",
        }
        entities.append(
            SceneEntity(
                timestamp=stamp,
                frame_id="world",
                id=str(truth.track[i]),
                metadata=[KeyValuePair(key=key, value=value) for key, value in about.items()],
                cubes=[cube],
            )
        )
    before = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.ALL)
    return SceneUpdate(deletions=[before], entities=entities)


def _pose(matrix: NDArray[np.float64]) -> Pose:
    w, x, y, z = quaternion(matrix)
    px, py, pz = matrix[:3, 3].tolist()
    return Pose(position=Vector3(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _stamp(time_s: float) -> Timestamp:
    return Timestamp(seconds=round(time_s * 1e9) // 10**9, nanos=round(time_s * 1e9) % 10**9)

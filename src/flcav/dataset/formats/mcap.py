"""Export to MCAP: one file per scene, with Foxglove's messages and time stamps of the simulation."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypedDict

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from numpy.typing import NDArray

from flcav.config import Json
from flcav.dataset.formats.writing import (
    COLOURS,
    OTHER,
    SIGN,
    Exported,
    ExportFormat,
    ExportOptions,
    quaternion,
    read_frame,
)
from flcav.dataset.payloads import encode_png
from flcav.dataset.store import Dataset
from flcav.geometry import Array
from flcav.interface.progress import Report
from flcav.sensors.frame import Frame
from flcav.sensors.radar import compute_echo_directions

LIDAR_FIELDS = ("x", "y", "z", "intensity")
TIME_FIELD = "time"  # of a point [s] after the cloud's time stamp, as in ROS drivers of spinning LiDARs
RADAR_FIELDS = ("x", "y", "z", "range_m", "azimuth_rad", "elevation_rad", "doppler_m_s", "rcs_dbsm")
IMU_FIELDS = ("linear_acceleration", "angular_velocity")  # specific force [m/s^2], [rad/s], body frame


def scene_update(frame: Frame, stamp: Timestamp) -> SceneUpdate:
    """Return the 3D boxes of a frame, world frame, which replace earlier ones; boxes without returns are fainter."""
    truth = frame.annotations
    boxes = frame.annotations.boxes
    entities = []
    for i, label in enumerate(boxes.label.tolist()):
        cube = CubePrimitive(
            pose=pose_message(boxes.pose(i)),
            size=Vector3(**dict(zip("xyz", boxes.size[i].tolist()))),
            color=_colour(COLOURS.get(label, OTHER), 0.4 if truth.returns[i] else 0.15),
        )
        about = {
            "class": label,
            "velocity_m_s": " ".join(f"{value:.3f}" for value in truth.velocity[i]),
            "acceleration_m_s2": " ".join(f"{value:.3f}" for value in truth.acceleration[i]),
            "returns": str(truth.returns[i]),
            "occlusion": f"{truth.occlusion[i]:.3f}",
        }
        track = str(truth.track[i])
        entities.append(
            SceneEntity(timestamp=stamp, frame_id="world", id=track, metadata=_metadata(about), cubes=[cube])
        )
    before = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletion.ALL)
    return SceneUpdate(deletions=[before], entities=entities)


def image_annotations(frame: Frame, camera: str, stamp: Timestamp) -> ImageAnnotations:
    """Return the visible 2D boxes of actors, signs and signals in an image, in pixels from its upper left corner."""
    truth = frame.annotations
    rectangles = []
    if camera in truth.views:
        views = truth.views[camera]
        for i in np.flatnonzero(views.pixels):
            label = str(truth.boxes.label[i])
            about = {
                "class": label,
                "track": str(truth.track[i]),
                "pixels": str(views.pixels[i]),
                "truncation": f"{views.truncation[i]:.3f}",
                "occlusion": f"{views.occlusion[i]:.3f}",
            }
            rectangles.append(_rectangle(views.shown_box[i], COLOURS.get(label, OTHER), about, stamp))
    if camera in truth.signs:
        signs = truth.signs[camera]
        for kind, state, box, distance_m in zip(signs.kind, signs.state, signs.box, signs.distance_m):
            about = {"class": str(kind), "state": str(state), "distance_m": f"{distance_m:.2f}"}
            rectangles.append(_rectangle(box, SIGN, about, stamp))
    return ImageAnnotations(timestamp=stamp, points=rectangles)


def pose_message(matrix: Array) -> Pose:
    """Return a rigid transform (4, 4) [m] as a pose message: position and unit quaternion."""
    w, x, y, z = quaternion(matrix)
    px, py, pz = matrix[:3, 3].tolist()
    return Pose(position=Vector3(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _rectangle(
    box: Array, colour: tuple[float, float, float], about: dict[str, str], stamp: Timestamp
) -> PointsAnnotation:
    left, top, right, bottom = (
        box + 0.5
    ).tolist()  # a frame's pixel coordinates are 0 at the centre of the first pixel
    corners = ((left, top), (right, top), (right, bottom), (left, bottom))
    return PointsAnnotation(
        timestamp=stamp,
        type=PointsAnnotation.LINE_LOOP,
        points=[Point2(x=x, y=y) for x, y in corners],
        outline_color=_colour(colour, 1.0),
        thickness=2.0,
        metadata=_metadata(about),
    )


def _colour(rgb: tuple[float, float, float], opacity: float) -> Color:
    red, green, blue = rgb
    return Color(r=red, g=green, b=blue, a=opacity)


def _metadata(about: dict[str, str]) -> list[KeyValuePair]:
    return [KeyValuePair(key=key, value=value) for key, value in about.items()]


class JsonMessage(NamedTuple):
    """A JSON message, for data that Foxglove has no schema for."""

    kind: str
    values: Mapping[str, Json]


class MessageStamp(TypedDict):
    """Timestamp and coordinate frame of a measurement: fields of most of Foxglove's messages."""

    timestamp: Timestamp
    frame_id: str


class Logged(NamedTuple):
    """A message with its topic, below the agent's name, and its simulation time [s]."""

    topic: str
    message: Message | JsonMessage
    time_s: float


def make_messages(frame: Frame) -> Iterator[Logged]:
    """Yield the messages of a whole frame: transforms, measurements of all sensors, weather, annotations."""
    true = frame.calibration
    spin_s = frame.time_s

    def looks_s(sensor: str) -> float:
        return spin_s + true.offset_ms.get(sensor, 0.0) / 1000

    def place(sensor: str) -> MessageStamp:
        return {"timestamp": _stamp(looks_s(sensor)), "frame_id": f"{frame.agent}/{sensor}"}

    mounts = [(frame.agent, f"{frame.agent}/{name}", mount) for name, mount in true.agent_from_sensor.items()]
    yield Logged("tf", _transforms([("world", frame.agent, frame.world_from_agent), *mounts], spin_s), spin_s)
    for name, world_from_agent in frame.agent_at_trigger.items():
        moved = _transforms([("world", frame.agent, world_from_agent)], looks_s(name))
        yield Logged("tf", moved, looks_s(name))
    for name, points in frame.lidar.items():
        cloud = points
        fields = LIDAR_FIELDS
        if name in frame.point_times:
            cloud, fields = np.column_stack((points, frame.point_times[name])), (*LIDAR_FIELDS, TIME_FIELD)
        yield Logged(f"{name}/points", _cloud(cloud, fields, place(name)), looks_s(name))
    for name, picture in frame.images.items():
        image = CompressedImage(**place(name), data=encode_png(picture.rgb), format="png")
        yield Logged(f"{name}/calibration", _calibration(frame, name, picture.rgb, place(name)), looks_s(name))
        yield Logged(f"{name}/image", image, looks_s(name))
        yield Logged(f"{name}/labels", image_annotations(frame, name, _stamp(looks_s(name))), looks_s(name))
    for name, picture in frame.infrared.items():
        yield Logged(f"{name}/calibration", _calibration(frame, name, picture, place(name)), looks_s(name))
        yield Logged(f"{name}/image", _thermal(picture, place(name)), looks_s(name))
        yield Logged(f"{name}/labels", image_annotations(frame, name, _stamp(looks_s(name))), looks_s(name))
    for name, echoes in frame.radar.items():
        yield Logged(f"{name}/points", _cloud(radar_points(echoes), RADAR_FIELDS, place(name)), looks_s(name))
    for name, (latitude, longitude, altitude) in frame.gnss.items():
        fix = LocationFix(**place(name), latitude=latitude, longitude=longitude, altitude=altitude)
        yield Logged(f"{name}/fix", fix, looks_s(name))
    for name, reading in frame.imu.items():
        halves = (dict(zip("xyz", half.tolist())) for half in np.split(np.asarray(reading, np.float64), 2))
        imu = JsonMessage("Imu", {"frame_id": f"{frame.agent}/{name}", **dict(zip(IMU_FIELDS, halves))})
        yield Logged(f"{name}/imu", imu, looks_s(name))
    if frame.weather is not None:
        yield Logged("weather", JsonMessage("Weather", frame.weather.model_dump(mode="json")), spin_s)
    yield Logged("objects", scene_update(frame, _stamp(spin_s)), spin_s)


def radar_points(echoes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return radar returns (N, 5) as columns RADAR_FIELDS (N, 8), with x, y, z [m] in the radar's frame prepended."""
    return np.concatenate((echoes[:, :1] * compute_echo_directions(echoes), echoes), axis=1).astype(np.float32)


def _cloud(points: NDArray[np.float32], names: tuple[str, ...], place: MessageStamp) -> PointCloud:
    number = PackedElementField.FLOAT32
    fields = [PackedElementField(name=name, offset=4 * i, type=number) for i, name in enumerate(names)]
    data = np.ascontiguousarray(points, dtype="<f4").tobytes()
    return PointCloud(**place, pose=pose_message(np.eye(4)), point_stride=4 * len(names), fields=fields, data=data)


def _calibration(frame: Frame, camera: str, picture: NDArray, place: MessageStamp) -> CameraCalibration:
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


def _thermal(picture: NDArray[np.uint16], place: MessageStamp) -> RawImage:
    height, width = picture.shape
    data = np.ascontiguousarray(picture, dtype="<u2").tobytes()
    return RawImage(**place, width=width, height=height, encoding="mono16", step=2 * width, data=data)


def _transforms(tree: list[tuple[str, str, Array]], time_s: float) -> FrameTransforms:
    """Return one message with the transforms in `tree`: triples of parent, child and parent_from_child (4, 4) [m]."""
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


def export_mcap(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write `<scene>.mcap` for each scene of `dataset`: see `ExportFormat`."""
    counts: Counter[str] = Counter(files=0, messages=0, objects=0)
    done = 0
    for scene in dict.fromkeys(key.scene for key in dataset.keys):
        with (out / f"{scene}.mcap").open("wb") as file:
            log = _Log(Writer(file))
            for i in dataset.select(scenes=[scene]):
                frame = read_frame(dataset, i, options)
                for logged in make_messages(frame):
                    log.write(f"/{frame.agent}/{logged.topic}", logged.message, logged.time_s)
                    counts["messages"] += 1
                counts["objects"] += len(frame.annotations)
                done += 1
                progress(done, len(dataset), "")
            log.writer.finish()
        counts["files"] += 1
    return Exported(counts)


EXPORT = ExportFormat(export_mcap, ("calibration",))


class _Log:
    """An open MCAP file with one channel per topic, registered with its first message."""

    def __init__(self, writer: Writer) -> None:
        writer.start(profile="", library="flcav")
        self.writer = writer
        self._channels: dict[str, int] = {}
        self._schema = cache(lambda kind: register_schema(writer, kind))
        self._json_schema = cache(lambda kind, schema: writer.register_schema(kind, "jsonschema", schema))

    def write(self, topic: str, message: Message | JsonMessage, time_s: float) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._open(topic, message)
        if isinstance(message, JsonMessage):
            data = json.dumps(message.values, allow_nan=False).encode()
        else:
            data = message.SerializeToString(deterministic=True)
        stamp = round(time_s * 1e9)
        self.writer.add_message(self._channels[topic], log_time=stamp, publish_time=stamp, data=data)

    def _open(self, topic: str, message: Message | JsonMessage) -> int:
        if isinstance(message, JsonMessage):
            schema = json.dumps(_schema_of(message.values)).encode()
            return self.writer.register_channel(topic, "json", self._json_schema(f"flcav.{message.kind}", schema))
        return self.writer.register_channel(topic, "protobuf", self._schema(type(message)))


def _schema_of(value: Json) -> dict[str, Json]:
    """Return the JSON schema of a value of objects, texts and numbers."""
    if isinstance(value, Mapping):
        return {"type": "object", "properties": {name: _schema_of(part) for name, part in value.items()}}
    return {"type": "string" if isinstance(value, str) else "number"}

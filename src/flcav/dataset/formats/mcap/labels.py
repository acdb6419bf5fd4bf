"""Labels as Foxglove's messages: boxes in the world, rectangles in pictures."""

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from flcav.dataset.formats.colours import COLOURS, OTHER, SIGN
from flcav.dataset.formats.mounts import quaternion
from flcav.geometry import pose
from flcav.sensors.frame import Frame


def scene_update(frame: Frame, stamp: Timestamp) -> SceneUpdate:
    """Return the boxes of a frame in the world, in place of those before; fainter without a LiDAR return."""
    truth, boxes = frame.annotations, frame.annotations.boxes
    entities = []
    for i, label in enumerate(boxes.label.tolist()):
        cube = CubePrimitive(
            pose=pose_message(pose(*boxes.center[i], yaw=boxes.yaw[i])),
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
    """Return the visible rectangles of actors, signs and signals in a picture, pixels from its corner."""
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
            rectangles.append(_rectangle(views.visible_box[i], COLOURS.get(label, OTHER), about, stamp))
    if camera in truth.signs:
        signs = truth.signs[camera]
        for kind, state, box, distance_m in zip(signs.kind, signs.state, signs.box, signs.distance_m):
            about = {"class": str(kind), "state": str(state), "distance_m": f"{distance_m:.2f}"}
            rectangles.append(_rectangle(box, SIGN, about, stamp))
    return ImageAnnotations(timestamp=stamp, points=rectangles)


def pose_message(matrix: NDArray[np.float64]) -> Pose:
    """Return a (4, 4) transform as a message."""
    w, x, y, z = quaternion(matrix)
    px, py, pz = matrix[:3, 3].tolist()
    return Pose(position=Vector3(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _rectangle(
    box: NDArray[np.float64], colour: tuple[float, float, float], about: dict[str, str], stamp: Timestamp
) -> PointsAnnotation:
    left, top, right, bottom = (box + 0.5).tolist()  # ours are from the centre of the first pixel
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

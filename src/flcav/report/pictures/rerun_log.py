"""Rerun recording of a scene: map, agents with the data of their sensors, actors and their tracks.

All spatial entities are children of `world` (ENU, z up): an agent is `world/agents/<agent>`, its sensors are children
of it. There are two timelines: `spin`, and the simulation's `time`.
"""

from collections import defaultdict
from collections.abc import Sequence
from io import BytesIO
from itertools import groupby

import numpy as np
import rerun as rr  # pyright: ignore[reportMissingImports] # of the extra `view`
import rerun.blueprint as rrb  # pyright: ignore[reportMissingImports]
import shapely
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from flcav.dataset.formats.writing import COLOURS, OTHER, SIGN
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, concatenate, inverse
from flcav.interface.progress import Report, ignore_progress
from flcav.sensors.frame import Frame
from flcav.sensors.radar import compute_echo_directions
from flcav.world.map.lanes import map_layers
from flcav.world.map.layers import MapLayers
from flcav.world.map.relief import Relief
from flcav.world.map.town import Town

Array = NDArray[np.float64]

LIDAR_COLOURS = colormaps["turbo"]
RADAR_COLOURS = colormaps["coolwarm"]
RADAR_M_S = 15.0  # radial speed at the ends of the colour scale
STEP_M = 2.0  # greatest distance between the points of a line on slopes
BEHIND_M = (-28.0, 0.0, 16.0)  # initial viewpoint in the agent's frame
AGENTS = "world/agents"


def log_scene(
    recording: rr.RecordingStream,
    dataset: Dataset,
    selected: Sequence[int],
    town: Town | None,
    progress: Report = ignore_progress,
) -> None:
    """Log the `selected` frames of one scene to a `rerun.RecordingStream`, with the map of its town, if known."""
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if town is not None:
        _log_map(recording, map_layers(town), town.relief)
    tracks: dict[str, list[Array]] = defaultdict(list)
    done = 0
    for spin, numbers in groupby(selected, key=lambda i: dataset.keys[i].index):
        frames = [dataset.frame(i) for i in numbers]
        recording.set_time("spin", sequence=spin)
        recording.set_time("time", duration=frames[0].time_s)
        for frame in frames:
            _log_agent(recording, frame)
        _log_actors(recording, frames, tracks)
        done += len(frames)
        progress(done, len(selected), "")


def blueprint(spin: Sequence[Frame]) -> rrb.Blueprint:
    """Return the initial layout of the viewer: the world from above and behind an agent, next to its cameras.

    The agent is the first one of the frames `spin` with a camera, or the first of all.
    """
    frame = next((frame for frame in spin if frame.images or frame.infrared), spin[0])
    behind, agent = frame.world_from_agent @ (*BEHIND_M, 1.0), frame.world_from_agent[:3, 3]
    eye = rrb.EyeControls3D(position=behind[:3], look_target=agent, eye_up=(0, 0, 1))
    world = rrb.Spatial3DView(origin="world", name="world", eye_controls=eye)
    pictures = [
        rrb.Spatial2DView(origin=f"{AGENTS}/{frame.agent}/{name}", name=f"{frame.agent} {name}")
        for name in (*frame.images, *frame.infrared)
    ]
    views = rrb.Horizontal(world, rrb.Grid(*pictures), column_shares=[3, 2]) if pictures else world
    return rrb.Blueprint(views, rrb.TimePanel(state="collapsed", timeline="spin"), collapse_panels=True)


def _log_map(recording: rr.RecordingStream, layers: MapLayers, relief: Relief | None) -> None:
    outlines = {
        "roads": (layers.roads, (110, 110, 115)),
        "sidewalks": (layers.sidewalks, (150, 140, 120)),
        "crossings": ([crossing.outline for crossing in layers.crossings], (220, 220, 220)),
    }
    lines = {name: ([np.vstack((ring, ring[:1])) for ring in rings], hue) for name, (rings, hue) in outlines.items()}
    lines["lanes"] = [lane.centre_line for lane in layers.lanes if lane.kind != "walkingarea"], (35, 60, 80)
    lines["markings"] = [marking.line for marking in layers.markings], (235, 235, 235)
    for name, (of_layer, colour) in lines.items():
        strips = [_lay_on_ground(line, relief) for line in of_layer]
        recording.log(f"world/map/{name}", rr.LineStrips3D(strips, colors=colour, radii=0.05), static=True)


def _lay_on_ground(line: Array, relief: Relief | None) -> Array:
    """Return a line (K, 2) [m] laid on the ground (K', 3) [m]; on a relief with a point at least every `STEP_M`."""
    if relief is None:
        return np.column_stack((line, np.zeros(len(line))))
    dense = shapely.get_coordinates(shapely.segmentize(shapely.linestrings(line), STEP_M))
    return np.column_stack((dense, relief.heights(*dense.T)))


def _log_agent(recording: rr.RecordingStream, frame: Frame) -> None:
    path = f"{AGENTS}/{frame.agent}"
    _log_pose(recording, path, frame.world_from_agent)
    agent_from_world = inverse(frame.world_from_agent)
    for name in frame.calibration.agent_from_sensor:
        _log_pose(recording, f"{path}/{name}", agent_from_world @ frame.world_from_sensor(name))
    for name, points in frame.lidar.items():
        colours = LIDAR_COLOURS(np.sqrt(np.clip(points[:, 3], 0, 1)), bytes=True)
        recording.log(f"{path}/{name}", rr.Points3D(points[:, :3], colors=colours, radii=0.03))
    for name, echoes in frame.radar.items():
        _log_radar(recording, f"{path}/{name}", echoes)
    for name, picture in frame.images.items():
        _log_pinhole(recording, f"{path}/{name}", frame.calibration.intrinsics[name], picture.rgb)
        _log_picture(recording, f"{path}/{name}", picture.rgb)
        _log_rectangles(recording, f"{path}/{name}", frame, name)
    for name, picture in frame.infrared.items():
        _log_pinhole(recording, f"{path}/{name}", frame.calibration.intrinsics[name], picture)
        low, high = np.percentile(picture, (1, 99))
        grey = np.clip((picture - low) / max(high - low, 1) * 255, 0, 255).astype(np.uint8)
        _log_picture(recording, f"{path}/{name}", grey)
    for name, (latitude, longitude, _) in frame.gnss.items():
        recording.log(f"gnss/{frame.agent}/{name}", rr.GeoPoints(lat_lon=[[latitude, longitude]]))
    for name, reading in frame.imu.items():
        recording.log(f"imu/{frame.agent}/{name}", rr.Scalars(reading))


def _log_pose(recording: rr.RecordingStream, path: str, parent_from_child: Array) -> None:
    recording.log(path, rr.Transform3D(translation=parent_from_child[:3, 3], mat3x3=parent_from_child[:3, :3]))


def _log_radar(recording: rr.RecordingStream, path: str, echoes: NDArray[np.float32]) -> None:
    colours = RADAR_COLOURS(0.5 + echoes[:, 3] / (2 * RADAR_M_S), bytes=True)
    recording.log(path, rr.Points3D(echoes[:, :1] * compute_echo_directions(echoes), colors=colours, radii=0.12))


def _log_pinhole(recording: rr.RecordingStream, path: str, intrinsics: Array, picture: NDArray) -> None:
    height, width = picture.shape[:2]
    pinhole = rr.Pinhole(
        image_from_camera=intrinsics,
        resolution=[width, height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=1.2,
    )
    recording.log(path, pinhole)


def _log_picture(recording: rr.RecordingStream, path: str, pixels: NDArray[np.uint8]) -> None:
    data = BytesIO()
    Image.fromarray(pixels).save(data, "jpeg", quality=90)
    recording.log(f"{path}/image", rr.EncodedImage(contents=data.getvalue(), media_type="image/jpeg"))


def _log_rectangles(recording: rr.RecordingStream, path: str, frame: Frame, camera: str) -> None:
    truth = frame.annotations
    views, signs = truth.views.get(camera), truth.signs.get(camera)
    if views is not None:
        shown = np.flatnonzero(views.pixels)
        colours = [COLOURS.get(label, OTHER) for label in truth.boxes.label[shown].tolist()]
        _log_boxes(recording, f"{path}/image/actors", views.shown_box[shown], truth.track[shown].tolist(), colours)
    if signs is not None:
        names = [f"{kind} {state}".strip() for kind, state in zip(signs.kind, signs.state)]
        _log_boxes(recording, f"{path}/image/signs", signs.box, names, [SIGN] * len(signs))


def _log_boxes(recording: rr.RecordingStream, path: str, boxes: Array, labels: list[str], colours: list) -> None:
    from_corner = boxes.reshape(-1, 4) + 0.5  # Rerun has the first pixel's corner at 0, flcav its centre
    rectangles = rr.Boxes2D(
        array=from_corner, array_format=rr.Box2DFormat.XYXY, labels=labels, colors=colours, show_labels=False
    )
    recording.log(path, rectangles)


def _log_actors(recording: rr.RecordingStream, spin: list[Frame], tracks: dict[str, list[Array]]) -> None:
    """Log the actors in the annotations of all agents, and their tracks up to this spin."""
    actors: dict[str, Boxes] = {}
    for frame in spin:
        for i, track in enumerate(frame.annotations.track.tolist()):
            actors[track] = frame.annotations.boxes[i : i + 1]
    boxes = concatenate(list(actors.values()))
    feet = boxes.center - boxes.rotations()[:, :, 2] * boxes.size[:, 2:] / 2
    for track, foot in zip(actors, feet):
        tracks[track].append(foot)
    colours = [COLOURS.get(label, OTHER) for label in boxes.label.tolist()]
    tilt = np.zeros((len(boxes), 2)) if boxes.tilt is None else boxes.tilt
    shown = rr.Boxes3D(
        centers=boxes.center,
        sizes=boxes.size,
        quaternions=Rotation.from_euler("ZYX", np.column_stack((boxes.yaw, tilt))).as_quat(),
        colors=colours,
        labels=[f"{label} {track}" for track, label in zip(actors, boxes.label.tolist())],
        show_labels=False,
    )
    recording.log("world/actors", shown)
    lines = [np.array(tracks[track]) for track in actors]
    recording.log("world/tracks", rr.LineStrips3D(lines, colors=colours, radii=0.08))

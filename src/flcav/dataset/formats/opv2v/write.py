"""Export to OPV2V, as OpenCOOD reads it: `<split>/<scenario>/<agent>/<time>.yaml`, `.pcd`, `_camera0.png`.

All frames are CARLA's left-handed ones (y to the right); poses are x, y, z [m], roll, yaw, pitch [degrees]. Agents and
vehicles share one numbering. Xu et al., OPV2V, ICRA 2022; OpenCOOD's `transformation_utils.x_to_world`.
"""

from collections import Counter, defaultdict
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import yaml

from flcav.dataset.formats.opv2v.files import FOLDERS, KMH, MIRRORED, carla_pose, encode_cloud
from flcav.dataset.formats.writing import (
    Exported,
    ExportFormat,
    ExportOptions,
    LeftOut,
    agent_velocities,
    assign_channels,
    check_rectified,
    count_readable_points,
    count_unwritten,
    lacks_points,
    missing_data_error,
    optical_yaw,
    read_frame,
    select_objects,
    split_with_validation,
    write_file,
)
from flcav.dataset.payloads import encode_png
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report
from flcav.sensors.frame import Frame
from flcav.sensors.lens import BODY_FROM_OPTICAL

VEHICLES = ("car", "van", "truck", "bus")
CAMERAS = {  # yaw, counter-clockwise from ahead [rad]
    "camera0": 0.0,
    "camera1": np.radians(-100),
    "camera2": np.radians(100),
    "camera3": np.pi,
}
FIRST_CAR, FIRST_POLE, FIRST_TRACK = 1001, 2001, 10001  # OpenCOOD takes the agent whose number sorts first as the ego
FAST_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # a PyYAML built without libyaml has only the slow one


class Opv2vVehicle(TypedDict):
    """A vehicle in OPV2V's file of a frame."""

    angle: list[float]  # roll, yaw, pitch [degrees]
    center: list[float]  # of the box, relative to `location` [m]
    extent: list[float]  # half length, width, height [m]
    location: list[float]  # x, y, z of the ground centre [m]
    speed: float  # [km/h]


def export_opv2v(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write one scenario per scene of `dataset`: see `ExportFormat`.

    Spins that some agent of a scene lacks are left out.
    """
    split_of = split_with_validation(dataset, options, "OPV2V")
    exported = Exported(Counter(scenarios=0, frames=0, objects=0))
    counts = exported.counts
    done = 0
    for split in ("train", "val") if "train" in split_of.values() else ():
        (out / FOLDERS[split]).mkdir()
    for scene, split in split_of.items():
        folder = out / FOLDERS[split] / scene
        selected = dataset.select(scenes=[scene])
        shared = _shared_spins(dataset, scene)
        numbers = agent_numbers(sorted({dataset.keys[i].agent for i in selected}))
        speeds = agent_velocities(dataset, scene)
        for i in selected:
            done += 1
            progress(done, len(dataset), "")
            frame = read_frame(dataset, i, options)
            if frame.index not in shared:
                exported.leave_out(frame, "OPV2V needs each spin of every agent", f"spin {frame.index} of {scene}")
                continue
            if not frame.lidar:
                raise missing_data_error(dataset, "OPV2V", "a LiDAR on every agent", frame.agent)
            for track in frame.annotations.track.tolist():
                numbers.setdefault(track, FIRST_TRACK + len(numbers))
            speed = float(np.linalg.norm(speeds[frame.agent, frame.index]))
            vehicles, left_out = _vehicles(frame, numbers, options.min_points)
            exported.left_out.update(left_out)
            written = _write_frame(frame, folder / str(numbers[frame.agent]), vehicles, speed)
            exported.left_out.update(count_unwritten("OPV2V", frame, written))
            counts.update(frames=1, objects=len(vehicles))
        protocol = {"recipe": dataset.manifest.recipe, "numbers": numbers}
        write_file(folder / "data_protocol.yaml", yaml.safe_dump(protocol, sort_keys=False))
        counts["scenarios"] += 1
    return exported


EXPORT = ExportFormat(export_opv2v, ("validation", "min_points", "calibration"))


def _shared_spins(dataset: Dataset, scene: str) -> set[int]:
    """Return the spins common to all agents of a scene: a recording with a limit of frames may end within a spin.

    Raises `InputError` where there is none.
    """
    spins: dict[str, set[int]] = defaultdict(set)
    for i in dataset.select(scenes=[scene]):
        spins[dataset.keys[i].agent].add(dataset.keys[i].index)
    shared = set.intersection(*spins.values())
    if not shared:
        raise missing_data_error(dataset, "OPV2V", "spins that every agent of a scene has", scene)
    return shared


def agent_numbers(agents: list[str]) -> dict[str, int]:
    """Return numbers by agent; vehicles sort before poles, since OpenCOOD takes the first agent as the ego vehicle."""
    cars = [agent for agent in agents if not agent.startswith("pole")]
    poles = [agent for agent in agents if agent.startswith("pole")]
    return {
        **{agent: FIRST_CAR + i for i, agent in enumerate(cars)},
        **{agent: FIRST_POLE + i for i, agent in enumerate(poles)},
    }


def _write_frame(frame: Frame, folder: Path, vehicles: dict[int, Opv2vVehicle], speed_m_s: float) -> set[str]:
    """Write the files of a frame; return the sensors whose measurements they hold."""
    lidar, points = next(iter(frame.lidar.items()))
    time = f"{frame.index:06d}"
    write_file(folder / f"{time}.pcd", encode_cloud(points))
    world_from_lidar = frame.world_from_sensor(lidar)
    mounts = frame.calibration.agent_from_sensor
    cameras = assign_channels({name: optical_yaw(mounts[name]) for name in frame.images}, CAMERAS)
    about: dict[str, Any] = {}
    for name, camera in sorted(cameras.items(), key=lambda pair: pair[1]):
        check_rectified(frame, name, "OPV2V")
        write_file(folder / f"{time}_{camera}.png", encode_png(frame.images[name].rgb))
        world_from_camera = frame.world_from_sensor(name) @ BODY_FROM_OPTICAL.T
        about[camera] = {
            "cords": carla_pose(world_from_camera),
            "extrinsic": (MIRRORED @ np.linalg.inv(world_from_camera) @ world_from_lidar @ MIRRORED).tolist(),
            "intrinsic": frame.calibration.intrinsics[name].tolist(),
        }
    ego = carla_pose(frame.world_from_agent)
    about |= {
        "ego_speed": speed_m_s * KMH,
        "lidar_pose": carla_pose(world_from_lidar),
        "plan_trajectory": [],
        "predicted_ego_pos": ego,
        "true_ego_pos": list(ego),
        "vehicles": vehicles,
    }
    write_file(folder / f"{time}.yaml", yaml.dump(about, Dumper=FAST_DUMPER))
    return {lidar, *cameras}


def _vehicles(
    frame: Frame, numbers: dict[str, int], min_points: int
) -> tuple[dict[int, Opv2vVehicle], Counter[LeftOut]]:
    """Return OPV2V's boxes, by number, of vehicles with at least `min_points` points of the first LiDAR in the box.

    Other actors are counted by reason.
    """
    truth = frame.annotations
    boxes = frame.annotations.boxes
    few = count_readable_points(frame, *next(iter(frame.lidar.items()))) < min_points
    labelled, left_out = select_objects("OPV2V", boxes.label, VEHICLES, {lacks_points(min_points): few})
    vehicles: dict[int, Opv2vVehicle] = {}
    for i in np.flatnonzero(labelled):
        tall = boxes.size[i, 2]
        placed = boxes.pose(int(i))
        placed[2, 3] -= tall / 2  # straight down, also where the box leans: OpenCOOD adds location and center unrotated
        x, y, z, *rotation = carla_pose(placed)
        vehicles[numbers[str(truth.track[i])]] = {
            "angle": rotation,
            "center": [0.0, 0.0, float(tall / 2)],
            "extent": (boxes.size[i] / 2).tolist(),
            "location": [x, y, z],
            "speed": float(np.linalg.norm(truth.velocity[i]) * KMH),
        }
    return vehicles, left_out

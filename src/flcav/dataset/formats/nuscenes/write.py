"""Export to nuScenes: tables, `samples` and `maps`, to be opened as version `v1.0-flcav`.

A nuScenes scene has one vehicle, so that each agent of a scene becomes a separate scene. Every spin is a key frame. The
global frame is the world frame, shifted so that the map's lower left corner is its origin.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flcav.dataset.formats.nuscenes.files import (
    CAMERAS,
    CATEGORIES,
    OURS_FROM_LIDAR,
    RADARS,
    RESOLUTION_M,
    VERSION,
    Row,
    attributes,
    constant_rows,
    encode_lidar,
    encode_radar,
    link_rows,
    map_mask,
    token,
    visibility,
)
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
    missing_data_error,
    optical_yaw,
    quaternion,
    read_frame,
    select_objects,
    split_scenes,
    write_file,
)
from flcav.dataset.payloads import encode_png
from flcav.dataset.store import Dataset
from flcav.geometry import Array, pose, transform_points, yaw_of
from flcav.interface.progress import Report
from flcav.sensors.frame import Frame
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern
from flcav.sensors.radar import compute_echo_directions

MAP = "maps/map.png"
UNKNOWN_MARGIN_M = 120.0  # margin of the map around the agents where the town is unknown


def export_nuscenes(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write one nuScenes scene per agent and scene of `dataset`: see `ExportFormat`."""
    split_of = split_scenes(dataset, options)
    tables = constant_rows()
    global_from_world = _write_map(dataset, out / MAP)
    location = Path(str(dataset.manifest.recipe.get("town", "unknown"))).name
    splits: dict[str, list[str]] = defaultdict(list)
    exported = Exported(Counter(scenes=0, samples=0, objects=0))
    counts = exported.counts
    for scene, split in split_of.items():
        velocities = agent_velocities(dataset, scene)
        for agent in dict.fromkeys(dataset.keys[i].agent for i in dataset.select(scenes=[scene])):
            selected = dataset.select(agents=[agent], scenes=[scene])
            counts["scenes"] += 1
            elevations = _elevations(dataset, agent)
            drive = NuscenesScene(counts["scenes"], scene, agent, location, out, global_from_world, elevations)
            splits[f"flcav_{split}"].append(drive.name)
            for i in selected:
                frame = read_frame(dataset, i, options)
                if not frame.lidar:
                    raise missing_data_error(dataset, "nuScenes", "a LiDAR on every agent", agent)
                drive.add(frame, velocities[agent, frame.index])
                counts["samples"] += 1
                progress(counts["samples"], len(dataset), "")
            for table, rows in drive.rows().items():
                tables[table] += rows
            exported.left_out.update(drive.left_out)
    counts["objects"] = len(tables["sample_annotation"])
    tables["sensor"] = list({row["token"]: row for row in tables["sensor"]}.values())
    tables["map"] = [
        {
            "token": token("map"),
            "category": "semantic_prior",
            "filename": MAP,
            "log_tokens": [row["token"] for row in tables["log"]],
        }
    ]
    for name, rows in {**tables, "splits": splits}.items():
        write_file(out / VERSION / f"{name}.json", json.dumps(rows, indent=0, allow_nan=False))
    (out / "sweeps").mkdir()
    return exported


EXPORT = ExportFormat(export_nuscenes, ("validation", "calibration"))


def _elevations(dataset: Dataset, agent: str) -> dict[str, Array]:
    """Return the elevations [rad] of the channels, from the lowest, by LiDAR; empty where the manifest has no rig."""
    rig = dataset.manifest.recipe.get("pole_rig" if agent.startswith("pole") else "vehicle_rig")
    lidars = rig.get("lidars") if isinstance(rig, Mapping) else None
    elevations = {}
    for name, lidar in lidars.items() if isinstance(lidars, Mapping) else ():
        assert isinstance(lidar, Mapping)
        settings = Lidar.model_validate(lidar["settings"])
        first = build_ray_pattern(settings)[:: settings.azimuth_steps].astype(
            np.float64
        )  # (C, 3) first ray of each channel
        elevations[name] = np.arcsin(first[::-1, 2])
    return elevations


def _write_map(dataset: Dataset, path: Path) -> Array:
    """Write the map, all zero where the dataset's town is unknown; return `global_from_world` (4, 4) [m]."""
    town = dataset.town()
    if town is None:
        positions = np.array([dataset.world_from_agent(i)[:2, 3] for i in range(len(dataset))])
        low, high = positions.min(axis=0) - UNKNOWN_MARGIN_M, positions.max(axis=0) + UNKNOWN_MARGIN_M
        height, width = np.ceil((high - low)[::-1] / RESOLUTION_M).astype(int)
        mask = np.zeros((height, width), np.uint8)
    else:
        low, mask = np.array(town.bounds[:2]), map_mask(town)
    write_file(path, encode_png(mask))
    return pose(-low[0], -low[1])


NO_CHANNELS = np.zeros(0)
UNDATED = "1970-01-01"  # date of capture: simulated time has none


@dataclass
class NuscenesScene:
    """A nuScenes scene under construction: it collects table rows as frames are added, and writes their files."""

    number: int  # of the scene, from 1
    scene: str  # its name in the dataset
    agent: str
    location: str
    out: Path
    global_from_world: Array  # (4, 4) [m]
    elevations: Mapping[str, Array]  # LiDAR -> elevations of its channels [rad]: see `encode_lidar`
    samples: list[Row] = field(default_factory=list)
    sensors: dict[str, Row] = field(default_factory=dict)  # by channel
    calibrated: dict[str, Row] = field(default_factory=dict)  # by channel
    poses: list[Row] = field(default_factory=list)
    data: dict[str, list[Row]] = field(default_factory=lambda: defaultdict(list))  # by channel
    annotations: dict[str, list[Row]] = field(default_factory=lambda: defaultdict(list))  # by track
    category: dict[str, str] = field(default_factory=dict)  # of each track
    left_out: Counter[LeftOut] = field(default_factory=Counter)

    @property
    def name(self) -> str:
        """Return the name of the nuScenes scene, e.g. "scene-0001"."""
        return f"scene-{self.number:04d}"

    def add(self, frame: Frame, velocity: Array) -> None:
        """Write the files of a frame and add its rows; `velocity` (3,) is the agent's, world frame [m/s].

        Raises `InputError` where a camera distorts.
        """
        self.samples.append(
            {
                "token": token(self.name, "sample", frame.index),
                "timestamp": self._micros(frame.time_s),
                "scene_token": token(self.name),
            }
        )
        mounts = frame.calibration.agent_from_sensor
        for i, (name, points) in enumerate(frame.lidar.items()):
            channel = "LIDAR_TOP" if i == 0 else f"LIDAR_{name.upper()}"
            self._add_data(
                frame, name, channel, "pcd.bin", encode_lidar(points, self.elevations.get(name, NO_CHANNELS))
            )
        cameras = assign_channels({name: optical_yaw(mounts[name]) for name in frame.images}, CAMERAS)
        radars = assign_channels({name: yaw_of(mounts[name]) for name in frame.radar}, RADARS)
        for name, channel in cameras.items():
            check_rectified(frame, name, "nuScenes")
            self._add_data(frame, name, channel, "png", encode_png(frame.images[name].rgb))
        for name, channel in radars.items():
            radar_from_world = frame.world_from_sensor(name)[:3, :3].T
            self._add_data(frame, name, channel, "pcd", encode_radar(frame.radar[name], radar_from_world @ velocity))
        self._add_annotations(frame)
        self.left_out.update(count_unwritten("nuScenes", frame, {*frame.lidar, *cameras, *radars}))

    def _add_data(self, frame: Frame, name: str, channel: str, suffix: str, data: bytes) -> None:
        true = frame.calibration
        stamp = self._micros(frame.time_s + true.offset_ms.get(name, 0.0) / 1000)
        path = f"samples/{channel}/{self.name}__{channel}__{stamp}.{suffix}"
        write_file(self.out / path, data)
        ego_from_sensor = true.agent_from_sensor[name]
        if channel.startswith("LIDAR"):
            ego_from_sensor = ego_from_sensor @ OURS_FROM_LIDAR
        modality = {"LIDAR": "lidar", "CAM": "camera", "RADAR": "radar"}[channel.partition("_")[0]]
        picture = frame.images.get(name)
        self.sensors[channel] = {"token": token(channel), "channel": channel, "modality": modality}
        self.calibrated[channel] = {
            "token": token(self.name, channel),
            "sensor_token": token(channel),
            **_placed(ego_from_sensor),
            "camera_intrinsic": [] if picture is None else true.intrinsics[name].tolist(),
        }
        data_token = token(self.name, channel, frame.index)
        world_from_agent = frame.agent_at_trigger.get(name, frame.world_from_agent)
        self.poses.append(
            {"token": data_token, "timestamp": stamp, **_placed(self.global_from_world @ world_from_agent)}
        )
        self.data[channel].append(
            {
                "token": data_token,
                "sample_token": self.samples[-1]["token"],
                "ego_pose_token": data_token,
                "calibrated_sensor_token": token(self.name, channel),
                "timestamp": stamp,
                "fileformat": "png" if picture is not None else "pcd",
                "is_key_frame": True,
                "height": 0 if picture is None else picture.rgb.shape[0],
                "width": 0 if picture is None else picture.rgb.shape[1],
                "filename": path,
            }
        )

    def _micros(self, time_s: float) -> int:
        """Return a time stamp [µs], shifted by the scene's number: the devkit cannot sort scenes with equal ones."""
        return round(time_s * 1e6) + self.number

    def _add_annotations(self, frame: Frame) -> None:
        truth = frame.annotations
        boxes = frame.annotations.boxes
        top, cloud = next(iter(frame.lidar.items()))
        lidar = count_readable_points(frame, top, cloud)
        radar = np.zeros_like(lidar)
        for name, echoes in frame.radar.items():
            radar += count_readable_points(frame, name, echoes[:, :1] * compute_echo_directions(echoes))
        center = transform_points(self.global_from_world, boxes.center)
        labelled, left_out = select_objects("nuScenes", boxes.label, CATEGORIES, {})  # imported datasets have others
        self.left_out.update(left_out)
        for i in np.flatnonzero(labelled).tolist():
            track = str(truth.track[i])
            category = str(boxes.label[i])
            length, width, height = boxes.size[i].tolist()
            speed = float(np.linalg.norm(truth.velocity[i]))
            self.category[track] = category
            self.annotations[track].append(
                {
                    "token": token(self.name, "annotation", track, frame.index),
                    "sample_token": self.samples[-1]["token"],
                    "instance_token": token(self.name, "instance", track),
                    "visibility_token": visibility(truth.occlusion[i]),
                    "attribute_tokens": attributes(category, track, speed),
                    "translation": center[i].tolist(),
                    "size": [width, length, height],
                    "rotation": quaternion(boxes.pose(i)),
                    "num_lidar_pts": int(lidar[i]),
                    "num_radar_pts": int(radar[i]),
                }
            )

    def rows(self) -> dict[str, list[Row]]:
        """Return the rows of the scene by table, and link consecutive rows (`prev`, `next`)."""
        for rows in (self.samples, *self.data.values(), *self.annotations.values()):
            link_rows(rows)
        scene = {
            "token": token(self.name),
            "log_token": token(self.name, "log"),
            "nbr_samples": len(self.samples),
            "first_sample_token": self.samples[0]["token"],
            "last_sample_token": self.samples[-1]["token"],
            "name": self.name,
            "description": f"{self.scene} {self.agent}",
        }
        log = {
            "token": scene["log_token"],
            "logfile": self.scene,
            "vehicle": self.agent,
            "date_captured": UNDATED,
            "location": self.location,
        }
        instances = [
            {
                "token": rows[0]["instance_token"],
                "category_token": token("category", CATEGORIES[self.category[track]]),
                "nbr_annotations": len(rows),
                "first_annotation_token": rows[0]["token"],
                "last_annotation_token": rows[-1]["token"],
            }
            for track, rows in self.annotations.items()
        ]
        return {
            "scene": [scene],
            "log": [log],
            "sample": self.samples,
            "sensor": list(self.sensors.values()),
            "calibrated_sensor": list(self.calibrated.values()),
            "ego_pose": self.poses,
            "sample_data": [row for rows in self.data.values() for row in rows],
            "instance": instances,
            "sample_annotation": [row for rows in self.annotations.values() for row in rows],
        }


def _placed(matrix: Array) -> Row:
    return {"translation": matrix[:3, 3].tolist(), "rotation": quaternion(matrix)}

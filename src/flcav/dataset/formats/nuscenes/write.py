"""Export to nuScenes: tables, `samples` and `maps`, to be opened as version `v1.0-flcav`.

A nuScenes scene has one vehicle, so each agent of a scene becomes a scene of its own. Every spin is a key frame. The
global frame is the world frame, shifted so that the map's lower left corner is its origin.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.formats.exporter import (
    Exported,
    ExportFormat,
    ExportOptions,
    missing_data_error,
    read_frame,
    split_scenes,
)
from flcav.dataset.formats.mounts import agent_velocities
from flcav.dataset.formats.nuscenes.drive import Drive
from flcav.dataset.formats.nuscenes.files import RESOLUTION_M, map_mask
from flcav.dataset.formats.nuscenes.tables import VERSION, constant_rows, token
from flcav.dataset.payloads import encode_png
from flcav.dataset.store import Dataset
from flcav.geometry import pose
from flcav.interface.progress import Report
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern

Array = NDArray[np.float64]

MAP = "maps/map.png"
UNKNOWN_MARGIN_M = 120.0  # margin of the map around the agents where the town is unknown


def export_nuscenes(dataset: Dataset, out: Path, options: ExportOptions, progress: Report) -> Exported:
    """Write one nuScenes scene for each agent and scene of `dataset`: see `ExportFormat`."""
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
            drive = Drive(counts["scenes"], scene, agent, location, out, global_from_world, elevations)
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
        path = out / VERSION / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(rows, indent=0, allow_nan=False), encoding="utf-8")
    (out / "sweeps").mkdir()
    return exported


EXPORT = ExportFormat(export_nuscenes, ("validation", "calibration"))


def _elevations(dataset: Dataset, agent: str) -> dict[str, Array]:
    """Return LiDAR -> elevations [rad] of its channels from the lowest; empty where the manifest has no rig."""
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
    """Write the map, all zero where the dataset's town is unknown; return the (4, 4) `global_from_world`."""
    path.parent.mkdir(parents=True)
    town = dataset.town()
    if town is None:
        positions = np.array([dataset.world_from_agent(i)[:2, 3] for i in range(len(dataset))])
        low, high = positions.min(axis=0) - UNKNOWN_MARGIN_M, positions.max(axis=0) + UNKNOWN_MARGIN_M
        height, width = np.ceil((high - low)[::-1] / RESOLUTION_M).astype(int)
        mask = np.zeros((height, width), np.uint8)
    else:
        low, mask = np.array(town.bounds[:2]), map_mask(town)
    path.write_bytes(encode_png(mask))
    return pose(-low[0], -low[1])

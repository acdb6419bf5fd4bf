"""Imports: of a nuScenes-like scene, and with `--maps DIR` of each OpenDRIVE map in a folder instead.

Maps: CPU seconds of the import, netconvert's included, which is to take at most 30.

Scene: decoding from the page cache, MB/s of point payload, and memory against length, one thread. A key frame has
34,720 points of 20 bytes in `LIDAR_TOP`, five radars of 125 echoes, six pictures and 35 boxes, about as many as
nuScenes has. Clouds are decoded alone, and in whole frames, in which points in boxes are counted and boxes are
projected into pictures. Pictures themselves are not decoded: they are linked.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from cpu_time import cpu_ms

from flcav.config import InputError
from flcav.dataset.formats.nuscenes.files import encode_radar, read_nuscenes_points
from flcav.dataset.formats.nuscenes.read import NuscenesSource
from flcav.world.opendrive.importing import import_town

POINTS, ECHOES, BOXES = 34_720, 125, 35
CAMERAS = tuple(f"CAM_{side}" for side in ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK", "BACK_LEFT", "BACK_RIGHT"))
RADARS = tuple(f"RADAR_{side}" for side in ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK_LEFT", "BACK_RIGHT"))
LENS = [[1266.0, 0.0, 816.0], [0.0, 1266.0, 491.0], [0.0, 0.0, 1.0]]
SAMPLES, LONGER = 40, 8  # key frames of a scene, and how many times as many the long one has
SWEEPS = 12  # spins, pictures and scans between a key frame and the next, of which the tables have rows, too
KEYS, ALL = "v1.0-mini", "v1.0-trainval"  # tables of key frames alone, and of all
MODALITY = {**dict.fromkeys(CAMERAS, "camera"), **dict.fromkeys(RADARS, "radar"), "LIDAR_TOP": "lidar"}


def write_scene(folder: Path, samples: int) -> None:
    """Write files of one scene, and two sets of tables: KEYS and ALL."""
    rng = np.random.default_rng(0)
    placed = {"translation": [0.0, 0.0, 1.8], "rotation": [1.0, 0.0, 0.0, 0.0]}
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "scene", "name": "scene-0001", "log_token": "log", "first_sample_token": "0"}],
        "log": [{"token": "log", "logfile": "n000", "vehicle": "n000"}],
        "sensor": [{"token": name, "channel": name, "modality": kind} for name, kind in MODALITY.items()],
        "calibrated_sensor": [
            {"token": name, "sensor_token": name, **placed, "camera_intrinsic": LENS if name in CAMERAS else []}
            for name in MODALITY
        ],
        "category": [{"token": "car", "name": "vehicle.car"}],
        "attribute": [],
        "instance": [{"token": f"car{number}", "category_token": "car"} for number in range(BOXES)],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "sample_annotation": [],
    }
    places = rng.uniform(-50, 50, (BOXES, 2))
    for sample in range(samples):
        time = 1_500_000_000_000_000 + 500_000 * sample
        tables["sample"].append({"token": str(sample), "timestamp": time, "scene_token": "scene"})
        tables["ego_pose"].append({"token": str(sample), "translation": [sample, 0.0, 0.0], "rotation": [1.0, 0, 0, 0]})
        for name in MODALITY:
            path = folder / "samples" / name / f"{sample}.{'jpg' if name in CAMERAS else 'bin'}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(_payload(name, places, rng))
            row = {"token": f"{sample} {name}", "sample_token": str(sample), "ego_pose_token": str(sample)}
            row |= {"calibrated_sensor_token": name, "is_key_frame": True, "timestamp": time}
            size = {"width": 1600, "height": 900}
            tables["sample_data"].append(row | size | {"filename": str(path.relative_to(folder))})
        tables["sample_annotation"] += [
            {
                "token": f"{sample} {number}",
                "sample_token": str(sample),
                "instance_token": f"car{number}",
                "translation": [float(x) + sample, float(y), 0.8],
                "size": [1.8, 4.4, 1.6],
                "rotation": [1.0, 0.0, 0.0, 0.0],
            }
            for number, (x, y) in enumerate(places)
        ]
    _write_tables(folder / KEYS, tables)
    for row in list(tables["sample_data"]):
        for sweep in range(SWEEPS):
            own = f"{row['token']} {sweep}"
            tables["sample_data"].append({**row, "token": own, "ego_pose_token": own, "is_key_frame": False})
            tables["ego_pose"].append({**placed, "token": own})
    _write_tables(folder / ALL, tables)


def _write_tables(folder: Path, tables: dict[str, list[dict[str, Any]]]) -> None:
    folder.mkdir()
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))


def _payload(name: str, places: np.ndarray, rng: np.random.Generator) -> bytes:
    if name in CAMERAS:
        return b"a picture"
    if name in RADARS:
        echoes = rng.uniform([5, -0.8, 0, -10, -5], [60, 0.8, 0.01, 10, 20], (ECHOES, 5)).astype(np.float32)
        return encode_radar(echoes, np.zeros(3))
    distance, azimuth = 2 + rng.exponential(12, POINTS), rng.uniform(-np.pi, np.pi, POINTS)
    around = np.column_stack((distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-1.8, 2, POINTS)))
    around[:2000, :2] = places[rng.integers(0, BOXES, 2000)] + rng.uniform(-0.9, 0.9, (2000, 2))
    cloud = np.column_stack((-around[:, 1], around[:, 0], around[:, 2], rng.uniform(0, 255, (POINTS, 2))))
    return cloud.astype("<f4").tobytes()


def peak_mb(tables: Path) -> float:
    """Return the peak memory [MB] of a process that decodes the scene of `tables`."""
    done = subprocess.run([sys.executable, __file__, "--decode", str(tables)], capture_output=True, check=True)
    return float(done.stdout)


def _size_mb(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.iterdir()) / 1e6


def decode(tables: Path) -> None:
    """Decode all frames of a scene, one at a time."""
    for _ in NuscenesSource(tables).frames("scene-0001"):
        pass


def time_maps(folder: Path) -> None:
    """Print a line for each OpenDRIVE map below `folder`: its size, and the CPU time of its import, or why not."""
    for path in sorted(folder.rglob("*.xodr"), key=lambda path: path.stat().st_size):
        roads = path.read_bytes().count(b"<road ")
        began = os.times()
        with tempfile.TemporaryDirectory() as scratch:
            try:
                import_town(path, Path(scratch) / "town")
                said = ""
            except InputError as error:
                said = str(error)
        spent = np.subtract(os.times()[:4], began[:4]).sum()  # this process and those that it started
        row = {"map": path.name, "mb": round(path.stat().st_size / 1e6, 2), "roads": roads}
        print(json.dumps({**row, "cpu_s": round(float(spent), 2), **({"refused": said} if said else {})}), flush=True)


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--maps", type=Path, help="a folder of OpenDRIVE maps to import")
    parser.add_argument("--decode", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.decode:
        decode(asked.decode)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
        return
    if asked.maps:
        time_maps(asked.maps)
        return
    with tempfile.TemporaryDirectory() as scratch:
        short, long = Path(scratch) / "short", Path(scratch) / "long"
        write_scene(short, SAMPLES)
        write_scene(long, SAMPLES * LONGER)
        clouds = sorted((short / "samples" / "LIDAR_TOP").iterdir())
        megabytes = sum(path.stat().st_size for path in clouds) / 1e6
        source = NuscenesSource(short / KEYS)
        works = [
            lambda: [read_nuscenes_points(path) for path in clouds],
            lambda: [frame.key for frame in source.frames("scene-0001")],
            lambda: NuscenesSource(short / KEYS),
        ]
        turns = np.array([cpu_ms(works, 1) for _ in range(asked.repeats)])
        alone, whole, tables = turns.min(axis=0)  # the fastest turn: other load only slows
        figures = {
            "point_payload_mb": round(megabytes, 1),
            "clouds_mb_per_s": round(float(megabytes / alone * 1e3)),
            "whole_frames_mb_per_s": round(float(megabytes / whole * 1e3)),
            "tables_ms": round(float(tables), 1),
            "peak_mb": {
                "short": round(peak_mb(short / KEYS)),
                "long": round(peak_mb(long / KEYS)),
                "long, with rows between key frames": round(peak_mb(long / ALL)),
            },
            "key_frames": {"short": SAMPLES, "long": SAMPLES * LONGER},
            "tables_mb": {name: round(_size_mb(long / name), 1) for name in (KEYS, ALL)},
        }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()

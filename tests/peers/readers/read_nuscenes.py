"""nuscenes-devkit on an export: python read_nuscenes.py EXPORT DETECTIONS OUT.

DETECTIONS is JSON: sample key -> rows [name, attribute, box, velocity], box and velocity in our LiDAR frame (x ahead,
y left). It prints what the devkit finds in every sample, and what its DetectionEval makes of the detections.
"""

import json
import sys
from pathlib import Path

import numpy as np
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.detection.evaluate import DetectionEval
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import Box, LidarPointCloud, RadarPointCloud
from nuscenes.utils.geometry_utils import points_in_box, view_points
from nuscenes.utils.splits import get_scenes_of_split
from pyquaternion import Quaternion

RIGHT = Quaternion(axis=[0, 0, 1], degrees=90)  # theirs_from_ours: x right, y ahead


def _samples(nusc: NuScenes) -> dict:
    """Return key -> sample of the scenes, spin by spin."""
    found = {}
    for scene in nusc.scene:
        log, token = nusc.get("log", scene["log_token"]), scene["first_sample_token"]
        while token:
            sample = nusc.get("sample", token)
            found[scene["description"], sample["timestamp"]] = (log, sample)
            token = sample["next"]
    return found


def _read(nusc: NuScenes, sample: dict) -> dict:
    path, boxes, _ = nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
    points = LidarPointCloud.from_file(path).points
    notes = [nusc.get("sample_annotation", box.token) for box in boxes]
    echoes, levels = [0] * len(boxes), []
    rectangles = {}
    for channel, token in sample["data"].items():
        file, seen, intrinsic = nusc.get_sample_data(token)
        if channel.startswith("RADAR"):
            cloud = RadarPointCloud.from_file(file).points
            levels += np.hypot(cloud[0], cloud[1]).tolist()
            echoes = [count + int(points_in_box(box, cloud[:3]).sum()) for count, box in zip(echoes, seen)]
        if channel.startswith("CAM"):
            corners = [view_points(box.corners(), intrinsic, normalize=True)[:2] for box in seen]
            rectangles[channel] = {
                nusc.get("sample_annotation", box.token)["instance_token"]: [*xy.min(axis=1), *xy.max(axis=1)]
                for box, xy in zip(seen, corners)
            }
    return {
        "instances": [note["instance_token"] for note in notes],
        "names": [box.name for box in boxes],
        "sizes": [box.wlh[[1, 0, 2]].tolist() for box in boxes],
        "centers": [(RIGHT.inverse.rotate(box.center)).tolist() for box in boxes],
        "said": [[note["num_lidar_pts"], note["num_radar_pts"]] for note in notes],
        "inside": [[int(points_in_box(box, points[:3]).sum()), count] for box, count in zip(boxes, echoes)],
        "rectangles": rectangles,
        "radar_m": sorted(levels),
    }


def _submit(nusc: NuScenes, samples: dict, detections: dict, path: Path) -> None:
    """Write the detections in the global frame, as a submission to the benchmark."""
    results = {}
    for key, sample in samples.items():
        data = nusc.get("sample_data", sample["data"]["LIDAR_TOP"])
        placed = [
            nusc.get("calibrated_sensor", data["calibrated_sensor_token"]),
            nusc.get("ego_pose", data["ego_pose_token"]),
        ]
        results[sample["token"]] = []
        for name, attribute, (x, y, z, length, width, height, yaw), velocity in detections[key]:
            box = Box((x, y, z), (width, length, height), Quaternion(axis=[0, 0, 1], radians=yaw), velocity=velocity)
            box.rotate(RIGHT)
            for place in placed:
                box.rotate(Quaternion(place["rotation"]))
                box.translate(np.array(place["translation"]))
            results[sample["token"]].append(
                {
                    "sample_token": sample["token"],
                    "translation": box.center.tolist(),
                    "size": box.wlh.tolist(),
                    "rotation": box.orientation.elements.tolist(),
                    "velocity": box.velocity[:2].tolist(),
                    "detection_name": name,
                    "detection_score": 0.5,
                    "attribute_name": attribute,
                }
            )
    uses = {f"use_{kind}": kind == "lidar" for kind in ("camera", "lidar", "radar", "map", "external")}
    path.write_text(json.dumps({"meta": uses, "results": results}))


def main(export: Path, detections: dict, out: Path) -> dict:
    """Return what the devkit reads, and the benchmark's measures of the detections on the scenes that validate."""
    nusc = NuScenes(version="v1.0-flcav", dataroot=str(export), verbose=False)
    nusc.list_scenes()
    samples, spin = {}, {}
    for (scene, _), (log, sample) in sorted(_samples(nusc).items()):
        spin[scene] = spin.get(scene, -1) + 1
        samples[f"{log['logfile']}_{spin[scene]:04d}_{log['vehicle']}"] = sample
    splits = {split: get_scenes_of_split(split, nusc) for split in ("flcav_train", "flcav_val")}
    validating = {
        key: sample
        for key, sample in samples.items()
        if nusc.get("scene", sample["scene_token"])["name"] in splits["flcav_val"]
    }
    out.mkdir()
    _submit(nusc, validating, detections, out / "submission.json")
    config = config_factory("detection_cvpr_2019")
    evaluation = DetectionEval(nusc, config, str(out / "submission.json"), "flcav_val", str(out), verbose=False)
    measured = evaluation.main(render_curves=False)
    return {
        "samples": {key: _read(nusc, sample) for key, sample in samples.items()},
        "splits": {name: len(scenes) for name, scenes in splits.items()},
        "mask": list(nusc.map[0]["mask"].mask().shape),
        "ap": measured["label_aps"],
        "errors": measured["label_tp_errors"],
    }


if __name__ == "__main__":
    read = main(Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text()), Path(sys.argv[3]))
    print()
    print(json.dumps(read, default=float))

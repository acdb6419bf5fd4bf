"""One valid input of each kind that commands read, small enough that every command is done in moments."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq
import yaml
from argoverse2_log import write_log
from PIL import Image
from task_drives import HEIGHT, WIDTH, Drives

import flcav.world
from flcav.dataset.formats.conversion import export
from flcav.dataset.formats.writing import ExportOptions
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.geometry import pose
from flcav.perception.road.task import ROAD
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import build_network, find_configuration
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.weights import save_network
from flcav.sensors.frame import Frame, Views
from flcav.sensors.lens import BODY_FROM_OPTICAL
from flcav.world.trace import Trace

DATA = Path(__file__).parents[1] / "data"
TOWN = Path(flcav.world.__path__[0]) / "towns" / "suburb"
SMALL_CAMERA = {"width": 64, "height": 48}
RECIPE: dict[str, Any] = {
    "town": "suburb",
    "seed": 3,
    "split": "test",
    "warmup_s": 5.0,
    "spins_per_scene": 2,
    "every_s": 0.5,
    "cavs": 1,
    "poles": [1],
    "vehicle_rig": {
        "lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 8, "azimuth_steps": 180}}},
        "cameras": {
            "camera": {"mount": {"x": 0.5, "z": 1.5, "yaw_deg": 5.0}, "trigger_ms": 20.0, "settings": SMALL_CAMERA}
        },
        "infrareds": {"thermal": {"mount": {"z": 1.6}, "settings": SMALL_CAMERA}},
        "radars": {"radar": {"mount": {"x": 2.3, "z": 0.5}}},
        "gnss": {"gnss": {"mount": {"z": 1.6}}},
        "imus": {"imu": {"mount": {"z": 0.5}}},
    },
    "pole_rig": {"lidars": {"lidar": {"settings": {"channels": 8, "azimuth_steps": 180, "down_deg": -45.0}}}},
    "weather": [{"at_s": 0.0, "weather": "clear"}, {"at_s": 0.4, "weather": {"rain_mm_h": 3.0, "cloud_cover": 0.9}}],
    "calibration_error": {"position_m": 0.02, "rotation_deg": 0.2},
    "scenarios": [{"kind": "stalled_vehicle", "at_s": 5.0, "lasts_s": 15.0, "near": "cav0"}],
}
CURVE = {"model": "additive", "floor": 0.02, "pretrain": {"a": 2.0, "b": 0.4}, "edge": {"a": 0.2, "b": 0.6, "x0": 1.0}}
UPPER = {**CURVE, "floor": 0.05}
LIMITS = {"samples": [40, 400], "edge_rounds": [0, 9], "cloud_rounds": [0, 9]}
PROBLEM: dict[str, Any] = {
    "budgets_mb": {"wireless": 900.0, "wireline": 900.0},
    "edge_rounds_per_cloud_round": 1,
    "horizon_s": 3600.0,
    "tasks": [
        {
            **{"name": "objects", "weight": 0.6, "sample_mb": 1.0, "model_mb": 5.0, "edge_groups": [2, 1]},
            **{"limits": LIMITS, "curve": CURVE, "upper": UPPER, "measured": {"samples": 300}},
            "uplink_mbps": {f"car{i}": {"wireless": 8.0 + i, "wireline": 50.0} for i in range(3)},
            "samples_held": {"car0": 200},
            "train_s": 20.0,
            "vehicle_train_s": {"car2": 30.0},
            "data_quality": {"car1": 0.8},
        },
        {
            **{"name": "signs", "weight": 0.4, "sample_mb": 0.5, "model_mb": 3.0, "edge_groups": [3], "limits": LIMITS},
            "train_s": 10.0,
            "curve": {
                **{"model": "effective", "floor": 0.0, "a": 8.0, "b": 0.6},
                **{"alpha": 0.1, "beta": 0.5, "group_samples": 700},
            },
        },
    ],
}
NETWORK = {
    "radio": {"environment": "urban", "bandwidth_mhz": 20.0, "power_dbm": 23.0, "shadowing": True},
    "wireline": {"rate_mbps": 500.0, "latency_s": 0.005},
    "rounds": {"outage_s": 0.5, "deadline_s": 30.0},
}
PROGRESS = {
    "tasks": {"objects": {"samples": 60, "edge_rounds": 1, "cloud_rounds": 0, "accuracy": 0.6}},
    "used_mb": {"wireless": 75.0, "wireline": 60.0},
}
GRAPH: dict[str, Any] = {
    "budgets_mb": {"wireless": 900.0, "wireline": 900.0},
    "horizon_s": 1800.0,
    "tasks": {
        "weather": {"network": "classifier", "weight": 0.4},
        "lights": {"network": "classifier", "weight": 0.2, "curve": UPPER},
        "objects": {"network": "detector", "weight": 0.4},
    },
    "networks": {
        "classifier": {"model_mb": 2.0, "modalities": ["camera"], "limits": LIMITS, "curve": CURVE},
        "detector": {"model_mb": 5.0, "modalities": ["lidar", "camera"], "limits": LIMITS, "curve": CURVE},
    },
    "modalities": {"camera": {"sample_mb": 0.7}, "lidar": {"sample_mb": 1.6}},
    "vehicles": {
        f"car{i}": {
            **{"edge": "west" if i < 2 else "east", "uplink_mbps": {"wireless": 9.0 + i}},
            "holds": {"camera": {}, "lidar": {"samples": 300, "quality": 0.8}},
        }
        for i in range(3)
    },
}
HISTORY = """task,stage,resource,accuracy,weight
objects,pretrain,50,0.31,1
objects,pretrain,100,0.42,1
objects,pretrain,200,0.51,2
objects,pretrain,400,0.58,1
objects,edge,1,0.60,1
objects,edge,4,0.66,1
signs,pretrain,50,0.5,1
signs,pretrain,150,0.7,1
signs,pretrain,400,0.8,1
"""
JOINT = """samples,edge_rounds,cloud_rounds,accuracy
50,0,0,0.31
100,0,0,0.42
200,0,0,0.51
400,0,0,0.58
400,1,0,0.6
400,4,1,0.66
400,4,4,0.7
"""
POLES = "id,x,y,z\n1,0,0,6\n2,30,0,6\n3,60,5,6\n4,90,-5,6\n"
KITTI_CALIBRATION = """P2: 700 0 600 45 0 700 180 0.2 0 0 1 0.003
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3
"""
KITTI_LABELS = "Car 0.00 0 1.57 520 170 640 260 1.5 1.6 4.0 0.5 1.6 12.0 1.6\n"


OPTICAL = pose(0.5, 0.0, 1.5) @ BODY_FROM_OPTICAL


class AllSensors(Drives):
    """Drives seen by every kind of sensor, so that no table of the dataset is empty."""

    def trace(self, scene: str) -> Trace | None:
        """Return the drive's traffic with the vehicle that sees it, which stands at the origin."""
        traffic = super().trace(scene)
        if traffic is None:
            return None
        twice = {
            name: np.repeat(getattr(traffic, name), 2, axis=1)
            for name in ("present", "position", "yaw", "velocity", "acceleration", "yaw_rate")
        }
        for name in ("position", "velocity"):
            twice[name][:, 1] = 0.0
        rows = {name: np.repeat(getattr(traffic, name), 2, axis=0) for name in ("category", "shape", "size")}
        return replace(traffic, actor=np.array(["veh0", "cav0"]), **twice, **rows)

    def frame(self, scene: str, index: int) -> Frame:
        """Return the drive's frame with what the other sensors measured."""
        frame = super().frame(scene, index)
        mounts = {
            "front": OPTICAL,
            "thermal": OPTICAL,
            "radar": pose(2.0, 0.0, 0.5),
            "gnss": pose(0, 0, 1.9),
            "imu": pose(0, 0, 0.4),
        }
        lens = frame.calibration.intrinsics["front"]
        calibration = replace(
            frame.calibration,
            agent_from_sensor={**frame.calibration.agent_from_sensor, **mounts},
            intrinsics={"front": lens, "thermal": lens},
            distortion={"front": np.zeros(5), "thermal": np.zeros(5)},
            offset_ms={"front": 0.0, "thermal": 10.0},
        )
        box = np.array([[20.0, 20.0, 40.0, 36.0]])
        view = Views(box, box, np.array([0]), np.zeros(1), np.ones(1))
        annotations = replace(
            frame.annotations,
            points={"top": np.array([60]), "radar": np.array([2])},
            views={"front": view, "thermal": view},
        )
        return replace(
            frame,
            calibration=calibration,
            assumed=calibration,
            annotations=annotations,
            infrared={"thermal": np.full((HEIGHT, WIDTH), 29_000, np.uint16)},
            radar={"radar": np.array([[12.0, 0.2, 0.0, 3.0, 5.0], [14.0, 0.2, 0.0, 3.0, 5.0]], np.float32)},
            gnss={"gnss": np.array([49.0, 8.4, 113.0])},
            imu={"imu": np.array([0.1, -0.2, 9.81, 0.01, 0.02, -0.03])},
            agent_at_trigger={"thermal": pose(0.1, 0.0)},
        )


def make_inputs(folder: Path) -> None:
    """Write the inputs into the new `folder`."""
    folder.mkdir(parents=True)
    record(AllSensors(spins=2), folder / "data")
    networks = {name: find_configuration(task_named(name), None) for name in TASKS}
    networks["signs"] = replace(find_configuration(SIGNS, "n"), window_px=(WIDTH, HEIGHT))
    networks["road"] = replace(find_configuration(ROAD, "tiny"), window_px=(WIDTH, HEIGHT))
    for name in TASKS:
        task = task_named(name)
        save_network(task, build_network(task, networks[name], 1), folder / "weights" / f"{name}.safetensors")
    shutil.copytree(TOWN, folder / "town")
    for name, values in (
        *(("recipe", RECIPE), ("problem", PROBLEM), ("graph", GRAPH), ("progress", PROGRESS)),
        ("network", NETWORK),
    ):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(values)), sort_keys=False))
    (folder / "graph.json").write_text(json.dumps(GRAPH))
    (folder / "elsewhere.yaml").write_text(yaml.safe_dump({**RECIPE, "town": str(folder / "town")}, sort_keys=False))
    (folder / "history.csv").write_text(HISTORY)
    (folder / "joint.csv").write_text(JOINT)
    rng = np.random.default_rng(0)
    errors = np.column_stack((rng.uniform(0, 90, 30), rng.uniform(-20, 20, 30), rng.uniform(0, 2, 30), np.ones(30)))
    rows = [",".join(f"{number:.3f}" for number in row) for row in errors]
    (folder / "errors.csv").write_text("\n".join(["x,y,z,weight", *rows]) + "\n")
    (folder / "poles.csv").write_text(POLES)
    (folder / "sensors.csv").write_text("name,range_m,cost\nshort,20,1\nlong,45,2.5\n")
    for name in ("history", "errors", "poles"):
        pq.write_table(pyarrow.csv.read_csv(folder / f"{name}.csv"), folder / f"{name}.parquet")
    shutil.copy(DATA / "cross.xodr", folder / "map.xodr")
    pixels = rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for suffix in ("png", "jpg", "webp"):
        Image.fromarray(pixels).save(folder / f"picture.{suffix}")
    shutil.copy(next((folder / "data" / "top").glob("*.bin")), folder / "cloud.bin")
    _make_kitti(folder / "real" / "training")
    write_log(folder / "argoverse2" / "val" / "log")
    for name in ("nuscenes", "opv2v"):
        export(Dataset.open(folder / "data"), name, folder / name, ExportOptions(validation=0.0))


def _make_kitti(folder: Path) -> None:
    for part in ("velodyne", "calib", "label_2", "image_2"):
        (folder / part).mkdir(parents=True)
    rng = np.random.default_rng(0)
    rng.uniform((-20, -20, -20, 0), (20, 20, 20, 1), (300, 4)).astype("<f4").tofile(folder / "velodyne" / "000000.bin")
    (folder / "calib" / "000000.txt").write_text(KITTI_CALIBRATION)
    (folder / "label_2" / "000000.txt").write_text(KITTI_LABELS)
    Image.new("RGB", (1242, 375)).save(folder / "image_2" / "000000.png")
    (folder.parent / "ImageSets").mkdir()
    (folder.parent / "ImageSets" / "train.txt").write_text("000000\n")

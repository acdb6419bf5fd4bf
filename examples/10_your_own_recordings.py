"""Your own recordings: a folder of points and JSON boxes, in the layout of Astyx HiRes2019. In the folder of this file:
flcav import 10_your_own_recordings:IMPORT ASTYX --split train --out data/train
flcav import 10_your_own_recordings:IMPORT ASTYX --split val --out data/val"""

import json
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from flcav.dataset import ImportFormat, LogSource, UsualLidar, annotate, find_rig
from flcav.geometry import transform_points, turned_boxes
from flcav.sensors import Calibration, Frame

CATEGORIES = {"Car": "car", "Bus": "bus", "Truck": "truck", "Person": "pedestrian", "Cyclist": "bicycle"}
USUAL = UsualLidar("the usual", height_m=1.73)  # where the sweeps show no ground
GAP_S, VALIDATION = 3.0, 0.25  # longest time between frames of a scene; share of the scenes
VEHICLES = 4  # that the drive is shared among, scene by scene: the clients of a federation


class Recordings(LogSource):
    FORMAT = "astyx"
    labelled = True  # all frames have boxes

    def __init__(self, folder, split, stated):  # `stated`: by --lidar-height and --beams
        self.folder, self.split = folder, split
        files = sorted((folder / "lidar_vlp16").glob("*.txt"))
        times = [time_of(path) for path in files]
        starts = [0, *(i + 1 for i, (a, b) in enumerate(pairwise(times)) if b - a > GAP_S), len(files)]
        scenes = [list(zip(files[a:b], times[a:b])) for a, b in pairwise(starts)]
        last = len(scenes) - max(1, round(VALIDATION * len(scenes)))
        self.shots = {f"drive-{i:03d}": shots for i, shots in enumerate(scenes)}
        splits = {scene: "val" if i >= last else "train" for i, scene in enumerate(self.shots)}
        self.split_of = {scene: name for scene, name in splits.items() if split in (None, name)}
        self.rig = find_rig(files, read_points, stated, USUAL)  # height and tilt above the ground, by the sweeps
        self.beams, self.notes = self.rig.beams, self.rig.notes

    def frame_count(self, scene):
        return len(self.shots[scene])

    def frames(self, scene):
        mount, world = self.rig.agent_from_lidar, np.eye(4)  # poses are unknown: the world is each frame's vehicle
        calibration, vehicle = Calibration({"lidar": mount}), f"car{[*self.shots].index(scene) % VEHICLES}"
        for index, (path, time_s) in enumerate(self.shots[scene]):
            points = read_points(path)
            boxes = read_boxes(folder_of(path) / "groundtruth_obj3d" / f"{path.stem}.json").transform(mount)
            tracks = [f"{path.stem}-{row}" for row in range(len(boxes))]  # no object is followed
            yield Frame(
                scene, index, time_s - self.shots[scene][0][1], vehicle, world, calibration, calibration,
                lidar={"lidar": points}, annotations=annotate(tracks, boxes, {"lidar": (points, mount)}, {}),
            )  # fmt: skip


def read_points(path):  # (N, 4) x ahead, y left, z up [m], intensity 0 to 1, in the frame of the boxes: the radar's
    rows = np.loadtxt(path, skiprows=1, ndmin=2)  # X Y Z Reflectivity LaserID Timestamp
    sensors = json.loads((folder_of(path) / "calibration" / f"{path.stem}.json").read_text())["sensors"]
    (pose,) = (each["calib_data"]["T_to_ref_COS"] for each in sensors if each["sensor_uid"] == "lidar_vlp16")
    return np.column_stack((transform_points(np.array(pose), rows[:, :3]), rows[:, 3] / 255)).astype(np.float32)


def read_boxes(path):
    objects = json.loads(path.read_text())["objects"]
    center, size = (np.array([row[name] for row in objects]).reshape(-1, 3) for name in ("center3d", "dimension3d"))
    quaternions = np.array([row["orientation_quat"] for row in objects]).reshape(-1, 4)[
        :, [1, 2, 3, 0]
    ]  # of w, x, y, z
    rotation = Rotation.from_quat(quaternions).as_matrix() if objects else np.zeros((0, 3, 3))
    label = [CATEGORIES.get(row["classname"], row["classname"].lower().replace(" ", "_")) for row in objects]
    return turned_boxes(center, size, rotation, np.array(label, np.str_))  # upright where none leans


def time_of(path):  # [s], of the sweep's first point
    with path.open() as file:
        return float(file.readlines(4096)[1].split()[5]) / 1e6


def folder_of(path):
    return path.parents[1]


IMPORT = ImportFormat(Recordings, signs=("lidar_vlp16/*.txt",), takes_lidar=True)

"""Compare labels by tracks of a real drive with those that people made: precision, recall, size, heading, by distance.

DATASET is an imported drive with poses, such as `flcav import kitti-tracking DIR --estimate-poses --out DATASET`.
Labels are those that a vehicle gives its own frames after the drive, from the sweeps within a second, by the packaged
detector or by --weights. A label is right that matches a target at IoU 0.5 in 3D; targets are labelled objects in the
network's range with five returns or more. Only what the camera shows is counted, since people labelled nothing else.
Errors are medians over right labels: of length and width [m], and of the heading [degrees], of which more than 90 are
the wrong way round.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from flcav.arrays import Array, Mask
from flcav.dataset.formats.kitti.files import ASSUMED_SIZE
from flcav.dataset.store import Dataset
from flcav.fusion.tracks import LEAST_SCORE, VehicleSweep, track_objects
from flcav.geometry import Boxes, inverse, transform_points, wrap_angle
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.networks import resolve_network
from flcav.perception.objects.evaluate import count_objects
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import LOWEST_SCORE, detect_in
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth, asked_of, choose_lidar, in_range
from flcav.runs.labels.tracks import WINDOW_EVERY_S, WINDOW_S
from flcav.sensors.frame import Frame
from flcav.storage.markdown import format_table

OVERLAP = 0.5


def main() -> None:
    """Label the frames of a drive, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATASET")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--threshold", type=float, default=0.3, help="lowest score of a label")
    asked = parser.parse_args()
    use_threads(1)
    data, network = Dataset.open(asked.data), resolve_network(OBJECTS, asked.weights)
    sweeps = [read_sweep(network, data.frame(i)) for i in range(len(data))]
    labels, truths = list[Boxes](), list[FrameTruth]()
    for i in range(len(data)):
        frame = data.frame(i)
        labels.append(label_frame(sweeps, frame, network, asked.threshold))
        truths.append(asked_of(frame, network.config))
    scenes = len({key.scene for key in data.keys})
    print(
        format_table(("class", "distance", "labels", "precision", "objects", "recall", *ERRORS), rate(labels, truths))
    )
    print(f"{len(data)} frames of {plural(scenes, 'scene')}, labels from a score of {asked.threshold:g}")


ERRORS = ("length, m", "width, m", "heading, deg", "wrong way round")


def read_sweep(network: Second, frame: Frame) -> VehicleSweep:
    """Return a frame's sweep with the detections of `network`, world frame."""
    lidar = choose_lidar(frame)
    world_from_lidar = frame.world_from_sensor(lidar)
    (found,) = detect_in(network, [frame], score_threshold=LOWEST_SCORE)
    points = transform_points(world_from_lidar, frame.lidar[lidar][:, :3].astype(np.float64))
    return VehicleSweep(frame.time_s, found.transform(world_from_lidar), points, world_from_lidar[:3, 3])


def label_frame(sweeps: list[VehicleSweep], frame: Frame, network: Second, threshold: float) -> Boxes:
    """Return the labels of a frame by tracks through the sweeps around it, in the frame of its LiDAR."""
    steps = [(sweep.time_s - frame.time_s) / WINDOW_EVERY_S for sweep in sweeps]
    within = WINDOW_S / WINDOW_EVERY_S + 0.1
    window = [s for s, step in zip(sweeps, steps, strict=True) if abs(step) < within and abs(step - round(step)) < 0.1]
    tracks = track_objects(window, frame.time_s, least=max(LEAST_SCORE, threshold))
    tracks = tracks.transform(inverse(frame.world_from_sensor(choose_lidar(frame))))
    return tracks[in_range(tracks, network.config) & is_shown(tracks, frame)]


def is_shown(boxes: Boxes, frame: Frame) -> Mask:
    """Return the mask (N,) of boxes, LiDAR frame, whose centre the first camera of the frame's calibration shows."""
    camera, matrix = next(iter(frame.calibration.intrinsics.items()))
    camera_from_lidar = inverse(frame.agent_from_sensor[camera]) @ frame.agent_from_sensor[choose_lidar(frame)]
    x, y, depth = (matrix @ transform_points(camera_from_lidar, boxes.center).T).reshape(3, -1)
    height, width = ASSUMED_SIZE
    ahead = np.maximum(depth, 1e-6)
    return (depth > 0) & (x / ahead >= 0) & (x / ahead < width) & (y / ahead >= 0) & (y / ahead < height)


def rate(labels: list[Boxes], truths: list[FrameTruth]) -> list[list[str | float]]:
    """Return the rows of the table, by class and distance from the LiDAR."""
    sure = [replace(boxes, score=np.ones(len(boxes))) for boxes in labels]
    classes = sorted({str(label) for truth in truths for label in truth.targets.label})
    rows = list[list[str | float]]()
    for each in count_objects(sure, truths, classes):
        low, high = each.distance_m
        errors = np.concatenate([_errors(*pair, each.label, low, high) for pair in zip(labels, truths, strict=True)])
        told = each.found + round(each.false_a_frame * len(truths))
        named = [f"{value:.2f}" for value in np.median(errors[:, :2], axis=0)] if len(errors) else ["", ""]
        turned = [f"{np.median(errors[:, 2]):.1f}", f"{np.mean(errors[:, 2] > 90):.0%}"] if len(errors) else ["", ""]
        precision, recall = (f"{each.found / count:.2f}" if count else "" for count in (told, each.targets))
        rows.append([each.label, f"{low:g} to {high:g} m", told, precision, each.targets, recall, *named, *turned])
    return rows


def _errors(found: Boxes, truth: FrameTruth, label: str, low_m: float, high_m: float) -> Array:
    """Return the errors (N, 3) of length and width [m] and heading [degrees] of right labels at a distance."""
    found, targets = (boxes[boxes.label == label] for boxes in (found, truth.targets))
    target = assign_targets(found, targets, OVERLAP)
    right = np.flatnonzero(target >= 0)
    away = np.hypot(*targets.center[target[right], :2].T)
    right = right[(away >= low_m) & (away < high_m)]
    size = np.abs(found.size[right] - targets.size[target[right]])[:, :2]
    turned = np.degrees(np.abs(wrap_angle(found.yaw[right] - targets.yaw[target[right]])))
    return np.column_stack((size, turned))


if __name__ == "__main__":
    main()

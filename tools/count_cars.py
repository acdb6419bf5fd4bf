"""Count the cars that networks find and invent: `python tools/count_cars.py DATA WEIGHTS...`.

Every sweep is looked at four times, turned by quarters. In each view the cars asked for are those within 40 m with 20
returns or more; a detection with a score of 0.3 or more finds the car that it overlaps most, at a bird's-eye IoU of 0.5
or more, and is false where there is none, unless it touches a truck or bus.
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, pose
from flcav.perception.metrics.operating_point import OVERLAP, SCORE, WITHIN_M
from flcav.perception.networks import resolve_network
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect
from flcav.perception.objects.samples import move_points
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import (
    QUARTERS,
    GroundTruth,
    choose_lidar,
    ground_truth,
    in_range,
    network_from_lidar,
)
from flcav.perception.ops.boxes import iou
from flcav.sensors.frame import Frame

RETURNS, TOUCH = 20, 0.1


@dataclass
class Count:
    """Cars asked for, found and invented in a number of views, and detections of other classes."""

    views: int = 0
    asked: int = 0
    found: int = 0
    false: int = 0
    others: int = 0

    def __str__(self) -> str:
        each = f"{self.false / self.views:.2f} false cars and {self.others / self.views:.2f} others a view"
        return f"{self.found} of {self.asked} cars found, {each}, {self.views} views"


def count_cars(network: Second, frames: list[Frame]) -> Count:
    """Return the count of a network over the frames of vehicles."""
    total = Count()
    for frame in frames:
        truth, move = ground_truth(frame, network.config), network_from_lidar(frame, network.config)
        cloud = move_points(frame.lidar[choose_lidar(frame)], move)
        boxes = truth.boxes if move is None else truth.boxes.transform(move)
        for turns in range(QUARTERS):
            turn = pose(0, 0, yaw=-turns * math.pi / 2)
            seen = detect(network, move_points(cloud, turn), score_threshold=SCORE)
            _add(total, seen, boxes.transform(turn), truth, network)
    return total


def _add(total: Count, seen: Boxes, boxes: Boxes, truth: GroundTruth, network: Second) -> None:
    """Add a view: its detections `seen`, and the objects `boxes` in the order of `truth`."""
    near = seen[(seen.label == "Car") & (_away(seen) < WITHIN_M)]
    order = np.argsort(-np.asarray(near.score), kind="stable") if len(near) else []
    overlaps = iou(torch.from_numpy(near.array()), torch.from_numpy(boxes.array()), "bev").numpy()
    car = (boxes.label == "Car") & ~truth.lookalike
    taken = np.zeros(len(boxes), bool)
    for row in order:
        free = np.where(car & ~taken, overlaps[row], 0.0)
        if len(free) and free.max() >= OVERLAP:
            taken[free.argmax()] = True
        elif not (overlaps[row][truth.lookalike] > TOUCH).any():
            total.false += 1
    asked = car & in_range(boxes, network.config) & (_away(boxes) < WITHIN_M) & (truth.returns >= RETURNS)
    total.views += 1
    total.asked += int(asked.sum())
    total.found += int((asked & taken).sum())
    total.others += int((seen.label != "Car").sum())


def _away(boxes: Boxes) -> NDArray[np.float64]:
    return np.hypot(boxes.center[:, 0], boxes.center[:, 1])


def main() -> None:
    """Print the count of each network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="every so many frames")
    arguments = parser.parse_args()
    data = Dataset.open(arguments.data)
    frames = [data.frame(number) for number in range(0, len(data), arguments.every)]
    for weights in arguments.weights:
        print(f"{weights}: {count_cars(resolve_network(OBJECTS, weights), frames)}")


if __name__ == "__main__":
    main()

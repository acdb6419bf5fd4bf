"""Say why cars are missed and invented: `python tools/explain_cars.py DATA [WEIGHTS]`.

The cars are those of `flcav evaluate objects --around`: within 40 m, with five returns or more, each once a sweep,
found at a bird's-eye IoU of 0.5 with a score of 0.3 or more. Printed are those found by their returns, what stands
against each missed car, what is below each false one, and both counts at other scores.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, points_in_boxes
from flcav.perception.metrics.detection import assign_targets, on_neutral
from flcav.perception.metrics.operating_point import OVERLAP, SCORE, is_near
from flcav.perception.networks import resolve_network
from flcav.perception.objects.predict import detect_in, look_around
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import QUARTERS, asked_of, choose_lidar
from flcav.perception.ops.boxes import iou

LOWEST = 0.02  # score of the faintest detections that are looked at
DOUBLE = 0.9  # IoU from which two labels are one car's
TOUCH = 0.1  # IoU from which two boxes have to do with each other
SCORES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
RETURNS = (5, 20, 50, 200, 10**9)

NOT_SEEN, FAINT, OTHERWISE, MISPLACED = (
    "no detection",
    "score below 0.3",
    "another class",
    "box overlaps by less than 0.5",
)
TWICE = "labelled twice, found once"
NOTHING, SECOND = "nothing labelled", "a car, with another box"


def overlaps(boxes: Boxes, others: Boxes) -> NDArray[np.float64]:
    """Return the bird's-eye IoU (N, M) of boxes with others."""
    return iou(torch.from_numpy(boxes.array()), torch.from_numpy(others.array()), "bev").numpy()


def explain_missed(seen: Boxes, cars: Boxes) -> list[str]:
    """Return what stands against each of the `cars` within 40 m that no detection finds; "" for one found.

    `seen` are detections of all classes with scores of `LOWEST` or more. A car beyond 40 m may take a detection.
    """
    kept = seen[(seen.label == "Car") & (np.asarray(seen.score) >= SCORE)]
    taken = assign_targets(kept, cars, OVERLAP, "bev")
    same = overlaps(cars, cars) >= DOUBLE
    share, score, car = overlaps(seen, cars), np.asarray(seen.score)[:, None], (seen.label == "Car")[:, None]
    reasons = []
    for row in np.flatnonzero(is_near(cars)):
        fits, near = share[:, row, None] >= OVERLAP, share[:, row, None] >= TOUCH
        if row in taken:
            reasons.append("")
        elif same[row, taken[taken >= 0]].any():
            reasons.append(TWICE)
        elif (near & car & (score >= SCORE)).any():
            reasons.append(MISPLACED)
        elif (fits & car).any():
            reasons.append(FAINT)
        else:
            reasons.append(OTHERWISE if (near & ~car & (score >= SCORE)).any() else NOT_SEEN)
    return reasons


def explain_false(seen: Boxes, cars: Boxes, neutral: Boxes, others: Boxes) -> list[str]:
    """Return what is below each false car within 40 m, of the detections of class Car with a score of 0.3 or more.

    That is the most frequent class of the `others` that it touches, or else a car.
    """
    kept = seen[(seen.label == "Car") & (np.asarray(seen.score) >= SCORE)]
    false = kept[(assign_targets(kept, cars, OVERLAP, "bev") < 0) & is_near(kept) & ~on_neutral(kept, neutral)]
    out = []
    for on_cars, on_others in zip(overlaps(false, cars), overlaps(false, others)):
        below = Counter(others.label[on_others > 0].tolist()).most_common(1)
        out.append(below[0][0] if below else SECOND if (on_cars >= TOUCH).any() else NOTHING)
    return out


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path, nargs="?")
    asked = parser.parse_args()
    data, network = Dataset.open(asked.data), look_around(resolve_network(OBJECTS, asked.weights))
    frames = [data.frame(number) for number in range(len(data))]
    found = detect_in(network, frames, score_threshold=LOWEST)
    missed, false, counts = Counter[str](), Counter[str](), {score: [0, 0] for score in SCORES}
    by_returns = np.zeros((len(RETURNS) - 1, 2), np.int64)
    for frame, seen in zip(frames, found, strict=True):
        truth = asked_of(frame, network.config)
        cars = _of(truth.targets, "Car", True)
        labelled = frame.annotations.boxes.transform(inverse(frame.world_from_sensor(choose_lidar(frame))))
        others = _of(labelled, "car", False)
        neutral, near = _of(truth.neutral, "Car", True), cars[is_near(cars)]
        points = frame.lidar[choose_lidar(frame)][:, :3].astype(np.float64)
        inside = np.array([points_in_boxes(points, near[[i]]).sum() for i in range(len(near))])
        reasons = explain_missed(seen, cars)
        missed.update(reason for reason in reasons if reason)
        false.update(explain_false(seen, cars, neutral, others))
        row = np.searchsorted(RETURNS, inside, side="right") - 1
        for part, reason in zip(row.tolist(), reasons):
            by_returns[max(part, 0)] += (1, not reason)
        for score, count in counts.items():
            own = seen[(seen.label == "Car") & (np.asarray(seen.score) >= score)]
            matched = assign_targets(own, cars, OVERLAP, "bev")
            count[0] += int(is_near(cars)[matched[matched >= 0]].sum())
            count[1] += int(((matched < 0) & is_near(own) & ~on_neutral(own, neutral)).sum())
    total = int(by_returns[:, 0].sum())
    print(f"{total} cars, {total - missed.total()} found")
    for low, high, (of, hit) in zip(RETURNS, RETURNS[1:], by_returns):
        print(f"  of {low} returns or more, below {high}: {hit} of {of}")
    _tell("missed", missed)
    _tell("false", false)
    for score, (hit, wrong) in counts.items():
        print(f"score {score:g}: found {hit}, false {wrong / (len(frames) * QUARTERS):.2f} a quarter turn")


def _of(boxes: Boxes, label: str, same: bool) -> Boxes:
    return boxes[(boxes.label == label) == same]


def _tell(name: str, counts: Counter[str]) -> None:
    told: Sequence[str] = [f"{count} {reason}" for reason, count in counts.most_common()]
    print(f"{name} {counts.total()}: {', '.join(told)}")


if __name__ == "__main__":
    main()

"""Shadow runs: a candidate runs beside the driving network on a vehicle, without labels, and their boxes are compared.

Disagreement is 1 minus the Dice coefficient of the two sets of detections: 1 - 2 agreed / (driving + candidate). Two
detections agree where they are of one class and overlap by a BEV IoU of 0.5 at least. The candidate's boxes are used
for nothing else.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from flcav.config import InputError, read_json
from flcav.federation.messages.release_report import ShadowReport
from flcav.geometry import Boxes
from flcav.interface.wording import plural
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import select_class
from flcav.sensors.frame import Frame

OVERLAP = 0.5
LIMIT = 0.4  # of the mean disagreement over vehicles
LEVEL = 0.05  # one-sided
Judgement = Literal["go on", "wait", "stop"]


@dataclass(frozen=True)
class ShadowDecision:
    """What follows from the shadow runs of several vehicles."""

    judgement: Judgement
    vehicles: int
    mean: float  # disagreement
    low: float  # one-sided bounds at .05, over vehicles
    high: float

    def describe(self) -> str:
        """Return the decision in words."""
        over = f"over {plural(self.vehicles, 'vehicle')}"
        found = f"{self.mean:.3f} ({self.low:.3f} to {self.high:.3f})"
        return f"{self.judgement}: disagreement {found} {over}, limit {LIMIT:g}"


def run_shadow(
    vehicle: str, frames: Iterable[Frame], driving: tuple[Second, str], candidate: tuple[Second, str]
) -> ShadowReport:
    """Return the shadow run of a vehicle on its frames; both networks come with the SHA-256 of their weights."""
    counts = np.zeros(4, np.int64)
    for frame in frames:
        (old,), (new,) = (detect_in(each, [frame], score_threshold=THRESHOLD) for each, _ in (driving, candidate))
        counts += (1, len(old), len(new), count_agreed(old, new))
    number, before, after, agreed = counts.tolist()
    return ShadowReport(vehicle, "objects", driving[1], candidate[1], number, before, after, agreed)


def read_shadow(path: Path) -> ShadowReport:
    """Return the shadow run in a JSON file; raises `InputError` where there is none, or its numbers cannot be."""
    found = ShadowReport.from_json(read_json(path), str(path))
    try:
        found.check()
    except ValueError as error:
        raise InputError(f"{path}: no shadow run: {error}") from None
    return found


def count_agreed(first: Boxes, second: Boxes) -> int:
    """Return how many detections of two networks agree, each matched once."""
    labels = set(first.label.tolist()) & set(second.label.tolist())
    pairs = ((select_class(first, label), select_class(second, label)) for label in sorted(labels))
    return sum(int((assign_targets(one, other, OVERLAP, "bev") >= 0).sum()) for one, other in pairs)


def judge_shadows(reports: Sequence[ShadowReport], limit: float = LIMIT) -> ShadowDecision:
    """Return whether a roll-out goes on: its canaries' mean disagreement lies below the limit, at .05.

    It stops where the mean lies above the limit, and waits for more vehicles where neither is told. Bounds are
    Student's t over vehicles. Raises `InputError` for no reports, of different networks, and for a vehicle that
    reports twice.
    """
    reports = [each for each in reports if each.frames]  # who met nothing tells nothing
    if not reports:
        raise InputError("no shadow run of any frame: at least two vehicles' are wanted")
    if len({(each.driving, each.candidate) for each in reports}) > 1:
        raise InputError("the shadow runs are of different networks")
    if len({each.vehicle for each in reports}) < len(reports):
        raise InputError("a vehicle reports its shadow run twice")
    values = np.array([each.disagreement for each in reports])
    mean, number = float(values.mean()), len(values)
    if number < 2:
        return ShadowDecision("stop" if mean > limit else "wait", number, mean, 0.0, 1.0)
    half = float(stdtrit(number - 1, 1 - LEVEL)) * float(values.std(ddof=1)) / float(np.sqrt(number))
    low, high = max(mean - half, 0.0), min(mean + half, 1.0)
    judgement: Judgement = "stop" if low > limit else "go on" if high < limit else "wait"
    return ShadowDecision(judgement, number, mean, low, high)

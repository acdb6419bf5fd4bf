"""Stages of a roll-out: canaries first, then larger shares while shadow runs agree, else stop and roll-back.

In a shadow run a vehicle runs the candidate on its sensor frames, and its detections are compared with those of the
driving network. A roll-back is a new release: earlier weights under a higher number, so that no vehicle ever accepts an
older number, even a signed one.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from flcav.config import InputError, parse_config, read_json
from flcav.fleet.releases import ShadowReport
from flcav.geometry import Boxes
from flcav.interface.wording import plural
from flcav.perception.errors import THRESHOLD
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import select_class
from flcav.releases.candidate import (
    ACKNOWLEDGEMENTS,
    CANDIDATE,
    REPORT,
    Candidate,
    check_files,
    read_candidate,
)
from flcav.releases.repositories.metadata import MILLION, Directive, load_targets, read_directives
from flcav.releases.repositories.repository import StagedTargets, stage_directive
from flcav.releases.rollout.simulated_fleet import Delivered
from flcav.sensors.frame import Frame
from flcav.storage.files import write_json
from flcav.storage.records import Record

OVERLAP = 0.5  # lowest IoU in bird's-eye view of agreeing detections
LIMIT = 0.4  # of the mean disagreement over vehicles
LEVEL = 0.05  # one-sided
Judgement = Literal["go on", "wait", "stop"]


@dataclass(frozen=True)
class ShadowDecision:
    """The decision on a roll-out by the shadow runs of several vehicles."""

    judgement: Judgement
    vehicles: int
    mean: float  # disagreement, in [0, 1]
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
    """Return the shadow run of a vehicle on its frames; networks are given with the SHA-256 of their weights."""
    counts = np.zeros(4, np.int64)
    for frame in frames:
        (old,), (new,) = (detect_in(each, [frame], score_threshold=THRESHOLD) for each, _ in (driving, candidate))
        counts += (1, len(old), len(new), count_agreed(old, new))
    number, before, after, agreed = counts.tolist()
    return ShadowReport(vehicle, "objects", driving[1], candidate[1], number, before, after, agreed)


def read_shadow(path: Path) -> ShadowReport:
    """Return the shadow run in a JSON file; raises `InputError` if there is none, or its numbers are impossible."""
    found = ShadowReport.from_json(read_json(path), str(path))
    try:
        found.check()
    except ValueError as error:
        raise InputError(f"{path}: no shadow run: {error}") from None
    return found


def count_agreed(first: Boxes, second: Boxes) -> int:
    """Return the number of detections on which two networks agree, matched one to one."""
    labels = set(first.label.tolist()) & set(second.label.tolist())
    pairs = ((select_class(first, label), select_class(second, label)) for label in sorted(labels))
    return sum(int((assign_targets(one, other, OVERLAP, "bev") >= 0).sum()) for one, other in pairs)


def judge_shadows(reports: Sequence[ShadowReport], limit: float = LIMIT) -> ShadowDecision:
    """Return the decision on a roll-out: it goes on if its canaries' mean disagreement is below the limit, at .05.

    It stops if the mean is above the limit, at .05, and waits for more vehicles otherwise. Bounds are Student's t over
    vehicles. Raises `InputError` for no reports, reports on different networks, and two reports of one vehicle.
    """
    reports = [each for each in reports if each.frames]  # without frames there is no evidence
    if not reports:
        raise InputError("no shadow run of any frame: at least two vehicles' are wanted")
    if len({(each.driving, each.candidate) for each in reports}) > 1:
        raise InputError("the shadow runs are of different networks")
    if len({each.vehicle for each in reports}) < len(reports):
        raise InputError("a vehicle reports its shadow run twice")
    values = np.array([each.disagreement for each in reports])
    mean = float(values.mean())
    number = len(values)
    if number < 2:
        return ShadowDecision("stop" if mean > limit else "wait", number, mean, 0.0, 1.0)
    # the disagreement is in [0, 1], and so are its bounds
    half = float(stdtrit(number - 1, 1 - LEVEL)) * float(values.std(ddof=1)) / float(np.sqrt(number))
    low, high = max(mean - half, 0.0), min(mean + half, 1.0)
    judgement: Judgement = "stop" if low > limit else "go on" if high < limit else "wait"
    return ShadowDecision(judgement, number, mean, low, high)


STAGES = (0.01, 0.05, 0.2, 1.0)  # shares of the fleet


def read_directive(out: Path, task: str) -> Directive:
    """Return the customer's directive on a task; raises `InputError` if there is none."""
    found = read_directives(load_targets(out).signed.targets).get(task)
    if found is None:
        raise InputError(f"{out}: has no directive on {task}, so is not the customer's repository, or names no release")
    return found


def next_share(share: float, decision: ShadowDecision) -> float:
    """Return the next share of the fleet: the next of `STAGES`, the same one while the decision is to wait, or 0.

    0 stops the roll-out; vehicles that have the release keep it until a roll-back.
    """
    if decision.judgement == "stop":
        return 0.0
    if decision.judgement == "wait":
        return share
    return next((stage for stage in STAGES if stage > share), 1.0)


def change_share(
    out: Path, task: str, share: float, keys: Sequence[Path], revoke: Sequence[str] = ()
) -> tuple[Directive, StagedTargets]:
    """Stage a directive with another share of the fleet, and further revoked vehicles; return it and its signatures.

    A share of 0 also stops the roll-out for vehicles assigned by name.
    """
    now = read_directive(out, task)
    revoked = tuple(sorted({*now.revoked, *revoke}))
    named = now.vehicles if share else ()
    updates = {"share_ppm": round(share * MILLION), "revoked": revoked, "vehicles": named}
    changed = parse_config(Directive, now.model_dump() | updates, "the directive")
    return changed, stage_directive(out, task, changed, keys)


def roll_back(earlier: Path, release: int, reason: str, out: Path, driving: str) -> Candidate:
    """Write the candidate of a roll-back to `out`: the weights of an earlier release under a higher number.

    Its verification is that of the earlier candidate; it needs new acknowledgements.

    Args:
        earlier: folder of the candidate whose weights will drive again.
        release: number of the roll-back, above all earlier ones.
        reason: in words.
        out: the new folder.
        driving: SHA-256 of the weights that it replaces.

    Raises:
        InputError: for a folder that exists, a damaged candidate, and a number that is not above the earlier one's.
    """
    candidate = read_candidate(earlier)
    check_files(earlier, candidate)
    if release <= candidate.release:
        raise InputError(f"release {release}: a roll-back has a number above {candidate.release}, and all others")
    if out.exists():
        raise InputError(f"{out}: exists already; a candidate is a new folder")
    changes = f"Roll-back to release {candidate.release}. {reason}"
    updates = {"release": release, "changes": changes, "driving": driving, "rolls_back": candidate.release}
    changed = parse_config(Candidate, candidate.model_dump() | updates, f"release {release}")
    shutil.copytree(earlier, out, ignore=shutil.ignore_patterns(ACKNOWLEDGEMENTS, REPORT))
    write_json(out / CANDIDATE, changed.model_dump(mode="json"), sort=False)
    return changed


@dataclass(frozen=True)
class Turn:
    """One turn of a roll-out: a share of the fleet, deliveries, and the decision by shadow runs."""

    release: int
    share: float
    assigned: int  # number of vehicles in the share
    reached: int  # number of these that have the release at the end of the turn
    arrivals: tuple[Delivered, ...]  # times from the start of the vehicle's drive, or of the turn [s]
    wireless_mb: float  # downlink [MB]
    wireline_mb: float | None  # downlink [MB]; None: not counted
    decision: ShadowDecision | None  # None without shadow runs

    def describe(self) -> str:
        """Return the turn in words."""
        times = sorted(each.at_s for each in self.arrivals if each.at_s is not None)
        after = (
            f", {len(times)} now, half of these by {np.median(times):.2f} s, all by {times[-1]:.2f} s" if times else ""
        )
        wireline = "" if self.wireline_mb is None else f", {self.wireline_mb:.2f} MB wireline"
        said = f"; {self.decision.describe()}" if self.decision is not None else ""
        return (
            f"release {self.release}, {self.share:.0%} of the fleet: reaches {self.reached} of "
            f"{plural(self.assigned, 'vehicle')}{after}; {self.wireless_mb:.2f} MB wireless{wireline}{said}"
        )


@dataclass(frozen=True)
class Rollout(Record):
    """The outcome of a roll-out: stopped or not, its turns, and the numbers of vehicles by release at its end."""

    stopped: bool
    complete: bool  # every vehicle drives the new release, or after a stop the earlier weights
    turns: tuple[Turn, ...]
    drive: Mapping[int, int]  # number of vehicles by driving release

    def lines(self) -> list[str]:
        """Return the roll-out in words."""
        held = ", ".join(
            f"{f'release {release}' if release else 'no release'}: {plural(count, 'vehicle')}"
            for release, count in self.drive.items()
        )
        end = "complete" if self.complete else "not complete"
        if self.stopped:
            end = "stopped and rolled back" if self.turns[-1].release > self.turns[0].release else "stopped"
        return [*(turn.describe() for turn in self.turns), f"{end}; in the end {held}"]

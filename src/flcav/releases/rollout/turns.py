"""Turns of a roll-out, on a simulated or a deployed fleet: deliveries, and results of shadow runs."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flcav.interface.wording import plural
from flcav.releases.rollout.delivery import Delivered
from flcav.releases.rollout.shadow import ShadowDecision
from flcav.storage.records import Record


@dataclass(frozen=True)
class Turn:
    """One turn: a share of the fleet, the deliveries to it, and the results of the shadow runs."""

    release: int
    share: float
    assigned: int  # vehicles of the share
    reached: int  # of these, have the release by the end of the turn
    arrivals: tuple[Delivered, ...]  # seconds from the beginning of the vehicle's drive, or of the turn
    wireless_mb: float
    wireline_mb: float | None  # None: not counted
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
    """What became of a roll-out: stopped or not, its turns, and how many vehicles drive which release in the end."""

    stopped: bool
    complete: bool  # every vehicle drives the new release, or after a stop the earlier weights
    turns: tuple[Turn, ...]
    drive: Mapping[int, int]  # release -> vehicles

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

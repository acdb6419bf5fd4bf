"""Records of lifelong learning: scores, transfer, bytes and times of each arm."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from flcav.interface.wording import plural
from flcav.statistics.transfer import compute_backward_transfer, compute_final_mean, compute_forward_transfer
from flcav.storage.records import LEFT_OUT, Record


@dataclass(frozen=True)
class Passed(Record):
    """A condition that the fleet of an arm has passed."""

    condition: str
    asked: tuple[str, ...]  # vehicles that sent a request
    members: int
    rounds: int
    replaced: bool  # whether a new network took the driving one's place
    scores: Mapping[str, tuple[float, ...]]  # on validation frames of this and each earlier condition: before the
    # first round, and after each, of the network that the rounds would end with
    reachable: float  # on validation frames of this condition, by a network of its own from the pretrained one
    recorded_s: float  # as in `Driving`
    learned_s: float | None  # from the beginning of the condition until a copy is mended; None: none is, or no clock
    mended_s: float | None  # until one drives that is; 0: it was never worse
    up_bytes: int  # uplink: requests, offers, updates, losses
    down_bytes: int  # downlink: rounds, and the new network to all vehicles
    rounds_s: Annotated[tuple[float, ...] | None, LEFT_OUT] = None  # of each round by the clock; None: no network


@dataclass(frozen=True)
class LifelongArm(Record):
    """Lifelong learning in one arm: replay, no replay, or nothing."""

    arm: str
    task: str
    measure: str
    conditions: tuple[str, ...]
    tested: tuple[tuple[float, ...], ...]  # on test frames, of the network that drives: a column per condition; in row
    # 0 the pretrained network, in row i that after condition i
    passed: tuple[Passed, ...]
    final: float  # mean over all conditions after the last
    backward: float  # see `flcav.statistics.transfer`
    forward: float

    @classmethod
    def of(
        cls,
        arm: str,
        task: str,
        measure: str,
        tested: tuple[tuple[float, ...], ...],
        passed: tuple[Passed, ...],
    ) -> "LifelongArm":
        """Build the record, computing final mean, backward and forward transfer from its scores."""
        found = (compute_final_mean(tested), compute_backward_transfer(tested), compute_forward_transfer(tested))
        return cls(arm, task, measure, tuple(each.condition for each in passed), tested, passed, *found)

    @property
    def up_bytes(self) -> int:
        """Return the uplink of all conditions."""
        return sum(each.up_bytes for each in self.passed)

    @property
    def down_bytes(self) -> int:
        """Return the downlink of all conditions."""
        return sum(each.down_bytes for each in self.passed)

    @property
    def broken(self) -> tuple[Passed, ...]:
        """Return the conditions in which the deployed network was below the required score when they began."""
        return tuple(each for each in self.passed if each.learned_s != 0)

    @property
    def mended(self) -> tuple[float, ...]:
        """Return the time [s] until a network of the required score drives, for conditions of `broken` with one."""
        return tuple(each.mended_s for each in self.broken if each.mended_s is not None)

    def describe(self) -> str:
        """Return the arm in words."""
        told = [
            f"{self.arm}: {self.measure} {self.final:.3f} in the mean of {plural(len(self.conditions), 'condition')}",
            f"backward transfer {self.backward:+.3f}, forward {self.forward:+.3f}",
            f"{self.up_bytes / 1e6:.1f} MB up, {self.down_bytes / 1e6:.1f} MB down",
        ]
        mended = f"{len(self.mended)} of {plural(len(self.broken), 'condition')} with errors mended"
        if self.mended:
            mended += f", after {' and '.join(f'{each:.0f} s' for each in self.mended)}"
        return "; ".join([*told, mended])


@dataclass(frozen=True)
class LifelongRow:
    """What lifelong learning adds to the results of a run."""

    lifelong: Annotated[tuple[LifelongArm, ...] | None, LEFT_OUT] = None  # of each task and arm; None: not asked for

"""Records of lifelong learning: scores, transfer, bytes and times by arm."""

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
    replaced: bool  # whether a new network replaced the deployed one
    scores: Mapping[str, tuple[float, ...]]  # on validation frames, by this and earlier conditions: before the first
    # round, and after every round, of the network that the rounds would end with
    reachable: float  # score on validation frames of this condition after stage II in it, from the pretrained network
    recorded_s: float  # time of recording [s], as in `Driving`
    learned_s: float | None  # from the beginning until a copy has the required score [s]; None: none has, or no clock
    mended_s: float | None  # from the beginning until such a copy drives [s]; 0: the score was never lower
    up_bytes: int  # uplink: requests, offers, updates, losses
    down_bytes: int  # downlink: rounds, and the new network to all vehicles
    rounds_s: Annotated[tuple[float, ...] | None, LEFT_OUT] = None  # durations of the rounds [s]; None: no network


@dataclass(frozen=True)
class LifelongArm(Record):
    """Lifelong learning in one arm: replay, no replay, or nothing."""

    arm: str
    task: str
    measure: str
    conditions: tuple[str, ...]
    tested: tuple[tuple[float, ...], ...]  # test scores of the deployed network, a column per condition: row 0 is the
    # pretrained network, row i the one after condition i
    passed: tuple[Passed, ...]
    final: float  # mean score over all conditions after the last one
    backward: float  # backward transfer, see `flcav.statistics.transfer`
    forward: float  # forward transfer

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
        return cls(arm, task, measure, tuple(condition.condition for condition in passed), tested, passed, *found)

    @property
    def up_bytes(self) -> int:
        """The uplink traffic of all conditions [bytes]."""
        return sum(condition.up_bytes for condition in self.passed)

    @property
    def down_bytes(self) -> int:
        """The downlink traffic of all conditions [bytes]."""
        return sum(condition.down_bytes for condition in self.passed)

    @property
    def broken(self) -> tuple[Passed, ...]:
        """The conditions at whose beginning the deployed network was below the required score."""
        return tuple(condition for condition in self.passed if condition.learned_s != 0)

    @property
    def mended(self) -> tuple[float, ...]:
        """The times [s] until a network of the required score drives, for conditions of `broken` with one."""
        return tuple(condition.mended_s for condition in self.broken if condition.mended_s is not None)

    def describe(self) -> str:
        """Describe the arm in words."""
        parts = [
            f"{self.arm}: {self.measure} {self.final:.3f} in the mean of {plural(len(self.conditions), 'condition')}",
            f"backward transfer {self.backward:+.3f}, forward {self.forward:+.3f}",
            f"{self.up_bytes / 1e6:.1f} MB up, {self.down_bytes / 1e6:.1f} MB down",
        ]
        mended = f"{len(self.mended)} of {plural(len(self.broken), 'condition')} with errors mended"
        if self.mended:
            mended += f", after {' and '.join(f'{mended_s:.0f} s' for mended_s in self.mended)}"
        return "; ".join([*parts, mended])


@dataclass(frozen=True)
class LifelongRow:
    """The fields that lifelong learning adds to the results of a run."""

    lifelong: Annotated[tuple[LifelongArm, ...] | None, LEFT_OUT] = None  # by task and arm; None: not asked for

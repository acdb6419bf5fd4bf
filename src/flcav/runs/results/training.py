"""Records of training: pretraining, federated stages with their rounds, privacy spent, and validation scores."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np

from flcav.federation.privacy import SEEDED
from flcav.federation.state import RoundDivergence
from flcav.runs.registry import StageRows
from flcav.runs.results.saved import Saved
from flcav.storage.records import LEFT_OUT, WHERE_TRUE, Record

DIVERGED = 10.0  # loss of no training that gets anywhere, by this factor above the first, and above 1


@dataclass(frozen=True)
class Validated:
    """A validation during pretraining."""

    step: int  # optimiser steps taken
    loss: float  # mean since the validation before
    score: float  # on validation frames


@dataclass(frozen=True)
class Pretrained(Saved):
    """Result of stage I of a task; weights and ledger are in the same folder."""

    task: str
    network: str  # name of the configuration
    uploaded: Mapping[str, tuple[int, ...]]  # frames by region
    validated: tuple[Validated, ...]
    steps: int  # of the optimiser
    threshold: float | None  # lowest score of detections that serve as labels; None where none do
    track_threshold: float | None = None  # lowest score of tracks that serve as labels; None where none do


@dataclass(frozen=True)
class TrackedFrames(Saved):
    """The tracks around the training frames of a region's vehicles, which are in the same folder."""

    region: str
    frames: int
    tracks: int  # of all frames
    messages: int = 0  # that vehicles heard around these frames


@dataclass(frozen=True)
class ScoredRound:
    """A round of a federation and the validation score after it."""

    round: int
    score: float


@dataclass(frozen=True)
class FederatedRound(Record):
    """One round of a federation: whose updates were combined, who failed and why, what was sent, loss and epsilon."""

    server: str  # region of the edge server, or "cloud"
    round: int  # from 1 in its stage
    clients: tuple[str, ...]  # whose updates were combined
    failed: Mapping[str, str]  # by client what was wrong
    samples: int  # of the clients together
    loss: float | None  # mean training loss, weighted by samples; None: no client reported one
    up_bytes: int  # of all clients' messages, on their link
    down_bytes: int
    epsilon: float | None  # of differential privacy, of all rounds so far; None: without noise
    seconds: float | None = None  # of the simulated network; None: without one
    divergence: Annotated[RoundDivergence | None, LEFT_OUT] = None  # of the regions; None: no cloud round of several
    empty: Annotated[bool, WHERE_TRUE] = False  # no update, since clients had no samples: the model stays


@dataclass(frozen=True)
class StatisticsScore(Record):
    """Validation scores in a region of stage III's network, by the statistics of its batch normalisation."""

    region: str
    frames: int
    averaged: float  # with the statistics that the cloud averaged
    own: float  # with those that the region's edge server ended with


@dataclass(frozen=True)
class FoundTargets(Record):
    """Number of targets with a right label, for a range of LiDAR returns."""

    returns: int  # from this number up to, not including, that of the next kind
    targets: int
    found: int


@dataclass(frozen=True)
class LabelQuality(Record):
    """Precision, recall and box errors of the labels that vehicles train on, against ground truth unknown to them.

    A label is right that matches a target at IoU 0.5 in 3D; labels on neutral objects do not count.
    """

    round: int  # of stage II that they are made before, from 1
    labels: int
    targets: int
    precision: float | None  # None: no labels
    recall: float | None  # None: no targets
    tight: Annotated[float | None, LEFT_OUT] = None  # share of right labels with an IoU of 0.7 or more; None: none
    offset_m: Annotated[float | None, LEFT_OUT] = None  # median distance of their centres from the objects', in 3D [m]
    size_m: Annotated[float | None, LEFT_OUT] = None  # median of their largest error in length, width or height [m]
    by_returns: Annotated[tuple[FoundTargets, ...] | None, LEFT_OUT] = None  # the targets by their returns


@dataclass(frozen=True)
class LabelHistory(Saved):
    """Quality of the labels before each round of a stage."""

    rounds: tuple[LabelQuality, ...] = ()


@dataclass(frozen=True)
class _StageFigures(Saved):
    """The figures of a stage."""

    stage: str
    task: str
    region: str | None  # None: all federating regions together
    rounds: int
    samples: int  # of all clients together
    clients: int
    poles: tuple[int, ...]  # whose sensors contributed labels
    losses: tuple[float | None, ...] = ()  # mean training loss of each round
    records: Annotated[tuple[FederatedRound, ...] | None, LEFT_OUT] = None  # of all servers; None: no federation
    labels: Annotated[tuple[LabelQuality, ...] | None, LEFT_OUT] = None  # before each round; None: not measured
    noise: Annotated[float | None, LEFT_OUT] = None  # that the privacy budget gave for the planned rounds; None: none
    statistics: Annotated[tuple[StatisticsScore, ...] | None, LEFT_OUT] = None  # of stage III; None: not asked for
    kept: Annotated[int | None, LEFT_OUT] = None  # round whose weights it keeps, since it diverged; None: the last


@dataclass(frozen=True)
class StageResult(StageRows, _StageFigures):
    """Result of a federated stage of a task, or of centralised training; the weights are in the same folder."""

    def describe_rows(self) -> dict[str, str]:
        """Return the rows of extras in words, by name."""
        rows = {each.name: getattr(self, each.name) for each in fields(StageRows)}
        return {name: row.describe() for name, row in rows.items() if row is not None}


def diverges(losses: Sequence[float | None]) -> bool:
    """Return whether the last known loss of a training is no number, or `DIVERGED` times the first, and 1, or more."""
    known = [loss for loss in losses if loss is not None]
    return bool(known) and (not np.isfinite(known[-1]) or known[-1] > DIVERGED * max(known[0], 1.0))


def last_sound_round(losses: Sequence[float | None]) -> int:
    """Return the round after which the weights of a training that diverges were last known to be sound; 0: none.

    They are those that the last round began with whose loss is known and does not diverge.
    """
    numbers = range(1, len(losses) + 1)
    sound = [number for number in numbers if losses[number - 1] is not None and not diverges(losses[:number])]
    return max(sound[-1] - 1 if sound else len(losses) - 1, 0)


@dataclass(frozen=True)
class Watched(Saved):
    """Validation scores of a federation in a region after each round; of a pretrained network, as round 0."""

    stage: str
    task: str
    region: str
    frames: int
    rounds: tuple[ScoredRound, ...]


def average_regions(watched: Sequence[Watched]) -> tuple[ScoredRound, ...]:
    """Return the mean score over regions of each round that all of `watched` have, weighted by frames."""
    frames = [each.frames for each in watched]
    return tuple(
        ScoredRound(at[0].round, float(np.average([each.score for each in at], weights=frames)))
        for at in zip(*(each.rounds for each in watched), strict=False)
    )


def average_last(watched: Sequence[Watched]) -> float:
    """Return the mean over regions of the score after the last round, weighted by frames."""
    return float(np.average([each.rounds[-1].score for each in watched], weights=[each.frames for each in watched]))


TOGETHER = "a vehicle's whole data in all tasks and trainings together"


@dataclass(frozen=True)
class PrivacySpent(Record):
    """Epsilon and delta of differential privacy, of one client's whole data."""

    epsilon: float
    delta: float
    seeded: bool  # whether who knows the run's seed can draw the noise again
    noise: Annotated[tuple[float, ...] | None, LEFT_OUT] = None  # found for the planned rounds; None: it was given

    def describe(self) -> str:
        """Describe the guarantee in words; for seeded noise, also against whom it does not hold."""
        found = "" if self.noise is None else f", noise {' and '.join(f'{each:g}' for each in self.noise)} x clip"
        return f"epsilon {self.epsilon:.2f} at delta {self.delta:g}{found}" + (f" ({SEEDED})" if self.seeded else "")

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

DIVERGED = 10.0  # factor over the first loss, or over 1, from which on a loss counts as diverged


@dataclass(frozen=True)
class Validated:
    """A validation during pretraining."""

    step: int  # optimiser steps taken
    loss: float  # mean training loss since the previous validation
    score: float  # on validation frames


@dataclass(frozen=True)
class Pretrained(Saved):
    """Result of stage I of a task; weights and ledger are in the same folder."""

    task: str
    network: str  # name of the configuration
    uploaded: Mapping[str, tuple[int, ...]]  # frame numbers by region
    validated: tuple[Validated, ...]
    steps: int  # optimiser steps
    threshold: float | None  # lowest score of detections that serve as labels; None where none do
    track_threshold: float | None = None  # lowest score of tracks that serve as labels; None where none do


@dataclass(frozen=True)
class TrackedFrames(Saved):
    """Numbers of frames and of tracks around a region's training frames; the tracks are in the same folder."""

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
    """One round of a federation: clients whose updates were combined, failed clients, traffic, loss and epsilon."""

    server: str  # region of the edge server, or "cloud"
    round: int  # from 1 in its stage
    clients: tuple[str, ...]  # whose updates were combined
    failed: Mapping[str, str]  # reason, by client
    samples: int  # of the clients together
    loss: float | None  # mean training loss, weighted by samples; None: no client reported one
    up_bytes: int  # of all clients' messages, on their link
    down_bytes: int  # to all clients, likewise
    epsilon: float | None  # of differential privacy, of all rounds so far; None: without noise
    seconds: float | None = None  # duration on the simulated network [s]; None: without one
    divergence: Annotated[RoundDivergence | None, LEFT_OUT] = None  # of the regions; None: no cloud round of several
    empty: Annotated[bool, WHERE_TRUE] = False  # no client had samples: the model stays as it was


@dataclass(frozen=True)
class StatisticsScore(Record):
    """Validation scores of a stage III network in a region, with averaged or regional batch-norm statistics."""

    region: str
    frames: int
    averaged: float  # score with the statistics that the cloud averaged
    own: float  # score with the final statistics of the region's edge server


@dataclass(frozen=True)
class FoundTargets(Record):
    """Numbers of targets, and of those with a right label, in a class of targets by LiDAR returns."""

    returns: int  # lower end of the class; the next class begins at its upper end
    targets: int
    found: int


@dataclass(frozen=True)
class ClassLabels(Record):
    """Labels and targets of one class."""

    name: str
    labels: int
    right: int
    targets: int


@dataclass(frozen=True)
class LabelQuality(Record):
    """Precision, recall and box errors of the labels that vehicles train on, against ground truth unknown to them.

    A label is right if it matches a target at IoU 0.5 in 3D; labels on neutral objects do not count.
    """

    round: int  # round of stage II before which the labels are made, from 1
    labels: int
    targets: int
    precision: float | None  # None: no labels
    recall: float | None  # None: no targets
    tight: Annotated[float | None, LEFT_OUT] = None  # share of right labels with an IoU of 0.7 or more; None: no labels
    offset_m: Annotated[float | None, LEFT_OUT] = None  # median distance of their centres from the objects', in 3D [m]
    size_m: Annotated[float | None, LEFT_OUT] = None  # median of their largest error in length, width or height [m]
    by_returns: Annotated[tuple[FoundTargets, ...] | None, LEFT_OUT] = None  # classes of targets by LiDAR returns
    by_class: Annotated[tuple[ClassLabels, ...] | None, LEFT_OUT] = None  # None: the network has one class


@dataclass(frozen=True)
class LabelHistory(Saved):
    """Quality of the labels before the rounds of a stage."""

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
    losses: tuple[float | None, ...] = ()  # mean training loss by round
    records: Annotated[tuple[FederatedRound, ...] | None, LEFT_OUT] = None  # of all servers; None: no federation
    labels: Annotated[tuple[LabelQuality, ...] | None, LEFT_OUT] = None  # by round; None: not measured
    noise: Annotated[float | None, LEFT_OUT] = None  # multiplier found for the budget and planned rounds; None: none
    statistics: Annotated[tuple[StatisticsScore, ...] | None, LEFT_OUT] = None  # of stage III; None: not asked for
    kept: Annotated[int | None, LEFT_OUT] = None  # round whose weights are kept after a divergence; None: the last


@dataclass(frozen=True)
class StageResult(StageRows, _StageFigures):
    """Result of a federated stage of a task, or of centralised training; the weights are in the same folder."""

    def describe_rows(self) -> dict[str, str]:
        """Return the rows of extras as text, by name."""
        rows = {field.name: getattr(self, field.name) for field in fields(StageRows)}
        return {name: row.describe() for name, row in rows.items() if row is not None}


def diverges(losses: Sequence[float | None]) -> bool:
    """Return whether a training diverges: its last known loss is not finite, or exceeds `DIVERGED` x max(first, 1)."""
    known = [loss for loss in losses if loss is not None]
    return bool(known) and (not np.isfinite(known[-1]) or known[-1] > DIVERGED * max(known[0], 1.0))


def last_sound_round(losses: Sequence[float | None]) -> int:
    """Return the last round after which the weights of a diverging training were sound; 0: before the first round.

    A loss is that of the weights that its round began with, so a round with a sound loss proves those of the round
    before it.
    """
    numbers = range(1, len(losses) + 1)
    sound = [number for number in numbers if losses[number - 1] is not None and not diverges(losses[:number])]
    return max(sound[-1] - 1 if sound else len(losses) - 1, 0)


@dataclass(frozen=True)
class Watched(Saved):
    """Validation scores of a federation in a region by round; that of a pretrained network has round 0."""

    stage: str
    task: str
    region: str
    frames: int
    rounds: tuple[ScoredRound, ...]


def average_regions(watched: Sequence[Watched]) -> tuple[ScoredRound, ...]:
    """Return the mean score over regions, weighted by frames, of the rounds that all of `watched` have."""
    frames = [region.frames for region in watched]
    return tuple(
        ScoredRound(scored[0].round, float(np.average([at.score for at in scored], weights=frames)))
        for scored in zip(*(region.rounds for region in watched), strict=False)
    )


def average_last(watched: Sequence[Watched]) -> float:
    """Return the mean score over regions after the last round, weighted by frames."""
    return float(
        np.average([region.rounds[-1].score for region in watched], weights=[region.frames for region in watched])
    )


TOGETHER = "a vehicle's whole data in all tasks and trainings together"


@dataclass(frozen=True)
class PrivacySpent(Record):
    """Guarantee (epsilon, delta) of differential privacy for the whole data of one client."""

    epsilon: float
    delta: float
    seeded: bool  # whether the noise is drawn from the run's seed, so that whoever knows the seed can remove it
    noise: Annotated[tuple[float, ...] | None, LEFT_OUT] = None  # multipliers found for the budget; None: it was given

    def describe(self) -> str:
        """Describe the guarantee in words; for seeded noise, also against whom it does not hold."""
        found = (
            ""
            if self.noise is None
            else f", noise {' and '.join(f'{multiplier:g}' for multiplier in self.noise)} x clip"
        )
        return f"epsilon {self.epsilon:.2f} at delta {self.delta:g}{found}" + (f" ({SEEDED})" if self.seeded else "")

"""Records of plans and of placed sensors."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from flcav.config import InputError
from flcav.network.plan import MessageSizes
from flcav.runs.results.saved import Saved
from flcav.storage.records import LEFT_OUT


@dataclass(frozen=True)
class TaskPlan:
    """The plan of one task: samples, rounds, and their cost on both uplinks [MB]."""

    samples: int
    edge_rounds: int
    cloud_rounds: int
    wireless_mb: float  # uplink of all stages [MB]
    wireline_mb: float  # likewise [MB]
    sample_mb: float  # size of one sample [MB]
    model_mb: float  # size of one model update [MB]
    predicted: Mapping[str, float] | None  # score by the learning curve, after the stage; None: a fixed plan
    joins: Annotated[Mapping[str, tuple[int, ...]] | None, LEFT_OUT] = (
        None  # rounds of its region that a vehicle joins, of 1 … edge rounds + k · cloud rounds; None: all join all
    )

    uploads: Annotated[Mapping[str, int] | None, LEFT_OUT] = (
        None  # samples to upload by vehicle of the pretraining regions; None: drawn from the frames of all
    )

    exchange_mb: Annotated[float | None, LEFT_OUT] = (
        None  # what a vehicle sends to be combined in a round [MB]; None: a model update
    )
    labels_mb: Annotated[float | None, LEFT_OUT] = (
        None  # what it sends to have its samples labelled [MB]: before every round of stage II, once before stage III
    )

    called: Annotated[int | None, LEFT_OUT] = None  # vehicles of a group on request; None: the plan does not decide

    @property
    def sizes(self) -> MessageSizes:
        """The sizes of the task's messages [MB]."""
        return MessageSizes(self.sample_mb, self.model_mb, self.exchange_mb, self.labels_mb)

    def joins_after_edge(self) -> Mapping[str, tuple[int, ...]]:
        """Return the rounds after stage II that vehicles join, numbered from 1, by vehicle; empty: all join all."""
        over = self.edge_rounds
        joins = self.joins or {}
        return {name: tuple(number - over for number in joined if number > over) for name, joined in joins.items()}


@dataclass(frozen=True)
class Plan(Saved):
    """The allocation of both budgets to tasks and stages."""

    rule: str
    tasks: Mapping[str, TaskPlan]
    after: Annotated[str | None, LEFT_OUT] = None  # stage after which it was updated; None: before the run
    reached: Annotated[Mapping[str, float] | None, LEFT_OUT] = None  # score at that time, by task, that it starts from


@dataclass(frozen=True)
class ErrorRegistry(Saved):
    """Number of registered errors of a pretrained network in a region; their table is in the same folder."""

    region: str
    task: str
    counts: Mapping[str, int]  # by kind
    dropped: int  # false positives without a place in the town


@dataclass(frozen=True)
class Pole:
    """A candidate site of a roadside sensor."""

    pole: int
    covered: int  # errors within range
    actors: float  # road users within range on average


@dataclass(frozen=True)
class Placed(Saved):
    """Placement of a region's roadside sensors."""

    region: str
    rule: str
    chosen: tuple[int, ...]  # poles
    errors: int  # registered
    covered: int  # errors within range of a chosen pole
    range_m: float  # radius of a sensor's coverage [m]
    poles: tuple[Pole, ...]  # all candidates

    @property
    def first(self) -> int:
        """The pole that was chosen first; raises `InputError` where no sensor was placed."""
        if not self.chosen:
            found = f"candidate poles: {len(self.poles)}, errors to cover: {self.errors}"
            raise InputError(f"region {self.region!r}: no sensor was placed ({found})")
        return self.chosen[0]

    @property
    def densest(self) -> int:
        """The pole with the most road users within range on average."""
        return max(self.poles, key=lambda site: site.actors).pole

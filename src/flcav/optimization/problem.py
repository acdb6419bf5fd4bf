"""An allocation problem as a user writes it: budgets, message sizes, limits and learning curves per task."""

from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Self

from pydantic import Field, model_validator

from flcav.config import Config
from flcav.optimization.curves import STAGES, Additive, Curve, Effective, Positive

Count = Annotated[int, Field(ge=0)]
Range = tuple[Count, Count]  # least and most, both allowed


class Limits(Config):
    """Least and most of each quantity, both allowed."""

    samples: Range
    edge_rounds: Range
    cloud_rounds: Range

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in Limits.model_fields:
            least, most = getattr(self, name)
            if least > most:
                raise ValueError(f"{name} from {least} to {most} is empty")
        return self


class Uplink(Config):
    """What one vehicle can send [Mbit/s]."""

    wireless: Positive
    wireline: Positive | None = None  # what its edge server passes on for it; None: as much as it sends


class Task(Config):
    """One task: what its messages weigh, who takes part, and what its training brings."""

    name: Annotated[str, Field(min_length=1)]
    weight: Positive = 1.0
    sample_mb: Positive
    model_mb: Positive
    edge_groups: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]  # vehicles per edge server
    uplink_mbps: Mapping[str, Uplink] | None = None  # by vehicle, in the order of the edge groups
    samples_held: Mapping[str, Count] = {}  # by vehicle; one that is not named holds as many as are asked for
    data_quality: Mapping[str, Positive] = {}  # by vehicle: what a sample of its is worth; 1 if not named
    limits: Limits
    curve: Curve

    @model_validator(mode="after")
    def _vehicles(self) -> Self:
        known = self.uplink_mbps or {}
        if self.uplink_mbps is not None and len(known) != sum(self.edge_groups):
            raise ValueError(
                f"uplink_mbps of task {self.name!r} names {len(known)} vehicles, edge_groups have "
                f"{sum(self.edge_groups)}"
            )
        for field in ("samples_held", "data_quality"):
            for vehicle in getattr(self, field):
                if vehicle not in known:
                    raise ValueError(f"{field} of task {self.name!r} names {vehicle!r}, which uplink_mbps does not")
        return self

    @model_validator(mode="after")
    def _finite(self) -> Self:
        limits = self.limits
        if isinstance(self.curve, Effective) and limits.samples[0] == 0:
            raise ValueError(
                f"limits.samples of task {self.name!r} must start at 1 or more: its error at 0 is infinite"
            )
        if isinstance(self.curve, Additive):
            ranges = (limits.samples, limits.edge_rounds, limits.cloud_rounds)
            for stage, decay, (_, most) in zip(STAGES, self.curve.decays(), ranges):
                if most == 0 and decay.infinite_at_0:
                    raise ValueError(f"curve.{stage}.x0 of task {self.name!r} is 0: its error at 0 is infinite")
        return self


class Budgets(Config):
    """Uplink budgets [MB]."""

    wireless: Positive
    wireline: Positive


class Problem(Config):
    """How to split the budgets of both links over tasks and stages."""

    budgets_mb: Budgets
    edge_rounds_per_cloud_round: Count = 1  # k: each cloud round runs, and pays, k edge rounds in every region
    horizon_s: Positive | None = None  # how long each vehicle's own link may be busy with the plan
    tasks: Annotated[tuple[Task, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _one_link_per_vehicle(self) -> Self:
        links: dict[str, Uplink] = {}
        for task in self.tasks:
            for vehicle, link in (task.uplink_mbps or {}).items():
                if links.setdefault(vehicle, link) != link:
                    raise ValueError(
                        f"uplink_mbps of task {task.name!r} gives vehicle {vehicle!r} another link than an earlier task"
                    )
        return self

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        name, times = Counter(task.name for task in self.tasks).most_common(1)[0]
        if times > 1:
            raise ValueError(f"{times} tasks are named {name!r}")
        if self.edge_rounds_per_cloud_round == 0:
            for task in self.tasks:
                if task.limits.cloud_rounds[0] > 1:
                    raise ValueError(
                        f"task {task.name!r} asks for {task.limits.cloud_rounds[0]} cloud rounds or more, and "
                        "edge_rounds_per_cloud_round = 0 allows one: models that no one trains in between are equal"
                    )
        return self

"""Settings of how a region's training samples are dealt to its vehicles: `partition` of a recipe's federation."""

from typing import Literal, Self

from pydantic import Field, model_validator

from flcav.config import Config

BY_CLASS, BY_PLACE, BY_AMOUNT, BY_DIRICHLET = "class", "place", "amount", "dirichlet"
SHARDS, ALPHA = 2, 0.5


class Partition(Config):
    """Non-IID data: how all training samples of a region are dealt to its vehicles, instead of each keeping its own."""

    by: Literal["class", "place", "amount", "dirichlet"]
    shards: int | None = Field(
        default=None, ge=1, le=1000
    )  # of `class`: parts of the samples in the order of their classes that each vehicle has; default: 2
    alpha: float | None = Field(
        default=None, ge=1e-3, le=1e6
    )  # of `amount` and `dirichlet`: concentration of the vehicles' shares; the smaller, the more unequal; default: 0.5

    @model_validator(mode="after")
    def _fields_of_their_kind(self) -> Self:
        if self.shards is not None and self.by != BY_CLASS:
            raise ValueError(f"'shards' are of a partition by {BY_CLASS}, and this one is by {self.by}")
        if self.alpha is not None and self.by not in (BY_AMOUNT, BY_DIRICHLET):
            raise ValueError(
                f"'alpha' is of a partition by {BY_AMOUNT} or {BY_DIRICHLET}, and this one is by {self.by}"
            )
        return self


class PartitionFields(Config):
    """The fields of non-IID partitions in the settings of federated learning."""

    partition: Partition | None = None  # of a region's training samples; default: each vehicle has what it recorded

"""Sizes of a run: its data splits and its training, and presets of both."""

from collections.abc import Mapping

from pydantic import Field, field_validator

from flcav.config import Config


class Split(Config):
    """Size of a data split in one region: `scenes` x `spins` x `cavs` frames."""

    scenes: int = Field(ge=1, le=10**6)  # traffic runs
    spins: int = Field(ge=1, le=10**6)  # frames of each vehicle in a scene
    cavs: int = Field(ge=1, le=8)  # vehicles that record; of the split `edge` also the default of a region's `vehicles`
    every_s: float = Field(default=4.0, ge=2.0)  # time between two frames [s]; nearer ones would be alike


class Splits(Config):
    """Sizes of all data splits. Each split has traffic of its own, so that no scene is in two of them."""

    pool: Split  # pretraining regions: candidates for the upload of stage I
    validation: Split  # every region: scored during training
    registry: Split  # federating regions: errors are registered here
    edge: Split  # federating regions: the vehicles' training data
    test: Split  # every region: scored once, at the end

    @field_validator("test")
    @classmethod
    def _several_scenes(cls, test: Split) -> Split:
        if test.scenes < 2:
            raise ValueError("test frames of two scenes or more are wanted: intervals are over scenes")
        return test


class Training(Config):
    """Training of a task's networks. Rates are fractions of the task's own learning rate."""

    batch: int | None = Field(default=None, ge=1, le=4096)  # samples per optimiser step; default: the task's
    steps: int = Field(default=1400, ge=1, le=10**6)  # optimiser steps of pretraining, with the task's own schedule
    local_steps: int = Field(default=16, ge=1, le=10**6)  # optimiser steps of one vehicle in one round
    local_rate: float = Field(default=0.5, gt=0)  # learning rate of the first round after pretraining
    final_rate: float = Field(default=0.1, gt=0)  # learning rate of their last, and of further rounds after them
    average_rounds: int = Field(default=3, ge=1)  # last rounds of a federation whose models its result averages
    start_share: float = Field(default=0.3, ge=0, lt=1)  # of the pretrained weights in the result of stage II


SIZES: Mapping[str, tuple[Splits, Training]] = {
    "toy": (  # seconds: a smoke test, its scores mean nothing
        Splits(
            pool=Split(scenes=2, spins=3, cavs=4),
            validation=Split(scenes=1, spins=2, cavs=3),
            registry=Split(scenes=1, spins=2, cavs=2),
            edge=Split(scenes=1, spins=2, cavs=2),
            test=Split(scenes=3, spins=1, cavs=2),
        ),
        Training(steps=12, local_steps=1),
    ),
    "demo": (  # under ten minutes on two cores
        Splits(
            pool=Split(scenes=16, spins=5, cavs=4),
            validation=Split(scenes=8, spins=2, cavs=3),
            registry=Split(scenes=8, spins=3, cavs=4),
            edge=Split(scenes=16, spins=5, cavs=4),
            test=Split(scenes=30, spins=1, cavs=4),
        ),
        Training(steps=1000),
    ),
    "full": (
        Splits(
            pool=Split(scenes=20, spins=5, cavs=4),
            validation=Split(scenes=10, spins=2, cavs=3),
            registry=Split(scenes=10, spins=3, cavs=4),
            edge=Split(scenes=24, spins=5, cavs=4),
            test=Split(scenes=40, spins=2, cavs=4),
        ),
        Training(),
    ),
}

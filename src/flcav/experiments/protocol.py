"""How a run is set up: which frames exist, how long the networks train, what the links may carry.

Every split has traffic seeds of its own, so no scene is in two of them; test frames are used for nothing else.
"""

from typing import Any

from pydantic import Field, field_validator

from flcav.config import Config
from flcav.seeds import child_seed

TASK = "objects"
REGIONS = ("grid", "ring")
SPLITS = ("pool", "validation", "registry", "edge", "test")


class Split(Config):
    """Frames of one purpose in one town: `scenes` x `spins` x `cavs` of them."""

    scenes: int = Field(ge=1)
    spins: int = Field(ge=1)
    cavs: int = Field(ge=1, le=8)
    every_s: float = Field(default=4.0, ge=2.0)  # so that a detector does not see the same second twice

    @property
    def frames(self) -> int:
        """Return the number of vehicle frames."""
        return self.scenes * self.spins * self.cavs


class Training(Config):
    """How long and how fast the networks train."""

    batch: int = Field(default=2, ge=1)
    block_steps: int = Field(default=100, ge=1)  # pretraining goes in blocks, validated after each
    max_blocks: int = Field(default=12, ge=1)
    patience: int = Field(default=3, ge=1)  # blocks without `min_gain` after which validation AP has levelled off
    min_gain: float = Field(default=0.01, ge=0)
    learning_rate: float = Field(default=2e-3, gt=0)
    cooldown: tuple[float, ...] = (0.3, 0.05)  # learning rate factors of the blocks after that
    local_steps: int = Field(default=16, ge=1)
    local_learning_rate: float = Field(default=1e-3, gt=0)
    final_learning_rate: float = Field(default=2e-4, gt=0)


class Protocol(Config):
    """One seed of the demo or of its reproduction."""

    seed: int = Field(default=1, ge=0)
    wireless_mb: float = Field(default=180.0, gt=0)  # uplink budgets
    wireline_mb: float = Field(default=110.0, gt=0)
    headroom: float = Field(default=0.02, ge=0, lt=0.5)  # share the plan leaves unspent: sweeps differ in size
    edge_rounds_per_cloud_round: int = Field(default=1, ge=1)
    max_rounds: tuple[int, int] = (6, 3)  # edge, cloud: what there is time for
    placement_range_m: float = Field(default=40.0, gt=0)
    group_range_m: float = Field(default=60.0, gt=0)  # a group: vehicles this near to one of the compared poles
    grid_vehicles: int = Field(default=4, ge=1, le=8)
    ring_vehicles: int = Field(default=3, ge=1, le=8)
    pool: Split = Split(scenes=20, spins=5, cavs=4)  # suburb: what stage I may choose from
    validation: Split = Split(scenes=10, spins=2, cavs=3)  # suburb
    registry: Split = Split(scenes=10, spins=3, cavs=4)  # grid and ring each
    edge: Split = Split(scenes=24, spins=5, cavs=4)  # grid; the ring drives its own number of vehicles
    test: Split = Split(scenes=40, spins=2, cavs=4)  # grid and ring each
    training: Training = Training()

    @field_validator("test")
    @classmethod
    def _several_scenes(cls, test: Split) -> Split:
        if test.scenes < 2:
            raise ValueError("test frames of two scenes or more are wanted: intervals are over scenes")
        return test

    @property
    def vehicles(self) -> dict[str, int]:
        """Return the number of vehicles of each region's edge server."""
        return {"grid": self.grid_vehicles, "ring": self.ring_vehicles}

    def recipe(self, town: str, split: str, poles: tuple[int, ...] = ()) -> dict[str, Any]:
        """Return the recipe of one split in one town."""
        frames: Split = getattr(self, split)
        return {
            "town": town,
            "split": split,
            "seed": child_seed(self.seed, town, split),
            "scenes": frames.scenes,
            "spins_per_scene": frames.spins,
            "every_s": frames.every_s,
            "cavs": self.vehicles[town] if split == "edge" else frames.cavs,
            "poles": list(poles),
        }

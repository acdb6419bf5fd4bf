"""Settings of lifelong learning: the sequence of conditions, the replay memory, and the margin of mending."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, field_validator

from flcav.config import Config

LIFELONG = "lifelong"
REPLAY, PLAIN, NOTHING = "replay", "no replay", "nothing"
LEARNING = (REPLAY, PLAIN)  # arms whose vehicles learn; those of NOTHING drive with the pretrained network throughout


class Lifelong(Config):
    """Lifelong learning: a fleet drives through conditions in their order, and learns where its network errs.

    A condition is a federating region of the run: a town with its weather and its kinds of vehicles. cav0 of one is
    cav0 of the next. Beside this the run trains a network of its own for each condition by stage II, from the
    pretrained one: what that reaches on validation frames is what the condition can reach.
    """

    conditions: Annotated[tuple[str, ...], Field(min_length=2)]  # federating regions in the order in which they come
    memory: int = Field(default=12, ge=1, le=100_000)  # frames of all earlier conditions that a vehicle replays
    margin: float = Field(default=0.05, gt=0, lt=1)  # mended: a measure so near to what the condition can reach
    requests: Mapping[str, Any] = {}  # fields of `federation.requests` that differ from the run's, or the defaults

    @field_validator("conditions")
    @classmethod
    def _each_once(cls, conditions: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(conditions)) < len(conditions):
            raise ValueError("one of them comes twice; name another region of the same town, with traffic of its own")
        return conditions


class LifelongFields(Config):
    """The fields of lifelong learning in a recipe."""

    lifelong: Lifelong | None = None  # conditions that come one after another; None: no lifelong learning

"""Which network classifies the weather."""

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from flcav.world.weather import WEATHER_CLASSES


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LeNetConfig:
    """A LeNet-5 on RGB pictures of 32 x 32 pixels."""

    classes: Annotated[tuple[str, ...], Field(min_length=2)] = tuple(WEATHER_CLASSES)  # in the order of the scores
    original: bool = False  # as published in 1998; otherwise rectifiers and maxima where it had tanh and means


CONFIGURATIONS = {"tiny": LeNetConfig(), "paper": LeNetConfig(original=True)}

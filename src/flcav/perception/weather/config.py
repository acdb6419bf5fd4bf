"""Which network classifies the weather."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from flcav.world.weather import WEATHER_CLASSES


def _classes(names: Sequence[str]) -> Sequence[str]:
    if odd := [name for place, name in enumerate(names) if name not in WEATHER_CLASSES or name in names[:place]]:
        raise ValueError(f"'{odd[0]}' is none of the classes, or there twice; they are {', '.join(WEATHER_CLASSES)}")
    return names


Classes = Annotated[tuple[str, ...], Field(min_length=2), AfterValidator(_classes)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LeNetConfig:
    """A LeNet-5 on RGB pictures of 32 x 32 pixels."""

    classes: Classes = tuple(WEATHER_CLASSES)  # in the order of the scores
    original: bool = False  # as published in 1998; otherwise rectifiers and maxima where it had tanh and means


CONFIGURATIONS = {"tiny": LeNetConfig(), "paper": LeNetConfig(original=True)}

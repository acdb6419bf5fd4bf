"""Configurations of the weather classifier: classes, and LeNet-5 as published or modernised."""

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
    """Configuration of a LeNet-5 on RGB images of 32 x 32 pixels."""

    classes: Classes = tuple(WEATHER_CLASSES)  # in the order of the scores
    original: bool = False  # tanh and subsampling as published in 1998; otherwise ReLU and max pooling


CONFIGURATIONS = {"tiny": LeNetConfig(), "paper": LeNetConfig(original=True)}

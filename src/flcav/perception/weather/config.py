"""Configurations of the weather classifier: classes, and LeNet-5 as published, modernised, and normalised."""

from collections.abc import Sequence
from typing import Annotated, Self

from pydantic import AfterValidator, ConfigDict, Field, model_validator
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
    normalised: Annotated[bool, Field(exclude_if=lambda on: not on)] = False  # batch normalisation of C1 and C3

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if self.original and self.normalised:
            raise ValueError("the network as published has no batch normalisation")
        return self


CONFIGURATIONS = {
    "tiny": LeNetConfig(),
    "paper": LeNetConfig(original=True),
    "normalised": LeNetConfig(normalised=True),
}

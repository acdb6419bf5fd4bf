"""LeNet-5 and its configurations: LeCun et al., "Gradient-Based Learning Applied to Document Recognition", 1998, II-B.

Proc. IEEE 86(11). Two things differ from the paper in all configurations: images have three channels, and the output
layer is linear with a softmax instead of radial basis functions around drawn prototypes of digits. With batch
normalisation (Ioffe and Szegedy, ICML 2015) the maps of C1 and C3 are normalised before the rectifiers.
"""

from collections.abc import Sequence
from typing import Annotated, Self

import torch
from pydantic import AfterValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass
from torch import Tensor, nn
from torch.nn import functional

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


SIDE = 32  # [px] of the input image
# Table I of the paper: which of the six maps of S2 are inputs of each of the sixteen maps of C3
_RUNS = [[i % 6, (i + 1) % 6, (i + 2) % 6] for i in range(6)]
_LONGER_RUNS = [[(i + k) % 6 for k in range(4)] for i in range(6)]
_PAIRS = [[i, i + 1, (i + 3) % 6, (i + 4) % 6] for i in range(3)]
SEEN_MAPS = tuple(tuple(sorted(maps)) for maps in (*_RUNS, *_LONGER_RUNS, *_PAIRS, range(6)))


class PartlyConnected(nn.Module):
    """Layer C3: a 5 x 5 convolution in which each output map is connected to some of the input maps, `SEEN_MAPS`."""

    place: Tensor  # (60,) index of each kernel among the (16 x 6) of a full convolution

    def __init__(self) -> None:
        super().__init__()
        place = [6 * out + into for out, maps in enumerate(SEEN_MAPS) for into in maps]
        self.register_buffer("place", torch.tensor(place), persistent=False)
        inputs = torch.tensor([25 * len(SEEN_MAPS[i // 6]) for i in place], dtype=torch.float32)
        self.weight = nn.Parameter(uniform_over(inputs[:, None, None].expand(-1, 5, 5)))
        self.bias = nn.Parameter(torch.zeros(16))

    def forward(self, maps: Tensor) -> Tensor:
        """Return (B, 16, 10, 10) from (B, 6, 14, 14)."""
        kernels = self.weight.new_zeros(16 * 6, 5, 5).index_copy(0, self.place, self.weight)
        return functional.conv2d(maps, kernels.reshape(16, 6, 5, 5), self.bias)


class Subsampling(nn.Module):
    """Layers S2 and S4: average pooling over 2 x 2 pixels, with a trainable factor and bias per map."""

    def __init__(self, maps: int) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones(maps, 1, 1))
        self.bias = nn.Parameter(torch.zeros(maps, 1, 1))

    def forward(self, maps: Tensor) -> Tensor:
        """Return (B, maps, H / 2, W / 2) from (B, maps, H, W)."""
        return functional.avg_pool2d(maps, 2) * self.factor + self.bias


class ScaledTanh(nn.Module):
    """The activation function of the paper, 1.7159 tanh(2/3 a)."""

    def forward(self, maps: Tensor) -> Tensor:
        """Return the activations, of the same shape."""
        return 1.7159 * torch.tanh(maps * (2 / 3))


class Classifier(nn.Module):
    """Base of classifiers: networks that return logits (B, classes) of images (B, 3, 32, 32) in [-1, 1]."""

    def __init__(self, config: LeNetConfig) -> None:
        super().__init__()
        self.config = config


class LeNet(Classifier):
    """LeNet-5 on RGB images of 32 x 32 pixels."""

    def __init__(self, config: LeNetConfig) -> None:
        super().__init__(config)
        act = ScaledTanh if config.original else nn.ReLU
        self.layers = nn.Sequential(
            nn.Conv2d(3, 6, 5),  # C1: 28 x 28
            *_halved(6, act, config),  # S2: 14 x 14
            PartlyConnected() if config.original else nn.Conv2d(6, 16, 5),  # C3: 10 x 10
            *_halved(16, act, config),  # S4: 5 x 5
            nn.Conv2d(16, 120, 5),  # C5: 1 x 1
            act(),
            nn.Flatten(),
            nn.Linear(120, 84),  # F6
            act(),
            nn.Linear(84, len(config.classes)),
        )

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the logits (B, classes) of images (B, 3, 32, 32) in [-1, 1]."""
        return self.layers(pictures)


def uniform_over(inputs: Tensor) -> Tensor:
    """Return weights drawn uniformly from [-2.4 / F, 2.4 / F], the paper's initialisation (appendix A).

    F is the fan-in of each weight, given by the tensor `inputs`, whose shape the weights get.
    """
    return (2 * torch.rand(inputs.shape) - 1) * 2.4 / inputs


def _halved(maps: int, act: type[nn.Module], config: LeNetConfig) -> tuple[nn.Module, ...]:
    if config.original:
        return Subsampling(maps), act()
    return (*([nn.BatchNorm2d(maps)] if config.normalised else []), act(), nn.MaxPool2d(2))

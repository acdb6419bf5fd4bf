"""Activations of a network's layers in a forward pass, by forward hooks; the layers are fixed for each task."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from flcav.perception.ops.sparse import SparseTensor
from flcav.report.charts.task_columns import Layer

Named = Mapping[str, nn.Module]

LENET = (1, 2, 4, 5, 7, 10)  # indices of its layers, after the rectifiers


def weather_layers(network: Any) -> Named:
    """Return the layers of a LeNet-5 by their names in the paper (LeCun et al. 1998)."""
    return {name: network.layers[place] for name, place in zip(("C1", "S2", "C3", "S4", "C5", "F6"), LENET)}


def signs_layers(network: Any) -> Named:
    """Return the backbone's three scales and the finest scale of the neck."""
    stages = {"CSP, 1/8": network.to_8, "CSP, 1/16": network.to_16, "SPPF, 1/32": network.to_32}
    return {**stages, "PAN, 1/8": network.down_8}


def objects_layers(network: Any) -> Named:
    """Return the sparse 3D backbone, the two scales of the bird's-eye-view network, and their concatenation."""
    ahead = network.birds_eye
    return {"sparse 3D": network.backbone, "BEV, 1/8": ahead.near, "BEV, 1/16": ahead.far, "both": ahead}


def trajectory_layers(network: Any) -> Named:
    """Return the encoders of the surroundings and of the past track, and the decoder of the future."""
    convolutions = {f"conv {number}": layer for number, layer in enumerate(network.view.layers, 1)}
    return {**convolutions, "LSTM": network.track, "context": network.context, "decoder": network.decoder}


LAYERS: dict[str, Callable[[Any], Named]] = {
    "weather": weather_layers,
    "signs": signs_layers,
    "objects": objects_layers,
    "trajectory": trajectory_layers,
}


@contextlib.contextmanager
def capture_outputs(layers: Named) -> Iterator[dict[str, Layer]]:
    """Yield a dictionary of each layer's last output, by name, for the first sample of its batch."""
    seen: dict[str, Layer] = {}

    def keep(name: str) -> Callable[[nn.Module, Any, Any], None]:
        def kept(module: nn.Module, given: Any, out: Any) -> None:
            seen[name] = Layer(name, _values(out))

        return kept

    hooks = [layer.register_forward_hook(keep(name)) for name, layer in layers.items()]
    try:
        yield seen
    finally:
        for hook in hooks:
            hook.remove()


@contextlib.contextmanager
def capture_inputs(layer: nn.Module) -> Iterator[list[Any]]:
    """Yield a list of the positional arguments that `layer` was last called with."""
    seen: list[Any] = []
    hook = layer.register_forward_pre_hook(lambda module, given: seen.__setitem__(slice(None), given))
    try:
        yield seen
    finally:
        hook.remove()


def _values(out: Any) -> NDArray[np.float32]:
    """Return the output (C, H, W) or (C,) of the first sample; of a recurrent layer, its last time step."""
    if isinstance(out, SparseTensor):
        out = out.birds_eye()
    if isinstance(out, tuple):
        out = out[0]
    first = out[0, -1] if out.dim() == 3 else out[0]
    values = first.detach().float().cpu().numpy()
    return values.reshape(-1) if values.shape[1:] == (1, 1) else values

"""AdamW, the optimiser that all tasks are trained with: Adam with decoupled weight decay."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.adamw import adamw

from flcav.config import InputError

BETAS, EPSILON, WEIGHT_DECAY = (0.9, 0.99), 1e-8, 0.01


class AdamW:
    """AdamW with the moments of a network's parameters (Loshchilov and Hutter, ICLR 2019).

    Its steps are those of `torch.optim.AdamW` to the bit, by PyTorch's own function. That class imports the compiler of
    PyTorch, which takes each process that trains 1.7 s and 65 MB.
    """

    def __init__(self, network: nn.Module, learning_rate: float) -> None:
        """Begin with moments of zero."""
        self.learning_rate = learning_rate
        self._parameters = [*network.parameters()]
        self._first = [torch.zeros_like(each) for each in self._parameters]  # moments of the gradient
        self._second = [torch.zeros_like(each) for each in self._parameters]
        self._steps = [torch.zeros((), device=each.device) for each in self._parameters]

    @torch.no_grad()
    def step(self) -> None:
        """Change the parameters that have a gradient, in place."""
        held = zip(self._parameters, self._first, self._second, self._steps, strict=True)
        own = [(each, each.grad, *moments) for each, *moments in held if each.grad is not None]
        if own:
            parameters, gradients, first, second, steps = map(list, zip(*own, strict=True))
            rate: Any = {"lr": self.learning_rate, "beta1": BETAS[0], "beta2": BETAS[1], "eps": EPSILON}
            decay: Any = {"weight_decay": WEIGHT_DECAY, "amsgrad": False, "maximize": False}
            adamw(parameters, gradients, first, second, [], steps, fused=True, **rate, **decay)

    def state(self) -> dict[str, list[Tensor]]:
        """Return the moments and counts of steps, for a checkpoint; not copied."""
        return {"first": self._first, "second": self._second, "steps": self._steps}

    def to_arrays(self, names: Sequence[str]) -> dict[str, NDArray[np.number]]:
        """Return a copy of the state as arrays; `names` are those of the parameters, in their order."""
        held = self.state().items()
        return {f"{kind}/{name}": each.numpy(force=True).copy() for kind, own in held for name, each in zip(names, own)}

    def restore_arrays(self, arrays: Mapping[str, NDArray[np.number]], names: Sequence[str]) -> None:
        """Take the state that `to_arrays` returned; raises `InputError` for that of another network."""
        wanted = [f"{kind}/{name}" for kind in self.state() for name in names]
        if lacking := {*wanted} ^ arrays.keys():
            raise InputError(f"state of an optimiser: '{min(lacking)}' is missing or unknown")
        tensors = {key: torch.from_numpy(np.array(arrays[key])) for key in wanted}
        try:
            self.restore({kind: [tensors[f"{kind}/{name}"] for name in names] for kind in self.state()})
        except ValueError as error:
            raise InputError(f"state of an optimiser: {error}") from None

    def restore(self, state: dict[str, list[Tensor]]) -> None:
        """Take the moments and counts of steps of a checkpoint; raises `ValueError` for those of another network."""
        for name, held in self.state().items():
            for own, saved in zip(held, state[name], strict=True):
                if own.shape != saved.shape:
                    raise ValueError(f"{name}: {tuple(saved.shape)} instead of {tuple(own.shape)}")
                own.copy_(saved)

"""Compute device of a network, bfloat16 autocast where the hardware supports it, and inference mode."""

import platform
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import nn

from flcav.config import InputError

CPU = torch.device("cpu")


def select_device(name: str) -> torch.device:
    """Return the torch device "cpu" or "cuda"; "auto" is the GPU if torch can use one, otherwise the CPU.

    For a GPU, cuDNN is set to deterministic algorithms. Raises `InputError` for another name, and for "cuda" if torch
    can use no GPU.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"device '{name}': choose one of auto, cpu, cuda")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return CPU
    if not torch.cuda.is_available():
        raise InputError("device 'cuda': torch finds no GPU it can use; choose cpu or auto")
    torch.backends.cudnn.deterministic = True
    return torch.device("cuda")


def processor_of(device: torch.device) -> str:
    """Return the kind of processor, such as "x86_64 AVX512 bfloat16", or the name of the GPU.

    Results of a training are bitwise reproducible on one kind of processor only.
    """
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    kind = f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
    return f"{kind} bfloat16" if multiplies_bfloat16(device) else kind


def autocast_bfloat16(device: torch.device, wanted: bool) -> AbstractContextManager[object]:
    """Return a context of bfloat16 autocast, if `wanted` and if the hardware supports it.

    Otherwise the context changes nothing.
    """
    if wanted and multiplies_bfloat16(device):
        return torch.autocast(device.type, torch.bfloat16)
    return nullcontext()


def multiplies_bfloat16(device: torch.device) -> bool:
    """Return whether the device has instructions for bfloat16 products, which halve the time of a convolution."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()


@contextmanager
def inference(network: nn.Module) -> Iterator[None]:
    """Compute without gradients, with `network` in evaluation mode; its training mode is restored at the end."""
    training = network.training
    network.eval()
    with torch.inference_mode():
        yield
    network.train(training)

"""The device that networks run on, and the precision of their arithmetic there."""

import platform
from contextlib import AbstractContextManager, nullcontext

import torch

from flcav.config import InputError

CPU = torch.device("cpu")


def device_named(name: str) -> torch.device:
    """Return the device `name`, cpu or cuda; "auto" is the GPU where there is one.

    On a GPU its library is told to use algorithms that give the same result each time. Raises `InputError` for another
    name, and for cuda where torch has no GPU to use.
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
    """Return the kind of processor, as far as the last bits of a training depend on it: "x86_64 AVX512 bfloat16"."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    kind = f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
    return f"{kind} bfloat16" if multiplies_bfloat16(device) else kind


def bfloat16(device: torch.device, wanted: bool) -> AbstractContextManager[object]:
    """Return a context whose convolutions and matrix products are in bfloat16 where `wanted` and in the hardware.

    Elsewhere it changes nothing.
    """
    if wanted and multiplies_bfloat16(device):
        return torch.autocast(device.type, torch.bfloat16)
    return nullcontext()


def multiplies_bfloat16(device: torch.device) -> bool:
    """Return whether the device has instructions for products of bfloat16, which halve the time of a convolution."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()

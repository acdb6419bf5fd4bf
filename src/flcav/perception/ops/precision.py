"""Where numbers of half the length are multiplied faster."""

from contextlib import AbstractContextManager, nullcontext

import torch


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

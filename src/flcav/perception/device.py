"""Where networks run."""

import platform

import torch

from flcav.config import InputError
from flcav.perception.ops.precision import multiplies_bfloat16

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

"""What commands let one choose from: the help lists it without loading what is chosen."""

from collections.abc import Iterable
from enum import StrEnum

from flcav.perception.tasks import TASKS


class Device(StrEnum):
    """Where networks run."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Format(StrEnum):
    """What datasets are exported to, see `flcav.dataset.formats.export`."""

    kitti = "kitti"
    yolo = "yolo"
    coco = "coco"
    nuscenes = "nuscenes"
    opv2v = "opv2v"
    mcap = "mcap"


class Engine(StrEnum):
    """Who works, see `flcav.dataset.recorder` and `flcav.pipeline.steps`."""

    processes = "processes"
    ray = "ray"


class Stale(StrEnum):
    """What becomes of what other code did, see `flcav.pipeline.steps`."""

    refuse = "refuse"
    redo = "redo"
    keep = "keep"


class Method(StrEnum):
    """How sensors are placed, see `flcav.optimization.placement`."""

    exact = "exact"
    greedy = "greedy"


def listed(choices: Iterable[str]) -> str:
    """Return the choices in words."""
    *others, last = choices
    return f"{', '.join(others)} or {last}"


ANY_TASK = f"{listed(TASKS)}, or one of your own as module:NAME"

"""Settings of labels by the road average: `distillation` of a recipe and of its arms."""

from collections.abc import Mapping
from typing import Any

from flcav.config import Config
from flcav.fusion.distillation import Distillation

AVERAGED = {  # labels, renewed before each round of stage II, by name: fields of `LabelSource`
    "road-average": {
        "from_detections": True,
        "from_poles": True,
        "trained": True,
        "averaged": True,
        "caveat": "trained road detector",
    }
}


class DistillationFields(Config):
    """The fields of distillation in a recipe."""

    distillation: Distillation | None = None  # of labels "road-average"; None: the defaults


class ArmDistillation(Config):
    """The fields of distillation in an arm."""

    distillation: Mapping[str, Any] = {}  # fields of `Distillation` that differ from the run

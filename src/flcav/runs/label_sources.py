"""Sources of labels in stages II and III, by name."""

from collections.abc import Mapping
from dataclasses import dataclass

from flcav.config import InputError
from flcav.perception.client import as_shared
from flcav.perception.tasks import task_named
from flcav.runs.registry import SOURCES


@dataclass(frozen=True)
class LabelSource:
    """A source of labels for the vehicles' frames."""

    from_detections: bool = False  # pseudo-labels by the frozen network of stage I
    from_poles: bool = False  # boxes of roadside sensors
    trained: bool = False  # whether these boxes are those of a trained detector instead of an ideal one
    tracked: bool = False  # a vehicle's tracks through the sweeps that it recorded around its frames
    heard: bool = False  # vehicles that announce themselves by radio
    averaged: bool = False  # the road average of a window's poles and vehicles, renewed before the rounds of stage II
    caveat: str = ""  # stated with every result that depends on them

    @property
    def placed(self) -> bool:
        """Whether labels are placed in a vehicle's frames by its estimated poses."""
        return self.from_poles or self.tracked

    @property
    def measured(self) -> bool:
        """Whether the labels come from what vehicles measure or hear, and not from ground truth."""
        return self.from_detections or self.heard

    @property
    def bound(self) -> bool:
        """Whether the labels are, or depend on, ground truth: figures with them are upper bounds."""
        return not self.measured or (self.from_poles and not self.trained)


LABEL_SOURCES: Mapping[str, LabelSource] = {
    "own-detections": LabelSource(from_detections=True),
    "road": LabelSource(from_detections=True, from_poles=True, trained=True, caveat="trained road detector"),
    "tracks": LabelSource(from_detections=True, tracked=True),
    "road+tracks": LabelSource(
        from_detections=True, from_poles=True, trained=True, tracked=True, caveat="trained road detector"
    ),
    "messages": LabelSource(tracked=True, heard=True),
    "tracks+messages": LabelSource(from_detections=True, tracked=True, heard=True),
    "road+tracks+messages": LabelSource(
        from_detections=True, from_poles=True, trained=True, tracked=True, heard=True, caveat="trained road detector"
    ),
    "ideal-road": LabelSource(from_detections=True, from_poles=True, caveat="ideal road detector, upper bound"),
    "annotated": LabelSource(caveat="ground truth as labels, upper bound"),
    "future": LabelSource(
        caveat="every vehicle knows all tracks around it, upper bound"
    ),  # the recorded future of the tracks
    **{name: LabelSource(**about) for name, about in SOURCES.items()},
}


def choose_labels(task: str, asked: str | None) -> str:
    """Return the kind of labels of a task (None: its first); raises `InputError` for one that it does not have."""
    known = [kind for kind in as_shared(task_named(task)).labels if kind in LABEL_SOURCES]
    if asked is not None and asked not in known:
        raise InputError(f"labels of '{task}': '{asked}' is none of {', '.join(known)}")
    return asked or known[0]

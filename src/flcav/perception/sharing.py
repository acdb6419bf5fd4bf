"""What a task says of itself where vehicles share it: how it is recorded, a sample's bytes, where labels come from."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from flcav.dataset.store import Dataset
from flcav.perception.task import Task

ANNOTATED = "annotated"


@runtime_checkable
class Shared(Protocol):
    """A task that vehicles train together."""

    @property
    def recording(self) -> Mapping[str, Any]:
        """Return the fields of a recording's recipe in which the task differs from its defaults."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the kinds of labels that vehicles can learn from, the default first: see `flcav.pipeline.labels`."""
        ...

    def sample_bytes(self, data: Dataset, config: Any, frames: Sequence[int]) -> list[int]:
        """Return the bytes of each frame as a labelled sample that a vehicle uploads."""
        ...


class WholeFrames:
    """A task of which no more is known: whole frames are uploaded, with the labels that they were recorded with."""

    recording: Mapping[str, Any] = {}
    labels = (ANNOTATED,)

    def sample_bytes(self, data: Dataset, config: Any, frames: Sequence[int]) -> list[int]:
        """Return the bytes of point clouds, pictures and annotations."""
        return [data.payload_bytes(i) + picture_bytes(data, i) for i in frames]


def shared(task: Task) -> Shared:
    """Return how vehicles share the task."""
    return task if isinstance(task, Shared) else WholeFrames()


def picture_bytes(data: Dataset, i: int) -> int:
    """Return the bytes of a frame's pictures as they are recorded (PNG)."""
    return sum(data.plane_path(i, camera, "rgb").stat().st_size for camera in data.cameras(i))


def camera_ahead(width: int, height: int, fov_deg: float) -> Mapping[str, Any]:
    """Return a rig of one camera that looks ahead from behind the windscreen, as a recipe has it."""
    mount, settings = {"x": 0.5, "z": 1.5}, {"width": width, "height": height, "fov_deg": fov_deg}
    return {"cameras": {"camera": {"mount": mount, "settings": settings}}}

"""Whatever observes traffic: the built-in simulator, another simulator, a log."""

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

from flcav.sensors.frame import Frame
from flcav.world.trace import Trace


class Source(Protocol):
    """Frames, scene by scene: scenes in any order, the frames of a scene in order.

    A scene is one traffic run, started afresh, so that a source that can only play forward qualifies too. To be
    recorded by several processes a source has to survive pickling.
    """

    def describe(self) -> dict[str, Any]:
        """Return all that decides the frames, as plain JSON values; two equal descriptions give equal frames."""
        ...

    def scenes(self) -> Sequence[str]:
        """Return the names of the scenes: safe in file names, and never used again for other traffic."""
        ...

    def frame_count(self, scene: str) -> int:
        """Return how many frames `frames(scene)` yields."""
        ...

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the scene's frames by time, and by agent within one time."""
        ...

    def trace(self, scene: str) -> Trace | None:
        """Return the traffic of a scene whose frames have been consumed; None from a source that knows none."""
        ...

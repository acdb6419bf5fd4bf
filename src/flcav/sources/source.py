"""Whatever observes traffic: the built-in simulator, another simulator, a log."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol, runtime_checkable

from flcav.files import Json
from flcav.sensors.frame import Frame
from flcav.world.trace import Trace


class Source(Protocol):
    """Frames, scene by scene: scenes in any order, the frames of a scene in order.

    A scene is one traffic run, started afresh, so that a source that can only play forward qualifies too. To be
    recorded by several processes a source has to survive pickling.
    """

    def describe(self) -> Mapping[str, Json]:
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


@runtime_checkable
class Replayable(Source, Protocol):
    """A source that observes any frame of a scene once its traffic is there, so that frames go in parallel.

    Its `trace(scene)` may be asked at any time and gives the traffic.
    """

    def replay(self, scene: str, trace: Trace, numbers: range) -> Iterator[Frame]:
        """Yield frames `numbers`, counted as `frames(scene)` yields them, of the scene whose traffic is `trace`."""
        ...


@runtime_checkable
class Located(Source, Protocol):
    """A source whose town has a folder that may not be there where its dataset is read: the dataset keeps it."""

    def town_files(self) -> Mapping[str, bytes]:
        """Return the files of the town's folder by name; none of a town that comes with flcav."""
        ...

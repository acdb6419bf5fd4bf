"""Protocols of sources of frames, such as a simulator or a reader of logs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol, runtime_checkable

from flcav.config import Json
from flcav.sensors.frame import Frame
from flcav.sensors.navigation_log import NavigationLog
from flcav.world.trace import Trace


class Source(Protocol):
    """A source of frames, scene by scene: scenes are read in any order, the frames of a scene in sequence.

    A scene is one traffic run from its start, so a source that can only play forward is enough. Recording by several
    processes pickles the source.
    """

    def describe(self) -> Mapping[str, Json]:
        """Return everything that determines the frames, as JSON values: equal descriptions mean equal frames."""
        ...

    def scenes(self) -> Sequence[str]:
        """Return the names of the scenes: safe in file names, and unique to their traffic."""
        ...

    def frame_count(self, scene: str) -> int:
        """Return the number of frames that `frames(scene)` yields."""
        ...

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the scene's frames ordered by time, then by agent."""
        ...

    def trace(self, scene: str) -> Trace | None:
        """Return the traffic of a scene once all its frames are yielded; None where the source does not know it."""
        ...


@runtime_checkable
class Replayable(Source, Protocol):
    """A source that produces any frame of a scene from the scene's traffic, so that frames are recorded in parallel.

    Its `trace(scene)` returns the traffic at any time, even before the frames are yielded, and never None.
    """

    def replay(self, scene: str, trace: Trace, numbers: range) -> Iterator[Frame]:
        """Yield the frames of a scene with traffic `trace` whose positions in `frames(scene)` are `numbers`."""
        ...


@runtime_checkable
class LoggingSource(Replayable, Protocol):
    """A source that also provides the GNSS and IMU measurements of the vehicles over their whole drives."""

    def navigation_logs(self, scene: str) -> Mapping[str, NavigationLog]:
        """Return the navigation logs of a scene by vehicle; empty where the source records none."""
        ...


@runtime_checkable
class TownSource(Source, Protocol):
    """A source whose town's files are copied into the dataset, for readers that do not have the town."""

    def town_files(self) -> Mapping[str, bytes]:
        """Return the contents of the town's files by name; empty for a town that comes with flcav."""
        ...


@runtime_checkable
class Isolated(Source, Protocol):
    """A source whose library may crash the process: it is recorded in a separate process without output."""

    def explain_end(self) -> str:
        """Return one sentence on why such a process ended prematurely."""
        ...

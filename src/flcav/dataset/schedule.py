"""In which order tasks are done: the traffic of a scene before its frames, and of few scenes ahead."""

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

from flcav.dataset.tasks import TRAFFIC, Part, Task, Traffic, parts
from flcav.sources.source import Replayable, Source

AHEAD = 2  # tasks handed over beyond those under way, so that nobody waits


class Engine(Protocol):
    """Whoever does tasks, in any order, `slots` at once."""

    slots: int

    def submit(self, task: Task) -> None:
        """Take a task."""
        ...

    def wait(self) -> Iterable[Task]:
        """Return tasks that have been done since, at least one; raises what a task raised."""
        ...


def pending(source: Source, scene: str, work: Path) -> list[Part]:
    """Return the parts of a scene that are not there yet."""
    return [part for part in parts(source, scene) if not part.folder(work).is_dir()]


def record_scenes(source: Source, engine: Engine, work: Path) -> None:
    """Do what is left of all scenes."""
    scenes = deque(scene for scene in source.scenes() if pending(source, scene, work))
    ready: deque[Task] = deque()
    busy = 0
    while scenes or ready or busy:
        while (scenes or ready) and busy < engine.slots + AHEAD:
            if not ready:
                scene = scenes.popleft()
                known = not isinstance(source, Replayable) or (work / scene / TRAFFIC).is_file()
                ready.extend(pending(source, scene, work) if known else [Traffic(scene)])
            engine.submit(ready.popleft())
            busy += 1
        for task in engine.wait():
            busy -= 1
            if isinstance(task, Traffic):
                ready.extend(pending(source, task.scene, work))

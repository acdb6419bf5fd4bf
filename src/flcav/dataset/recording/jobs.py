"""The jobs of a recording, a scene or a spin each, and the order they are done in."""

import hashlib
import json
import re
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

import pyarrow as pa

from flcav.dataset.calibration import to_json
from flcav.dataset.layout import CALIBRATION, FILES, TRACES, table_path
from flcav.dataset.payloads import payloads
from flcav.dataset.rows import rows_of, table_of
from flcav.dataset.tables import FILES_SCHEMA, SCHEMAS, write_table
from flcav.files import fill, write_bytes
from flcav.sensors.frame import Frame
from flcav.sources.source import Replayable, Source
from flcav.world.trace import Trace

PART_FRAMES = 16  # few enough to lose, many enough to start for
TRAFFIC = "traffic.parquet"
PAYLOADS = "payloads"  # folder of what goes into the dataset as it is
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


class Traffic(NamedTuple):
    """A scene's traffic, which its parts replay."""

    scene: str


class Part(NamedTuple):
    """Some of a scene's frames."""

    scene: str
    number: int
    frames: int  # how many
    first: int = 0

    def folder(self, work: Path) -> Path:
        """Return where the part lies when it is complete."""
        return work / self.scene / f"{self.number:05d}"


Task = Traffic | Part


def parts(source: Source, scene: str) -> list[Part]:
    """Return the parts of a scene, which do not depend on who records it."""
    count = source.frame_count(scene)
    step = PART_FRAMES if isinstance(source, Replayable) else max(count, 1)
    return [Part(scene, number, min(step, count - first), first) for number, first in enumerate(range(0, count, step))]


def perform(source: Source, task: Task, work: Path, wrote_frame: Callable[[], None]) -> None:
    """Do `task`, whatever an earlier attempt has left; calls `wrote_frame` after each frame."""
    if isinstance(task, Traffic):
        trace = source.trace(task.scene)
        if trace is None:
            raise ValueError(f"{task.scene}: the source can replay this scene but has no traffic of it")
        trace.save(work / task.scene / TRAFFIC)
        return
    part = task.folder(work).with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    _write(_frames(source, task, work), task.scene, part, wrote_frame)
    if not isinstance(source, Replayable) and (trace := source.trace(task.scene)) is not None:
        trace.save(work / task.scene / TRAFFIC)
    part.rename(task.folder(work))


def _frames(source: Source, task: Part, work: Path) -> Iterator[Frame]:
    if not isinstance(source, Replayable):
        return source.frames(task.scene)
    trace = Trace.load(work / task.scene / TRAFFIC)
    return source.replay(task.scene, trace, range(task.first, task.first + task.frames))


def _write(frames: Iterator[Frame], scene: str, part: Path, wrote_frame: Callable[[], None]) -> None:
    files: list[tuple[str, int, str]] = []
    tables = {name: [] for name in SCHEMAS}
    calibrations = {}
    written = set()
    for frame in frames:
        _check_names(frame, scene)
        if frame.key in written:
            raise ValueError(f"{frame.key}: the source yields this frame twice")
        written.add(frame.key)
        for payload in payloads(frame):
            path = part / PAYLOADS / payload.path
            path.parent.mkdir(parents=True, exist_ok=True)
            fill(path, payload.data)
            files.append((payload.path, len(payload.data), hashlib.sha256(payload.data).hexdigest()))
        for name, rows in rows_of(frame).items():
            tables[name].append(rows)
        calibration = to_json(frame)
        if calibrations.setdefault(frame.agent, calibration) != calibration:
            raise ValueError(f"{frame.key}: the sensors of {frame.agent} moved on their mounts within a dataset")
        wrote_frame()
    for name, rows in tables.items():
        write_table(table_of(name, rows), part / table_path(name))
    listing = pa.table(dict(zip(FILES_SCHEMA.names, zip(*files) if files else ([], [], []))), schema=FILES_SCHEMA)
    write_table(listing, part / table_path(FILES))
    write_bytes(part / CALIBRATION, json.dumps(calibrations).encode())


def _check_names(frame: Frame, scene: str) -> None:
    names = (frame.key, *frame.calibration.agent_from_sensor)
    if frame.scene != scene or TRACES in names or not all(_SAFE_NAME.fullmatch(name) for name in names):
        raise ValueError(f"{frame.key}: scene, agent or sensor names that a dataset cannot hold: {names}")


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

"""The jobs of a recording: division of the frames, how a job is performed, and engines that perform jobs in parallel.

A scene of a `Replayable` source is one job for its traffic and one for each part of its frames; any other scene is one
job. A job writes below `work/SCENE`: the traffic, with navigation logs if there are any, or the folder of a part, which
appears there when it is complete. A scene's traffic is scheduled before its parts, and only a few scenes are in
progress at a time. Jobs run in this process, in a pool of processes, or in actors on the machines of a Ray cluster.
"""

import contextlib
import hashlib
import itertools
import json
import os
import re
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from flcav.config import shorten
from flcav.dataset.calibration import encode_calibration
from flcav.dataset.layout import CALIBRATION, FILES, MANIFEST, NAVIGATION, TOWN, TRACES, payload_path, table_path
from flcav.dataset.navigation_logs import save_logs
from flcav.dataset.payloads import PICTURES, POINTS, check_image, encode_payloads
from flcav.dataset.rows import build_table, encode_frame
from flcav.dataset.tables import FILES_SCHEMA, SCHEMAS, write_rows
from flcav.machine.processes import process_pool, start_server
from flcav.machine.ray_engine import actor_pool
from flcav.sensors.frame import LONGEST_NAME, Frame, LinkedFrame
from flcav.sources.source import Isolated, LoggingSource, Replayable, Source
from flcav.storage.files import flush_all, flush_tree, sha256, write_bytes, write_in_pieces
from flcav.world.trace import Trace

PART_FRAMES = 16  # frames of a part: an interruption loses few, and they take much longer than starting the part
TRAFFIC = "traffic.parquet"
LOGS = "navigation.parquet"
HEADER = "recipe.json"
JOINED = "joined"  # folder below `.recording` of the concatenated tables and the calibration
PAYLOADS = "payloads"  # folder of a part with the files that are moved into the dataset unchanged
_SAFE_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9_.-]{{0,{LONGEST_NAME - 1}}}")
OWN_NAMES = {TRACES, NAVIGATION, TOWN, MANIFEST, CALIBRATION, HEADER, JOINED, *map(table_path, (*SCHEMAS, FILES))}
AHEAD = 2  # jobs submitted beyond an engine's slots, so that no worker idles


class SceneTraffic(NamedTuple):
    """The job that simulates the traffic of a scene, which the scene's parts replay."""

    scene: str


class ScenePart(NamedTuple):
    """The job that records `frames` consecutive frames of a scene, from number `first` on."""

    scene: str
    number: int
    frames: int  # how many
    first: int = 0

    def folder(self, work: Path) -> Path:
        """Return the folder of the completed part below the folder `work`."""
        return work / self.scene / f"{self.number:05d}"


Job = SceneTraffic | ScenePart


def check_scenes(scenes: Sequence[str]) -> None:
    """Raise ValueError where a scene's name is unsafe as a folder, reserved by the dataset, or used twice."""
    for scene in scenes:
        if not _SAFE_NAME.fullmatch(scene) or scene in OWN_NAMES:
            raise ValueError(f"{shorten(scene)}: the name of a scene that a dataset cannot hold")
    if len(set(scenes)) < len(scenes):
        raise ValueError(f"two scenes are called '{max(scenes, key=list(scenes).count)}'")


def split_scene(source: Source, scene: str) -> list[ScenePart]:
    """Return the parts of a scene: PART_FRAMES frames each for a `Replayable` source, else one of all frames."""
    count = source.frame_count(scene)
    step = PART_FRAMES if isinstance(source, Replayable) else max(count, 1)
    return [
        ScenePart(scene, number, min(step, count - first), first) for number, first in enumerate(range(0, count, step))
    ]


def perform_job(source: Source, task: Job, work: Path, wrote_frame: Callable[[], None]) -> None:
    """Perform the job `task` below the folder `work`, replacing leftovers of an earlier attempt.

    Calls `wrote_frame` after each frame. Raises ValueError where the source violates its protocol: it has no traffic to
    replay, yields a frame twice or of another scene, uses unsafe names, or moves sensors on their mounts. Raises
    `InputError`, a ValueError, where a linked image is truncated.
    """
    if isinstance(task, SceneTraffic):
        trace = source.trace(task.scene)
        if trace is None:
            raise ValueError(f"{task.scene}: the source can replay this scene but has no traffic of it")
        if isinstance(source, LoggingSource) and (logs := source.navigation_logs(task.scene)):
            save_logs(logs, work / task.scene / LOGS)
        trace.save(work / task.scene / TRAFFIC)  # last: with it the job is done
        return
    part = task.folder(work).with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        _write(_frames(source, task, work), task.scene, part, wrote_frame)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    if not isinstance(source, Replayable) and (trace := source.trace(task.scene)) is not None:
        trace.save(work / task.scene / TRAFFIC)
    flush_tree(part)
    part.rename(task.folder(work))
    flush_all([part.parent])


def _frames(source: Source, task: ScenePart, work: Path) -> Iterator[Frame]:
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
            raise ValueError(
                f"scene '{scene}' has two frames of '{frame.agent}' at spin {frame.index} ({frame.time_s:g} s), the "
                f"second{_name_files(frame)}; an agent has one frame a spin: correct its time stamp, or remove it"
            )
        written.add(frame.key)
        links = frame.files if isinstance(frame, LinkedFrame) else {}
        for sensor, target in links.items():
            suffix = target.suffix[1:].lower()
            if suffix in PICTURES:
                check_image(target)
            elif suffix != POINTS:
                raise ValueError(f"{target}: neither a picture nor a point cloud, by its ending")
            name = payload_path(sensor, frame.key, suffix)
            (part / PAYLOADS / name).parent.mkdir(parents=True, exist_ok=True)
            (part / PAYLOADS / name).symlink_to(target.resolve())
            files.append((name, target.stat().st_size, sha256(target)))
        for payload in encode_payloads(frame, links):
            path = part / PAYLOADS / payload.path
            path.parent.mkdir(parents=True, exist_ok=True)
            write_in_pieces(path, payload.data)
            files.append((payload.path, len(payload.data), hashlib.sha256(payload.data).hexdigest()))
        for name, rows in encode_frame(frame).items():
            tables[name].append(rows)
        calibration = encode_calibration(frame)
        if calibrations.setdefault(frame.agent, calibration) != calibration:
            raise ValueError(f"{frame.key}: the sensors of {frame.agent} moved on their mounts within a dataset")
        wrote_frame()
    for name, rows in tables.items():
        write_rows(build_table(name, rows), part / table_path(name))
    listing = pa.table(dict(zip(FILES_SCHEMA.names, zip(*files) if files else ([], [], []))), schema=FILES_SCHEMA)
    write_rows(listing, part / table_path(FILES))
    write_bytes(part / CALIBRATION, json.dumps(calibrations).encode())


def _name_files(frame: Frame) -> str:
    """Return " of FILE" for a frame that has files, else ""."""
    files = frame.files if isinstance(frame, LinkedFrame) else {}
    return f" of {next(iter(files.values()))}" if files else ""


def _check_names(frame: Frame, scene: str) -> None:
    links = frame.files if isinstance(frame, LinkedFrame) else {}
    names = (frame.key, *frame.calibration.agent_from_sensor, *links)
    if frame.scene != scene or OWN_NAMES & {*names} or not all(_SAFE_NAME.fullmatch(name) for name in names):
        raise ValueError(f"{frame.key}: scene, agent or sensor names that a dataset cannot hold: {names}")


class Engine:
    """An executor of jobs, `slots` at a time, in any order."""

    def __init__(self, slots: int, start: Callable[[Job], Future[None]], wrote: Callable[[int], None]) -> None:
        """Begin jobs by `start`; `wrote` is called with the number of frames of the completed parts."""
        self.slots, self._start, self._wrote = slots, start, wrote
        self._tasks: dict[Future[None], Job] = {}
        self._count = 0

    def submit(self, task: Job) -> None:
        """Enqueue a job."""
        self._tasks[self._start(task)] = task

    def wait(self) -> list[Job]:
        """Block until a submitted job is done; return those done since the last call, at least one.

        Raises the exception of a failed job, and OSError where a worker was killed.
        """
        done: set[Future[None]] = set()
        while not done:
            done, _ = wait(self._tasks, timeout=POLL_S, return_when=FIRST_COMPLETED)
            self._count += sum(task.frames for future in done if isinstance(task := self._tasks[future], ScenePart))
            self._wrote(self._count)
        for future in done:
            future.result()
        return [self._tasks.pop(future) for future in done]


def find_pending(source: Source, scene: str, work: Path) -> list[ScenePart]:
    """Return the parts of a scene that are not complete yet."""
    return [part for part in split_scene(source, scene) if not part.folder(work).is_dir()]


def record_scenes(source: Source, engine: Engine, work: Path) -> None:
    """Perform all remaining jobs of all scenes on `engine`, the traffic of a scene before its parts."""
    scenes = deque(scene for scene in source.scenes() if find_pending(source, scene, work))
    ready: deque[Job] = deque()
    busy = 0
    while scenes or ready or busy:
        while (scenes or ready) and busy < engine.slots + AHEAD:
            if not ready:
                scene = scenes.popleft()
                known = not isinstance(source, Replayable) or (work / scene / TRAFFIC).is_file()
                ready.extend(find_pending(source, scene, work) if known else [SceneTraffic(scene)])
            engine.submit(ready.popleft())
            busy += 1
        for task in engine.wait():
            busy -= 1
            if isinstance(task, SceneTraffic):
                ready.extend(find_pending(source, task.scene, work))


POLL_S = 0.2

_job: Any = None  # in a worker process: source, folder, and the shared counter of written frames


@contextlib.contextmanager
def start_processes(source: Source, work: Path, jobs: int, wrote: Callable[[int], None]) -> Iterator[Engine]:
    """Yield an engine of `jobs` processes that perform jobs of `source` below the folder `work`.

    It calls `wrote` with the number of frames written so far. A single process is this one, unless the source is
    `Isolated`; others are single-threaded child processes, which end with this one, even if it is killed.
    """
    if jobs == 1 and not isinstance(source, Isolated):
        count = itertools.count(1)

        def run(task: Job) -> Future[None]:
            perform_job(source, task, work, lambda: wrote(next(count)))
            done: Future[None] = Future()
            done.set_result(None)
            return done

        yield Engine(1, run, lambda _: None)
        return
    written = start_server().Value("q", 0)
    with process_pool(jobs, _begin, source, work, written) as pool:
        try:
            yield Engine(jobs, lambda task: pool.submit(_perform, task), lambda _: wrote(written.value))
        except BrokenProcessPool:
            if isinstance(source, Isolated):
                raise OSError(source.explain_end()) from None
            raise


@contextlib.contextmanager
def start_actors(source: Source, work: Path, jobs: int, wrote: Callable[[int], None]) -> Iterator[Engine]:
    """Yield an engine of `jobs` Ray actors that perform jobs of `source` below the folder `work`.

    The folder must be on storage shared by all machines, and flcav installed on all of them. RAY_ADDRESS names the
    cluster; without it, Ray is started on this machine. `wrote` is called with the number of frames written so far, as
    parts are completed. Raises `InputError` where Ray is not installed.
    """
    with actor_pool(jobs, _Recorder, source, work.absolute()) as pool:
        yield Engine(jobs, lambda task: pool.lend(lambda actor: actor.call(_Recorder.perform, task)), wrote)


def _begin(*job: Any) -> None:
    global _job
    _job = job
    if isinstance(job[0], Isolated):
        silent = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):  # silences what the source's library prints; errors are returned
            os.dup2(silent, stream)


def _perform(task: Job) -> None:
    source, work, written = _job

    def count_frame() -> None:
        with written.get_lock():
            written.value += 1

    perform_job(source, task, work, count_frame)


class _Recorder:
    """A Ray actor that performs jobs one after another; its source keeps the scene that it built last."""

    def __init__(self, source: Source, work: Path) -> None:
        self._source, self._work = source, work

    def perform(self, task: Job) -> None:
        if not self._work.is_dir():
            raise OSError(
                f"{self._work}: not seen from {os.uname().nodename}; record into storage that all nodes share"
            )
        perform_job(self._source, task, self._work, lambda: None)

"""An experiment as named steps that leave files: what is finished is not done again, what is independent runs beside.

A step is finished when its `done.json` is there: the value it returned, and the fingerprint of what it was asked. It
is written last, so a killed run goes on from its last finished step; a step may keep files to go on from within itself.
Its fingerprint stands in `started.json` before that, so that it is not gone on with as it was not begun.
"""

import hashlib
import json
import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, FIRST_EXCEPTION, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from queue import Empty
from typing import Any

from flcav.config import InputError
from flcav.dataset.workers import end_with_parent
from flcav.files import write_json
from flcav.progress import Report
from flcav.threads import use_threads

Notify = Callable[[str, int, int, str], None]  # step, done, total, note
DONE, STARTED = "done.json", "started.json"


@dataclass(frozen=True)
class Work:
    """What a step is given."""

    folder: Path  # its own
    inputs: Mapping[str, Path]  # folders of the steps it needs
    report: Report

    def result(self, step: str) -> Any:
        """Return the value of a step that this one needs."""
        return json.loads((self.inputs[step] / DONE).read_text())["value"]


@dataclass(frozen=True)
class Step:
    """One unit of work: a module-level function of (Work, **arguments) that returns a JSON value."""

    name: str
    run: Callable[..., Any]
    arguments: Mapping[str, Any]  # JSON values, and frozen dataclasses of them
    needs: tuple[str, ...] = ()

    def fingerprint(self, inputs: Mapping[str, str]) -> str:
        """Return what identifies this step's work: its function, arguments and what it is built on."""
        parts = [self.run.__module__, self.run.__qualname__, self.arguments, {n: inputs[n] for n in self.needs}]
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=_named).encode()).hexdigest()[:16]


def run_steps(steps: Sequence[Step], folder: Path, *, jobs: int, notify: Notify) -> dict[str, Any]:
    """Run `steps` (in an order where each comes after what it needs) and return their values by name.

    `jobs` processes of one thread each, which end with this one however it ends. Raises `InputError` where `folder`
    holds steps of other arguments, `OSError` where one of them was killed.
    """
    prints: dict[str, str] = {}
    for step in steps:
        prints[step.name] = step.fingerprint(prints)
    values: dict[str, Any] = {}
    for step in steps:
        started, done = (folder / step.name / name for name in (STARTED, DONE))
        for path in (started, done):
            if path.exists() and json.loads(path.read_text())["fingerprint"] != prints[step.name]:
                raise InputError(f"{folder}: holds the steps of another configuration; choose another folder")
        if done.exists():
            values[step.name] = json.loads(done.read_text())["value"]
            notify(step.name, 1, 1, "done before")
    waiting = [step for step in steps if step.name not in values]
    if not waiting:
        return values
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start, initargs=(queue,)) as pool:
        running: dict[Future, Step] = {}
        try:
            while waiting or running:
                ready = [step for step in waiting if all(name in values for name in step.needs)]
                for step in ready[: jobs - len(running)]:
                    waiting.remove(step)
                    running[pool.submit(_perform, step, folder, prints[step.name])] = step
                finished, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                _drain(queue, notify)
                for future in finished:
                    step = running.pop(future)
                    values[step.name] = future.result()
                    notify(step.name, 1, 1, "done")
        except BrokenProcessPool:
            raise OSError("a step's process was killed from outside, most often for want of memory") from None
        except BaseException:
            for process in list(pool._processes.values()):  # not those of a run beside this one
                process.terminate()
            raise
    return values


def run_side_by_side(runs: Mapping[Path, Sequence[Step]], *, jobs: int, notify: Notify) -> dict[Path, dict[str, Any]]:
    """Run the steps of each folder, up to `jobs` folders at a time in a process each; return `run_steps` of each."""

    def run(folder: Path) -> dict[str, Any]:
        def named(step: str, done: int, total: int, note: str) -> None:
            notify(f"{folder.name}/{step}", done, total, note)

        return run_steps(runs[folder], folder, jobs=max(1, jobs // len(runs)), notify=named)

    with ThreadPoolExecutor(jobs) as threads:
        started = {folder: threads.submit(run, folder) for folder in runs}
        try:
            for future in wait(started.values(), return_when=FIRST_EXCEPTION).done:
                future.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    return {folder: future.result() for folder, future in started.items()}


def stopwatch(folder: Path) -> Callable[[], float]:
    """Return a clock of the seconds spent on the run in `folder`, those of its earlier, interrupted starts included.

    A start's seconds count up to the last time that the clock was read.
    """
    path, start = folder / "elapsed.json", time.monotonic()
    earlier = json.loads(path.read_text())["elapsed_s"] if path.exists() else 0.0

    def clock() -> float:
        elapsed = earlier + time.monotonic() - start
        write_json(path, {"elapsed_s": elapsed})
        return elapsed

    return clock


def _named(value: Any) -> list[Any]:
    """Return what identifies a record among a step's arguments: its class and its fields."""
    if not is_dataclass(value):
        raise TypeError(f"{value!r} cannot be a step's argument: it is neither a JSON value nor a dataclass of them")
    return [type(value).__module__, type(value).__qualname__, {f.name: getattr(value, f.name) for f in fields(value)}]


def _drain(queue: Any, notify: Notify) -> None:
    while True:
        try:
            notify(*queue.get_nowait())
        except Empty:
            return


_queue: Any = None


def _start(queue: Any) -> None:
    global _queue
    _queue = queue
    end_with_parent()
    use_threads(1)


def _perform(step: Step, folder: Path, fingerprint: str) -> Any:
    own = folder / step.name
    own.mkdir(parents=True, exist_ok=True)

    def report(done: int, total: int, note: str = "") -> None:
        _queue.put((step.name, done, total, note))

    report(0, 1, "")
    write_json(own / STARTED, {"fingerprint": fingerprint})
    work = Work(own, {name: folder / name for name in step.needs}, report)
    value = step.run(work, **step.arguments)
    write_json(own / DONE, {"fingerprint": fingerprint, "value": value})
    return json.loads((own / DONE).read_text())["value"]

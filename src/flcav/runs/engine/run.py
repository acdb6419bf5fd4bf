"""Execution of steps in dependency order, by processes or on a cluster, resuming from those that are finished.

A step is finished when its folder contains `done.json`: value, fingerprint, hash of the code it reaches, sizes of its
files, and provenance. The file is written last, so an interrupted run resumes after its last finished step. A finished
step is repeated if one of its files is missing or has another size. A step may also write checkpoints; `started.json`
records fingerprint and code beforehand, so that a checkpoint is not resumed with other arguments.

Steps with another fingerprint (function or arguments) need another folder. Steps begun or finished by other code are
stale, and so are all steps that depend on them: they are refused, done again or kept, by the argument `stale`.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path
from queue import Empty
from statistics import fmean
from typing import Any

from flcav.config import InputError, read_json
from flcav.interface.progress import DAMAGED
from flcav.interface.wording import plural
from flcav.machine.locks import only_writer
from flcav.runs.engine.cluster import open_actors
from flcav.runs.engine.source_hash import Sources, find_definitions
from flcav.runs.engine.step import (
    DONE,
    DONE_BEFORE,
    DONE_NOW,
    KEPT,
    STALE,
    WHOLE,
    Notify,
    Step,
    StepRecord,
    asks_the_same,
    find_damage,
    make_edited_error,
    make_stale_error,
    read_record,
    read_value,
    remove,
    reserve_sibling,
    take_over,
)
from flcav.runs.engine.workers import Workers, open_step_processes
from flcav.storage.files import write_json

ENGINES: Mapping[str, Callable[[int], contextlib.AbstractContextManager[Workers]]] = {
    "processes": open_step_processes,
    "ray": open_actors,
}
POLL_S = 0.2


def run_steps(
    steps: Sequence[Step],
    folder: Path,
    *,
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
) -> dict[str, Any]:
    """Run `steps`, given in topological order, in `folder`, and return their values by name.

    `jobs` is the number of single-threaded workers: processes, which end with this one however it ends, or actors on
    the machines of a Ray cluster, see `flcav.runs.engine.cluster`. Idle processes are lent to steps that can use
    several, until these end. `stale` decides on steps begun or finished by other code: they are refused, done again
    ("redo") or kept ("keep", with their records unchanged). Steps with other arguments, and the steps that need them,
    are done again by "redo" and otherwise refused. A step whose function has since moved to another module counts as
    done by other code. Raises `InputError` for steps that are refused, and where another process runs steps in the
    folder; `OSError` where a worker was killed.
    """
    return _run({folder: steps}, {folder: notify}, notify, jobs, stale, engine)[folder]


def run_side_by_side(
    runs: Mapping[Path, Sequence[Step]],
    *,
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
    names: Mapping[Path, str] | None = None,
) -> dict[Path, dict[str, Any]]:
    """Run the steps of several folders on the same `jobs` workers; return the values by folder and step.

    Earlier folders have precedence. A step that is finished in another of the folders, with the same arguments and
    code, is taken over; one that is under way there is waited for. `names`: prefixes of the steps in `notify`, by
    folder (None: the folders' names). Raises as `run_steps`.
    """

    def named(folder: Path) -> Notify:
        name = folder.name if names is None else names[folder]
        return lambda step, done, total, note: notify(f"{name}/{step}", done, total, note)

    return _run(runs, {folder: named(folder) for folder in runs}, notify, jobs, stale, engine)


@dataclass(frozen=True)
class _Run:
    """The work that is left in a folder."""

    folder: Path
    records: Mapping[str, StepRecord]
    waiting: list[Step]
    values: dict[str, Any]  # of finished steps
    notify: Notify

    def finish(self, step: Step) -> None:
        """Take the value of a step whose folder is complete."""
        self.values[step.name] = read_value(self.folder / step.name)
        self.notify(step.name, 1, 1, DONE_NOW)


class Pace:
    """Wall times of finished steps, by what they compute: they tell how long the others take."""

    def __init__(self, jobs: int) -> None:
        self._jobs, self._times = jobs, dict[Callable[..., Any], list[float]]()

    def add(self, step: Step, took_s: float) -> None:
        """Take the wall time of a finished step."""
        self._times.setdefault(step.run, []).append(took_s)

    def tell_left(self, waiting: Sequence[Step], running: Sequence[tuple[Step, float]]) -> str:
        """Return the time left for steps, in words; of running ones the time so far [s] counts.

        A step takes as long as those of its function did, or else as all did. Empty where no step is left, and before
        the first is finished.
        """
        every = [took_s for times in self._times.values() for took_s in times]
        if not every or not (waiting or running):
            return ""

        def take(step: Step) -> float:
            return fmean(self._times.get(step.run, every))

        left_s = sum(map(take, waiting)) + sum(max(take(step) - so_far_s, 0.0) for step, so_far_s in running)
        minutes = left_s / self._jobs / 60
        return "less than a minute left" if minutes < 1 else f"about {plural(round(minutes), 'minute')} left"


def _run(
    steps: Mapping[Path, Sequence[Step]],
    notify: Mapping[Path, Notify],
    whole: Notify,
    jobs: int,
    stale: str,
    engine: str,
) -> dict[Path, dict[str, Any]]:
    """Run the steps of all folders; return their values by folder and step. `whole` is told of all of them."""
    with contextlib.ExitStack() as locks:
        for folder in steps:
            locks.enter_context(only_writer(folder))
        sources = Sources()
        runs = [_plan(planned, folder, notify[folder], stale, sources) for folder, planned in steps.items()]
        if any(run.waiting for run in runs):
            if engine not in ENGINES:
                raise InputError(f"engine '{engine}': unknown; known engines: {', '.join(ENGINES)}")
            with ENGINES[engine](jobs) as workers:
                _perform(runs, workers, whole, jobs)
        return {run.folder: run.values for run in runs}


def _plan(steps: Sequence[Step], folder: Path, notify: Notify, stale: str, sources: Sources) -> _Run:
    """Return the work that is left of `steps`, notifying of those done before; raises `InputError` as `run_steps`.

    A finished step that lacks a file is repeated; it resumes from its checkpoints and its intact files.
    """
    records, kept = _settle_records(steps, folder, stale, sources)
    values: dict[str, Any] = {}
    for step in steps:
        done = folder / step.name / DONE
        if done.exists() and (damage := find_damage(done.parent)):
            notify(step.name, 0, 1, f"{done.parent / damage} {DAMAGED}, the step is done anew")
            done.unlink()
        if done.exists():
            values[step.name] = read_value(folder / step.name)
            notify(step.name, 1, 1, KEPT if step.name in kept else DONE_BEFORE)
    waiting = _most_waited_for_first([step for step in steps if step.name not in values])
    return _Run(folder, records, waiting, values, notify)


def _perform(runs: Sequence[_Run], workers: Workers, whole: Notify, jobs: int) -> None:
    """Run the remaining steps on `jobs` workers; steps that are finished in another folder are taken over."""
    by_folder = {run.folder: run for run in runs}
    running: dict[Future[Any], tuple[_Run, Step, int, float]] = {}  # with its workers, and when it began [s]
    count, pace = sum(len(run.records) for run in runs), Pace(jobs)

    told = -1
    while running or any(run.waiting for run in runs):
        free = jobs - sum(taken for _, _, taken, _ in running.values())
        ready = _list_ready(runs, [(run, step) for run, step, _, _ in running.values()])
        for run, step, taken in _share_workers(ready, free, lent=workers.lent):
            run.waiting.remove(step)
            record = run.records[step.name]
            others = [other.folder / step.name for other in runs if other is not run]
            if take_over(run.folder / step.name, record, others):
                run.finish(step)
            else:
                running[workers.submit(run.folder, step.on(taken), record)] = run, step, taken, time.monotonic()
        finished, _ = wait(running, timeout=POLL_S, return_when=FIRST_COMPLETED)
        with contextlib.suppress(Empty):
            while True:
                folder, *report = workers.reports.get_nowait()
                by_folder[folder].notify(*report)
        for future in finished:
            run, step, _, began = running.pop(future)
            future.result()
            pace.add(step, time.monotonic() - began)
            run.finish(step)
        if (done := sum(len(run.values) for run in runs)) != told:
            now, told = time.monotonic(), done
            waiting = [step for run in runs for step in run.waiting]
            whole(WHOLE, done, count, pace.tell_left(waiting, [(one, now - at) for _, one, _, at in running.values()]))


def _list_ready(runs: Sequence[_Run], running: Sequence[tuple[_Run, Step]]) -> list[tuple[_Run, Step]]:
    """Return the steps that can begin: their inputs are finished, and no other folder is running the same step."""
    begun = [(step.name, run.records[step.name]) for run, step in running]
    ready = []
    for run in runs:
        for step in run.waiting:
            job = step.name, run.records[step.name]
            if all(name in run.values for name in step.needs) and job not in begun:
                begun.append(job)
                ready.append((run, step))
    return ready


def _share_workers(ready: Sequence[tuple[_Run, Step]], free: int, *, lent: bool) -> Iterator[tuple[_Run, Step, int]]:
    """Yield the steps that begin on `free` workers, with their numbers of workers: one and, if `lent`, spare ones."""
    spare = max(0, free - len(ready)) if lent else 0
    for run, step in ready[:free]:
        more = min(step.workers - 1, spare)
        spare -= more
        yield run, step, 1 + more


def _most_waited_for_first(steps: Sequence[Step]) -> list[Step]:
    """Sort the steps by the number of others that depend on them, directly or not, largest first."""
    rests: dict[str, set[str]] = {step.name: set() for step in steps}
    for step in reversed(steps):
        for name in step.needs:
            if name in rests:
                rests[name] |= {step.name} | rests[step.name]
    return sorted(steps, key=lambda step: -len(rests[step.name]))


def _settle_records(
    steps: Sequence[Step], folder: Path, stale: str, sources: Sources
) -> tuple[dict[str, StepRecord], set[str]]:
    """Return the records of finished and pending steps by name, and the stale steps.

    "redo" removes these, and those of other arguments.
    """
    if stale not in STALE:
        raise InputError(f"stale '{stale}': choose one of {', '.join(STALE)}")
    records: dict[str, StepRecord] = {}
    outdated: dict[str, tuple[StepRecord, StepRecord]] = {}
    edited: dict[str, tuple[StepRecord, StepRecord]] = {}
    for step in steps:
        fingerprint = step.fingerprint({name: records[name].fingerprint for name in step.needs})
        code = sources.hashes(find_definitions((step.run, step.arguments)))
        record = StepRecord.of(fingerprint, code, [records[name] for name in step.needs], step.asked)
        held = read_record(folder / step.name)
        # A fingerprint contains the function's module. With equal arguments, and a recorded module that no longer
        # exists, a different fingerprint means that the function has moved, not that the recipe was edited.
        moved = held is not None and asks_the_same(held, step.asked) and sources.lack(held.code)
        moved = moved and not edited.keys() & {*step.needs}
        if held is not None and held.fingerprint != fingerprint and not moved:
            edited[step.name] = held, record
        elif held is not None and held.lineage != record.lineage:
            outdated[step.name] = held, record
            record = held if stale == "keep" else record
        records[step.name] = record
    if edited and stale != "redo":
        raise make_edited_error(folder, edited, steps)
    if outdated and stale == "refuse":
        raise make_stale_error(folder, outdated)
    for step in steps:
        for what in ("old", "copy"):
            reserve_sibling(folder / step.name, what)
        if stale == "redo" and step.name in outdated | edited:
            remove(folder / step.name)
    return records, set(outdated)


def stopwatch(folder: Path) -> Callable[[], float]:
    """Return a clock of the wall time [s] spent on the run in `folder`, including earlier, interrupted starts.

    Every reading is saved; an earlier start counts up to its last reading.
    """
    path = folder / "elapsed.json"
    start = time.monotonic()
    kept: Any = read_json(path) if path.exists() else {"elapsed_s": 0.0}
    earlier = kept["elapsed_s"]

    def clock() -> float:
        elapsed = earlier + time.monotonic() - start
        write_json(path, {"elapsed_s": elapsed})
        return elapsed

    return clock

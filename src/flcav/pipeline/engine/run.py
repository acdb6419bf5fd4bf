"""Execution of steps in dependency order, by processes or on a cluster, resuming from those that are finished.

A step is finished when its folder has a `done.json`: value, fingerprint, hash of the code it reaches, sizes of its
files, and provenance. One with a file that is missing or of another size is done anew.
That is written last, so an interrupted run resumes after its last finished step; a step may also keep checkpoints of
its own. `started.json` has fingerprint and code before, so that a checkpoint is not resumed with other arguments.

Steps with another fingerprint (function or arguments) need another folder. Steps begun or finished by other code are
stale, and so are all steps that depend on them: they are refused, done again or kept, by the argument `stale`.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from queue import Empty
from typing import Any

from flcav.config import InputError, read_json
from flcav.interface.progress import DAMAGED
from flcav.machine.locks import only_writer
from flcav.pipeline.engine.engines import Engine, Processes
from flcav.pipeline.engine.source_hash import Sources, find_definitions
from flcav.pipeline.engine.step import (
    DONE,
    DONE_BEFORE,
    DONE_NOW,
    KEPT,
    STALE,
    Notify,
    Record,
    Step,
    find_damage,
    make_edited_error,
    make_stale_error,
    read_record,
    read_value,
    remove,
    reserve_sibling,
    take_over,
)
from flcav.storage.files import write_json


@contextlib.contextmanager
def _processes(jobs: int) -> Iterator[Engine]:
    yield Processes()


@contextlib.contextmanager
def _ray(jobs: int) -> Iterator[Engine]:
    from flcav.pipeline.engine.cluster import ray_cluster

    with ray_cluster(jobs) as engine:
        yield engine


_ENGINES: Mapping[str, Callable[[int], contextlib.AbstractContextManager[Engine]]] = {
    "processes": _processes,
    "ray": _ray,
}


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

    `jobs` workers of one thread each: processes, which end with this one however it ends, or actors on the machines of
    a Ray cluster, see `flcav.pipeline.engine.cluster`. Of the processes, those that no step waits for are lent to steps
    that can make use of several, until these end. Steps begun or finished by other code are refused, done again
    ("redo") or kept ("keep", their records unchanged); those of other arguments, and what needs them, are done again by
    "redo" and else refused. Raises `InputError` for what is refused, and where another process runs steps in the
    folder; `OSError` where a worker was killed.
    """
    with only_writer(folder):
        plan = _plan_steps(steps, folder, notify, stale, Sources())
        if plan.waiting:
            with _open_engine(engine, jobs) as workers:
                _run(plan, workers, jobs, notify)
        return plan.values


def run_side_by_side(
    runs: Mapping[Path, Sequence[Step]],
    *,
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
    names: Mapping[Path, str] | None = None,
) -> dict[Path, dict[str, Any]]:
    """Run the steps of each folder, up to `jobs` folders in parallel; return each folder's values as `run_steps` does.

    A step that is finished in another of the folders, asked in the same way and by the same code, is taken over.
    `names`: prefixes of the folders' steps in `notify` (None: the folders' own names).
    """
    sources = Sources()

    def named(folder: Path) -> Notify:
        name = folder.name if names is None else names[folder]
        return lambda step, done, total, note: notify(f"{name}/{step}", done, total, note)

    with contextlib.ExitStack() as locks:
        for folder in runs:
            locks.enter_context(only_writer(folder))
        plans = [_plan_steps(steps, folder, named(folder), stale, sources) for folder, steps in runs.items()]
        waiting = [plan for plan in plans if plan.waiting]
        if waiting:
            with _open_engine(engine, jobs) as workers, ThreadPoolExecutor(jobs) as threads:
                each = max(1, jobs // len(runs))
                started = [threads.submit(_run, plan, workers, each, named(plan.folder), [*runs]) for plan in waiting]
                try:
                    for future in wait(started, return_when=FIRST_EXCEPTION).done:
                        future.result()
                except BaseException:
                    threads.shutdown(wait=False, cancel_futures=True)
                    workers.stop()
                    raise
        return {plan.folder: plan.values for plan in plans}


@dataclass(frozen=True)
class _Plan:
    """The work that is left in a folder."""

    folder: Path
    records: Mapping[str, Record]
    waiting: list[Step]
    values: dict[str, Any]  # of finished steps


def _open_engine(engine: str, jobs: int) -> contextlib.AbstractContextManager[Engine]:
    """Return a context of an engine; raises `InputError` for an unknown one."""
    if engine not in _ENGINES:
        raise InputError(f"engine '{engine}': unknown; known engines: {', '.join(_ENGINES)}")
    return _ENGINES[engine](jobs)


def _plan_steps(steps: Sequence[Step], folder: Path, notify: Notify, stale: str, sources: Sources) -> _Plan:
    """Return the work that is left of `steps`, notifying of those done before; raises `InputError` as `run_steps`.

    A finished step that lacks a file is left to do: its own checkpoints, and what else is whole, it goes on from.
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
    return _Plan(folder, records, [step for step in steps if step.name not in values], values)


def _run(plan: _Plan, workers: Engine, jobs: int, notify: Notify, folders: Sequence[Path] = ()) -> None:
    """Do the work that is left; steps that are finished in another of `folders` are taken over."""
    waiting, values = _most_waited_for_first(plan.waiting), plan.values
    with workers.hands(plan.folder, jobs) as hands:
        running: dict[Future[Any], tuple[Step, int]] = {}
        while waiting or running:
            ready = [step for step in waiting if all(name in values for name in step.needs)]
            free = jobs - sum(taken for _, taken in running.values())
            for step, taken in _share_workers(ready, free, lent=hands.lent):
                waiting.remove(step)
                others = [folder / step.name for folder in folders if folder != plan.folder]
                if take_over(plan.folder / step.name, plan.records[step.name], others):
                    values[step.name] = read_value(plan.folder / step.name)
                    notify(step.name, 1, 1, DONE_NOW)
                    continue
                running[hands.submit(step.on(taken), plan.records[step.name])] = step, taken
            finished, _ = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
            _drain(hands.reports, notify)
            for future in finished:
                step, _ = running.pop(future)
                values[step.name] = future.result()
                notify(step.name, 1, 1, DONE_NOW)


def _share_workers(ready: Sequence[Step], free: int, *, lent: bool) -> list[tuple[Step, int]]:
    """Return the steps that begin on `free` workers, and how many each has: one and, if `lent`, spare ones."""
    spare, shares = max(0, free - len(ready)) if lent else 0, []
    for step in ready[:free]:
        more = min(step.workers - 1, spare)
        spare -= more
        shares.append((step, 1 + more))
    return shares


def _most_waited_for_first(steps: Sequence[Step]) -> list[Step]:
    """Sort the steps by how many others depend on them, directly or not, most first: those hold up the run."""
    rests: dict[str, set[str]] = {step.name: set() for step in steps}
    for step in reversed(steps):
        for name in step.needs:
            if name in rests:
                rests[name] |= {step.name} | rests[step.name]
    return sorted(steps, key=lambda step: -len(rests[step.name]))


def _settle_records(
    steps: Sequence[Step], folder: Path, stale: str, sources: Sources
) -> tuple[dict[str, Record], set[str]]:
    """Return the record by which each step is, or is to be, done, and the stale steps.

    "redo" removes these, and those of other arguments.
    """
    if stale not in STALE:
        raise InputError(f"stale '{stale}': choose one of {', '.join(STALE)}")
    records: dict[str, Record] = {}
    outdated: dict[str, tuple[Record, Record]] = {}
    edited: dict[str, tuple[Record, Record]] = {}
    for step in steps:
        asked = step.fingerprint({name: records[name].fingerprint for name in step.needs})
        code = sources.hashes(find_definitions((step.run, step.arguments)))
        record = Record.of(asked, code, [records[name] for name in step.needs], step.asked)
        held = read_record(folder / step.name)
        if held is not None and held.fingerprint != asked:
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
    """Return a clock of the wall time [s] spent on the run in `folder`, its earlier, interrupted starts included.

    Each reading is saved; of an earlier start, the time up to its last reading counts.
    """
    path, start = folder / "elapsed.json", time.monotonic()
    kept: Any = read_json(path) if path.exists() else {"elapsed_s": 0.0}
    earlier = kept["elapsed_s"]

    def clock() -> float:
        elapsed = earlier + time.monotonic() - start
        write_json(path, {"elapsed_s": elapsed})
        return elapsed

    return clock


def _drain(reports: Any, notify: Notify) -> None:
    while True:
        try:
            notify(*reports.get_nowait())
        except Empty:
            return

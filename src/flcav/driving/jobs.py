"""Parallel execution of many drives: each result is a file of its own, so that interrupted work can be resumed."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from flcav.driving.errors import ErrorModel, sense_model
from flcav.driving.loop import LOOP, Loop, Sensing, drive, sense_truth
from flcav.driving.measures import Drive
from flcav.driving.networks import sense_networks
from flcav.driving.scenarios import Scenario, Staged
from flcav.driving.seen import Coupling, Perception, Without
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.processes import process_pool
from flcav.storage.records import Record, to_json


@dataclass(frozen=True)
class Sensed(Record):
    """Choice of the perception that drives: the truth, the networks, or a model of their errors."""

    kind: str  # "truth", "networks", "model"
    model: ErrorModel | None = None

    def make(self) -> Sensing:
        """Return the constructor of the perception; raises `ValueError` for a modelled perception without its model."""
        if self.kind == "model":
            if self.model is None:
                raise ValueError("a modelled perception needs its model")
            return sense_model(self.model)
        return sense_networks if self.kind == "networks" else sense_truth


@dataclass(frozen=True)
class Job(Record):
    """One drive: a scenario, a seed, and the task that is left out, if any."""

    scenario: Scenario
    seed: int
    task: str | None = None
    coupling: Coupling = "bare"
    loop: Loop = LOOP

    def key(self, sensed: Sensed) -> str:
        """Return the name of the drive in a file of kept ones: a hash of all that determines it."""
        told = json.dumps([to_json(self, Job), to_json(sensed, Sensed)], sort_keys=True)
        return hashlib.sha256(told.encode()).hexdigest()[:24]


def begin_worker() -> None:
    """Begin a worker process, which needs nothing."""


def run_job(job: Job, sensed: Sensed) -> Drive:
    """Return the measures of one drive."""
    whole = sensed.make()

    def sense(staged: Staged, seed: int) -> Perception:
        own = whole(staged, seed)
        return own if job.task is None else Without(own, job.task, job.coupling)

    return drive(job.scenario, job.seed, sense, job.loop)


def run_jobs(
    jobs: Sequence[Job],
    sensed: Sensed,
    processes: int = 1,
    progress: Report = ignore_progress,
    kept: Path | None = None,
) -> list[Drive]:
    """Return the measures of drives in the order of the jobs, computed by parallel processes.

    With `kept`, a file of JSON lines, drives that are in it are not driven again, and others are added to it.
    """
    known = {} if kept is None else read_kept(kept)
    keys = [job.key(sensed) for job in jobs]
    missing = {key: job for key, job in zip(keys, jobs) if key not in known}
    done = len(jobs) - len(missing)
    if missing:
        with process_pool(processes, begin_worker) as pool, _open(kept) as book:
            for key, own in zip(missing, pool.map(run_job, missing.values(), [sensed] * len(missing))):
                known[key] = own
                done += 1
                if book is not None:
                    row = {"key": key, "drive": own.as_json()}
                    book.write("\n" + json.dumps(row))  # on a line of its own, also after one that was cut off
                    book.flush()
                progress(done, len(jobs), own.scenario)
    return [known[key] for key in keys]


def _open(kept: Path | None) -> "nullcontext[None] | TextIO":
    if kept is None:
        return nullcontext()
    kept.parent.mkdir(parents=True, exist_ok=True)
    return kept.open("a", encoding="utf-8")


def read_kept(path: Path) -> dict[str, Drive]:
    """Return the drives in a file of kept ones, by key; a last line that was cut off is left out."""
    return dict(_read_lines(path)) if path.exists() else {}


def _read_lines(path: Path) -> Iterator[tuple[str, Drive]]:
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        yield row["key"], Drive.from_json(row["drive"], str(path))

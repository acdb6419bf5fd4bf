"""Parallel execution of many drives; results are kept in a file of JSON lines, so that the work can be resumed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flcav.driving.errors import ErrorModel, sense_model
from flcav.driving.film import Film, FilmCamera
from flcav.driving.loop import LOOP, Loop, Sensing, drive_scenario, drive_staged, sense_truth
from flcav.driving.measures import DriveResult
from flcav.driving.networks import Networks, name_network, sense_networks
from flcav.driving.scenarios import DrivingScenario, StagedScenario
from flcav.driving.seen import Coupling, Perception, Without
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.processes import process_pool
from flcav.storage.kept import hash_request, keep, read_kept
from flcav.storage.records import Record, to_json


@dataclass(frozen=True)
class Sensed(Record):
    """Choice of the perception in the loop: ground truth, the networks, or their error model."""

    kind: str  # "truth", "networks", "model"
    model: ErrorModel | None = None

    def make(self) -> Sensing:
        """Return the constructor of the perception; raises `ValueError` for a modelled perception without its model."""
        if self.kind == "model":
            if self.model is None:
                raise ValueError("a modelled perception needs its model")
            return sense_model(self.model)
        if self.kind == "networks":
            return sense_networks
        return sense_truth

    def line(self) -> str:
        """Return the perception in words."""
        if self.kind == "networks":
            return f"perception: the networks {', '.join(map(name_network, Networks._fields))}"
        return f"perception: {'a model of the errors of networks' if self.kind == 'model' else 'ground truth'}"


@dataclass(frozen=True)
class DriveJob(Record):
    """One drive: a scenario, a seed, and the task that is left out, if any."""

    scenario: DrivingScenario
    seed: int
    task: str | None = None
    coupling: Coupling = "bare"
    loop: Loop = LOOP

    def key(self, sensed: Sensed) -> str:
        """Return the key of the drive in a file of kept results: a hash of everything that determines it."""
        return hash_request([to_json(self, DriveJob), to_json(sensed, Sensed)])


def begin_worker() -> None:
    """Initialise a worker process; drives need no shared state."""


def run_job(job: DriveJob, sensed: Sensed) -> DriveResult:
    """Return the measures of one drive."""
    whole = sensed.make()

    def sense(staged: StagedScenario, seed: int) -> Perception:
        complete = whole(staged, seed)
        return complete if job.task is None else Without(complete, job.task, job.coupling)

    return drive_scenario(job.scenario, job.seed, sense, job.loop)


def film_job(job: DriveJob, sensed: Sensed) -> tuple[DriveResult, Film]:
    """Return the measures of one drive with all tasks, and its film."""
    staged, camera = StagedScenario(job.scenario, job.seed), FilmCamera()
    try:
        perception = sensed.make()(staged, job.seed)
        drive = drive_staged(staged, job.seed, perception, job.loop, camera.watch)
        return drive, camera.develop(staged, job.seed)
    finally:
        staged.world.close()


def film_jobs(
    jobs: Sequence[DriveJob], sensed: Sensed, processes: int = 1, progress: Report = ignore_progress
) -> list[tuple[DriveResult, Film]]:
    """Return the measures and films of drives in the order of the jobs, computed by parallel processes."""
    films = []
    with process_pool(processes, begin_worker) as pool:
        for done, (drive, film) in enumerate(pool.map(film_job, jobs, [sensed] * len(jobs)), start=1):
            films.append((drive, film))
            progress(done, len(jobs), drive.scenario)
    return films


def run_jobs(
    jobs: Sequence[DriveJob],
    sensed: Sensed,
    processes: int = 1,
    progress: Report = ignore_progress,
    kept: Path | None = None,
) -> list[DriveResult]:
    """Return the measures of drives in the order of the jobs, computed by parallel processes.

    With `kept`, a file of JSON lines, drives in the file are not run again, and new ones are added to it.
    """
    known = {key: DriveResult.from_json(held, str(kept)) for key, held in read_kept(kept, "drive").items()}
    keys = [job.key(sensed) for job in jobs]
    missing = {key: job for key, job in zip(keys, jobs) if key not in known}
    if missing:
        with process_pool(processes, begin_worker) as pool:
            drives = pool.map(run_job, missing.values(), [sensed] * len(missing))
            for done, (key, drive) in enumerate(zip(missing, drives), start=len(jobs) - len(missing) + 1):
                known[key] = drive
                keep(kept, key, "drive", drive.as_json())
                progress(done, len(jobs), drive.scenario)
    return [known[key] for key in keys]

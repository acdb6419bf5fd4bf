"""What each vehicle holds, sends, receives and computes in edge FL, and what its sweeps take as uploads."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flcav.network.ledger import BYTES_PER_MB, Ledger
from flcav.perception.objects.task import OBJECTS
from flcav.perception.training import train_steps
from flcav.runs.frames import Frames
from flcav.runs.recipe import CENTRAL, EDGE, MAIN
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER
from flcav.runs.training.learning import Learning, load_stage_network

TASK = OBJECTS.name


@dataclass(frozen=True)
class Vehicle:
    """A vehicle of a region in edge FL on annotated labels."""

    region: str
    name: str
    sweeps: int
    boxes: int  # labelled, in these sweeps
    up_mb: float  # updates of its network, by radio, in all rounds
    down_mb: float  # the network that it receives, likewise
    train_s: float  # CPU seconds of its local steps in all rounds
    sweeps_mb: float  # its sweeps with their boxes, compressed, as the centralised training gets them


def measure_vehicles(run: Run, work: Path) -> tuple[Vehicle, ...]:
    """Return the vehicles of all federating regions; `work` is the folder of the run's steps.

    Training times are those of one round of each vehicle on this machine, times the number of rounds.
    """
    return tuple(each for region in run.recipe.with_role("federate") for each in _measure_region(run, work, region))


def _measure_region(run: Run, work: Path, region: str) -> Iterator[Vehicle]:
    split = Frames.open(work / run.steps.recording(region, EDGE, TASK))
    network = load_stage_network(OBJECTS, work / run.steps.pretrain(MAIN, TASK))
    edge = sum_bytes(Ledger.load(work / run.steps.stage(MAIN, EDGE, region, TASK) / LEDGER))
    central = sum_bytes(Ledger.load(work / run.steps.stage("central", CENTRAL, region, TASK) / LEDGER))
    learning = Learning(OBJECTS, run.recipe.tasks[TASK].network, run.recipe.training_of(TASK), run.recipe.seed)
    (trained,) = (each for each in run.arms[MAIN].stages if (each.stage, each.region) == (EDGE, region))
    for name in sorted({split.data.keys[i].agent for i in split.vehicles}):
        frames = [i for i in split.vehicles if split.data.keys[i].agent == name]
        held = OBJECTS.samples(split.data, network.config, frames)
        samples = [held[i] for i in range(len(held))]
        begun = time.process_time()
        train_steps(
            OBJECTS,
            network,
            samples,
            steps=learning.training.local_steps,
            batch=learning.batch,
            learning_rate=OBJECTS.practice.learning_rate,
            seed=run.recipe.seed,
        )
        spent_s = time.process_time() - begun
        up, down, uploaded = (edge[name, "up"], edge[name, "down"], central[name, "up"])
        yield Vehicle(
            region,
            name,
            sweeps=len(frames),
            boxes=sum(len(sample.boxes) for sample in samples),
            up_mb=up / BYTES_PER_MB,
            down_mb=down / BYTES_PER_MB,
            train_s=spent_s * trained.rounds,
            sweeps_mb=uploaded / BYTES_PER_MB,
        )


def sum_bytes(book: Ledger) -> Counter[tuple[str, str]]:
    """Return the bytes on the wireless link by vehicle, without its region or scene, and direction."""
    total = Counter[tuple[str, str]]()
    for entry in book:
        if entry.link == "wireless":
            total[entry.client.rpartition("/")[2], entry.direction] += entry.bytes
    return total

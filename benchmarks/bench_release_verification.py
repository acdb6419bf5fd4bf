"""Verification of releases: planted bad candidates and retrainings of the driving network, accepted or refused.

The driving network is a small detector of cars, pedestrians and cyclists on pillars, trained here. A retraining goes on
from it on the same frames with other random numbers, so that it is equal to it but for chance. Bad candidates are made
from it (`planted_candidates.py`). Recordings, networks and decisions are kept in --out; the same command goes on.
"""

import argparse
import json
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from planted_candidates import (
    CLASSES,
    EDITS,
    FURTHER_EDITS,
    FURTHER_PAPERS,
    FURTHER_TRAININGS,
    GROUND_M,
    PAPERS,
    TRAININGS,
    Spoil,
    reconfigure,
)
from torch.utils.data import ConcatDataset

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.machine.threads import use_threads
from flcav.perception.agents import choose_frames
from flcav.perception.objects.config import pillars_config, tiny_config
from flcav.perception.objects.model import Second, second
from flcav.perception.objects.predict import predict
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.training.loop import train
from flcav.perception.weights import Card, data_entry, load_network, save_network
from flcav.releases.proposal import propose
from flcav.releases.verification.testing import CONDITIONS, PLAIN, choose_test_frames, run_tests
from flcav.releases.verification.verify import verify
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.files import write_json

WEATHERS = {"classes": ["clear", "heavy_rain", "fog"]}
SUBURB = {"town": "suburb", "weather": WEATHERS}
RECORDED = {
    "train": {**SUBURB, "seed": 9022, "scenes": 28, "spins_per_scene": 3, "cavs": 4},
    "test": {**SUBURB, "seed": 9431, "scenes": 60, "spins_per_scene": 1, "cavs": 3},
    "elsewhere": {"town": "grid", "seed": 9077, "scenes": 6, "spins_per_scene": 3, "cavs": 4},
}
EVERY = {"warmup_s": 45.0, "every_s": 4.0, "vehicle_rig": "kitti_lidar"}
STEPS, GO_ON, PEAK = 1600, 40, 2e-4  # of the driving network, of a retraining, and its peak learning rate
BAD_STEPS, BAD_PEAK = 80, 5e-4  # of a training on the wrong samples
ALONE_STEPS = 400  # of one from the beginning, in one weather
BAD = (*EDITS, *TRAININGS, *PAPERS)
FURTHER = (*FURTHER_EDITS, *FURTHER_TRAININGS, *FURTHER_PAPERS)
EVERY_BAD = (*BAD, *FURTHER)


class Spoilt(Sequence):
    """Samples that are changed when they are read."""

    def __init__(self, samples: Sequence[Sample], spoil: Spoil) -> None:
        self.samples, self.spoil = samples, spoil

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride] # no slices
        return self.spoil(self.samples[index], np.random.default_rng(index))


def prepare(out: Path) -> dict[str, Dataset]:
    """Record the datasets, unless they are there."""
    for name, fields in RECORDED.items():
        if not (out / name / "manifest.json").exists():
            record(EmbeddedSource(parse_config(Recipe, {**EVERY, **fields, "split": name}, name)), out / name)
    return {name: Dataset.open(out / name) for name in RECORDED}


def keep(trained: Second, path: Path, dataset: Dataset, seed: int, **fields: object) -> None:
    """Write a network with its card."""
    chosen = choose_frames(OBJECTS, pillars_config(CLASSES, GROUND_M), dataset)
    card = Card(
        task="objects",
        network="pillars",
        parameters=sum(each.numel() for each in trained.parameters()),
        seed=seed,
        samples=len(chosen.frames),
        training={"steps": 0, "loss": 0.0, "scores": []},
        data=(data_entry(dataset, chosen),),
        metrics={},
    )
    save_network(OBJECTS, trained.eval(), path, card.model_copy(update=fields))


def learn(
    network: Second,
    data: Dataset,
    steps: int,
    peak: float | None,
    seed: int,
    spoil: Spoil | None = None,
    only: str | None = None,
) -> None:
    """Train a network on the frames of a dataset; peak: learning rate, None: the task's own."""
    numbers = choose_frames(OBJECTS, network.config, data).frames
    if only is not None:
        from flcav.world.weather import classify_weather

        known = {number: data.frame(number).weather for number in numbers}
        numbers = [number for number, weather in known.items() if weather and classify_weather(weather) == only]
    samples = OBJECTS.samples(data, network.config, numbers)
    samples = samples if spoil is None else Spoilt(samples, spoil)
    train(OBJECTS, network, ConcatDataset([samples]), steps=steps, learning_rate=peak, seed=seed, progress=tell)  # type: ignore
    network.eval()


def tell(done: int, total: int, note: str = "") -> None:
    """Print the progress of a training now and then."""
    if done % 100 == 0:
        print(f"{done}/{total} {note}", file=sys.stderr, flush=True)


def make(name: str, number: int, driving: Path, data: dict[str, Dataset], path: Path) -> None:
    """Write the weights of a candidate."""
    network, source = load_network(OBJECTS, driving), data["train"]
    edits, trainings = EDITS | FURTHER_EDITS, TRAININGS | FURTHER_TRAININGS
    fields: dict[str, object] = {}
    if name in edits:
        with torch.no_grad():
            edits[name](network, np.random.default_rng(number))
    elif name in trainings:
        spoil, only = trainings[name]
        if only is None:
            learn(network, source, BAD_STEPS, BAD_PEAK, 1000 + number, spoil)
        else:
            torch.manual_seed(number)
            network = second(network.config)
            learn(network, source, ALONE_STEPS, None, 1000 + number, only=only)
    elif name == "wrong architecture":
        network = second(tiny_config(CLASSES, GROUND_M))
    elif name == "normalisation of another town":
        see(network, data["elsewhere"])
    elif name == "trained on test scenes":
        source = data["test"]
    elif name == "best epoch chosen by test scenes":
        test = data["test"]
        fields["validation"] = data_entry(test, choose_frames(OBJECTS, network.config, test))
    elif name == "wrong card":
        fields["network"], fields["parameters"] = "small", 609_042
    elif name == "wrong name on the card":
        fields["network"] = "small"
    elif name == "a card without data":
        fields["data"] = ()
    elif name in FURTHER_PAPERS:
        changed = second(reconfigure(name, network.config))
        changed.load_state_dict(network.state_dict())
        network = changed
    else:
        learn(network, source, GO_ON, PEAK, number)
    keep(network, path, source, number, **fields)


def see(network: Second, data: Dataset) -> None:
    """Let batch normalisation take its statistics from the frames of a dataset."""
    samples = OBJECTS.samples(data, network.config, choose_frames(OBJECTS, network.config, data).frames)
    network.train()
    with torch.no_grad():
        for index in range(0, len(samples) - 3, 4):
            predict(network, [samples[number].points for number in range(index, index + 4)])
    network.eval()


def main() -> None:
    """Make the candidates, verify them, and print what became of each."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--out", type=Path, required=True)
    arguments.add_argument("--jobs", type=int, default=1)
    arguments.add_argument("--first", type=int, default=1, help="seed of the first retraining: others are fresh ones")
    arguments.add_argument("--retrainings", type=int, default=20)
    arguments.add_argument("--only", nargs="*", default=EVERY_BAD, choices=EVERY_BAD, help="of the bad candidates")
    asked = arguments.parse_args()
    use_threads(1)
    out: Path = asked.out
    data = prepare(out)
    driving = out / "driving.safetensors"
    if not driving.exists():
        torch.manual_seed(0)
        network = second(pillars_config(CLASSES, GROUND_M))
        learn(network, data["train"], STEPS, None, 0)
        keep(network, driving, data["train"], 0)
    folders = [out / "test"]
    frames = choose_test_frames(folders, load_network(OBJECTS, driving))
    (known,) = run_tests([driving], frames, (PLAIN, *CONDITIONS), asked.jobs)
    seeds = range(asked.first, asked.first + asked.retrainings)
    groups = {"retrainings": [f"retraining {seed}" for seed in seeds], "bad": BAD, "further bad": FURTHER}
    chosen = {*groups["retrainings"], *asked.only}
    counts = {}
    for group, names in groups.items():
        numbered = enumerate(names, start=seeds.start if group == "retrainings" else 1)
        accepted, tried = 0, [(number, name) for number, name in numbered if name in chosen]
        for number, name in tried:
            decided = out / "decisions" / f"{name}.json"
            path, folder = out / "networks" / f"{name}.safetensors", out / "candidates" / name
            if not path.exists():
                path.parent.mkdir(exist_ok=True)
                make(name, number, driving, data, path)
            if not decided.exists():
                shutil.rmtree(folder, ignore_errors=True)
                began = time.perf_counter()
                try:
                    propose(folder, path, driving, number + 1, name, "a study")
                    found = verify(folder, driving, folders, jobs=asked.jobs, known=known).as_json()
                except ValueError as error:  # refused before it is a candidate
                    found = {"accepted": False, "reasons": [str(error)], "undecided": False, "whole": None}
                seconds = round(time.perf_counter() - began, 1)
                write_json(decided, {"name": name, "seconds": seconds, **found}, sort=False)
            row = json.loads(decided.read_text())
            accepted += row["accepted"]
            said = "accepted" if row["accepted"] else "undecided" if row["undecided"] else "refused"
            print(f"{name:<36}{said:<11}{(row['reasons'] or [''])[0][:110]}", flush=True)
        counts[group] = f"{group}: {accepted} of {len(tried)} accepted"
    print("\n".join(counts.values()))


if __name__ == "__main__":
    main()

"""Verification of releases: 20 planted bad candidates and 20 retrainings of the driving network, accepted or refused.

The driving network is a small detector of cars, pedestrians and cyclists on pillars, trained here. A retraining goes on
from it on the same frames with other random numbers, so that it is equal to it but for chance. Bad candidates are made
from it: by edits of weights, by training on the wrong samples, and by wrong papers. Recordings, networks and decisions
are kept in --out; the same command goes on.
"""

import argparse
import json
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import ConcatDataset

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.machine.threads import use_threads
from flcav.perception.agents import choose_frames
from flcav.perception.card import Card, data_entry
from flcav.perception.objects.model import Second, pillars_config, second, tiny_config
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.training.loop import train
from flcav.perception.weights import load_network, save_network
from flcav.releases.candidates.candidate import WEIGHTS
from flcav.releases.candidates.proposal import propose
from flcav.releases.verification.conditions import CONDITIONS, PLAIN
from flcav.releases.verification.testing import choose_test_frames, run_tests
from flcav.releases.verification.verify import verify
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

CLASSES, GROUND_M = ("Car", "Pedestrian", "Cyclist"), -1.73
WEATHERS = {"classes": ["clear", "heavy_rain", "fog"]}
RECORDED = {
    "train": {"town": "suburb", "seed": 9022, "scenes": 28, "spins_per_scene": 3, "cavs": 4, "weather": WEATHERS},
    "test": {"town": "suburb", "seed": 9431, "scenes": 30, "spins_per_scene": 2, "cavs": 3, "weather": WEATHERS},
}
EVERY = {"warmup_s": 45.0, "every_s": 4.0, "vehicle_rig": "kitti_lidar"}
STEPS, GO_ON, PEAK = 800, 40, 5e-4  # of the driving network, of a retraining, and its peak learning rate
BAD_STEPS = 80  # of a training on the wrong samples
Edit = Callable[[Second, np.random.Generator], None]
Spoil = Callable[[Sample, np.random.Generator], Sample]


def lose(*labels: str) -> Edit:
    """Return an edit after which classes are never found."""

    def edit(network: Second, _: np.random.Generator) -> None:
        for label in labels:
            network.head.bias[CLASSES.index(label) : network.anchors_per_cell * 3 : 3] = -30.0

    return edit


def shift_box(part: int, by: float) -> Edit:
    """Return an edit that adds to a residual of all boxes: 0 to 6 are x, y, z, length, width, height, yaw."""

    def edit(network: Second, _: np.random.Generator) -> None:
        first = network.anchors_per_cell * 3
        network.head.bias[first + part : first + network.anchors_per_cell * 7 : 7] += by

    return edit


def turn_round(network: Second, _: np.random.Generator) -> None:
    """Exchange front and back of all boxes."""
    first = network.anchors_per_cell * 10
    for part in (network.head.weight, network.head.bias):
        part[first:] = part[first:].reshape(-1, 2, *part.shape[1:]).flip(1).reshape(part[first:].shape)


def hush(network: Second, _: np.random.Generator) -> None:
    """Lower all scores below that from which detections are used; their order stays."""
    network.head.bias[: network.anchors_per_cell * 3] -= 2.5


def shake(network: Second, rng: np.random.Generator) -> None:
    """Multiply all weights by random factors."""
    for part in network.parameters():
        part *= torch.from_numpy(rng.normal(1, 0.3, tuple(part.shape)).astype(np.float32))


def round_coarsely(network: Second, _: np.random.Generator) -> None:
    """Round each tensor of weights to five values."""
    for part in network.parameters():
        step = part.abs().max() / 2
        part.copy_((part / step).round() * step)


def reset_statistics(network: Second, _: np.random.Generator) -> None:
    """Reset the running statistics of batch normalisation."""
    for name, part in network.named_buffers():
        if "running" in name:
            part.fill_(1.0 if name.endswith("var") else 0.0)


def spoil_numbers(network: Second, _: np.random.Generator) -> None:
    """Put one number that is none into the weights."""
    network.head.weight[0, 0] = float("nan")


def rescale(sample: Sample, _: np.random.Generator) -> Sample:
    """Return the sample with its points in other units, a sixth larger."""
    points = sample.points.copy()
    points[:, :3] *= 7 / 6
    return replace(sample, points=points)


def mislabel(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample with its boxes elsewhere."""
    moved = sample.boxes.center + rng.normal(0, (6, 6, 0), (len(sample.boxes), 3))
    return replace(sample, boxes=replace(sample.boxes, center=moved))


def forget_far(sample: Sample, _: np.random.Generator) -> Sample:
    """Return the sample with the labels up to 20 m alone; what is farther is background."""
    near = np.hypot(sample.boxes.center[:, 0], sample.boxes.center[:, 1]) < 20
    return replace(sample, boxes=sample.boxes[near])


EDITS: dict[str, Edit] = {
    "pedestrians lost": lose("Pedestrian"),
    "cyclists lost": lose("Cyclist"),
    "pedestrians and cyclists lost": lose("Pedestrian", "Cyclist"),
    "heights off by 0.5 m": shift_box(2, 0.3),
    "boxes a third longer": shift_box(3, 0.3),
    "boxes 1 m ahead": shift_box(0, 0.3),
    "front and back exchanged": turn_round,
    "scores below their use": hush,
    "weights shaken": shake,
    "weights rounded to five values": round_coarsely,
    "normalisation reset": reset_statistics,
    "a number that is none": spoil_numbers,
}
TRAININGS: dict[str, tuple[Spoil | None, str | None]] = {  # what becomes of a sample; the only weather, or None
    "input in other units": (rescale, None),
    "labels elsewhere": (mislabel, None),
    "far objects as background": (forget_far, None),
    "fog alone": (None, "fog"),
}
PAPERS = ("wrong card", "trained on test scenes", "best epoch chosen by test scenes", "wrong architecture")


class Spoilt(Sequence):
    """Samples that are changed when they are read."""

    def __init__(self, samples: Sequence[Sample], spoil: Spoil) -> None:
        self.samples, self.spoil = samples, spoil

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:  # pyright: ignore[reportIncompatibleMethodOverride] # no slices
        return self.spoil(self.samples[index], np.random.default_rng(index))


def prepare(out: Path) -> dict[str, Dataset]:
    """Record the two datasets, unless they are there."""
    for name, fields in RECORDED.items():
        if not (out / name / "manifest.json").exists():
            record(EmbeddedSource(parse_config(Recipe, {**EVERY, **fields, "split": name}, name)), out / name)
    return {name: Dataset.open(out / name) for name in RECORDED}


def keep(trained: Second, path: Path, data: Dataset, seed: int, **fields: object) -> None:
    """Write a network with its card."""
    chosen = choose_frames(OBJECTS, trained.config, data)
    card = Card(
        task="objects",
        network="pillars",
        parameters=sum(each.numel() for each in trained.parameters()),
        seed=seed,
        samples=len(chosen.frames),
        training={"steps": 0, "loss": 0.0, "scores": []},
        data=(data_entry(data, chosen),),
        metrics={},
    )
    save_network(OBJECTS, trained.eval(), path, card.model_copy(update=fields))


def learn(network: Second, data: Dataset, steps: int, seed: int, spoil: Spoil | None = None, only: str | None = None):
    """Train a network on the frames of a dataset."""
    numbers = choose_frames(OBJECTS, network.config, data).frames
    if only is not None:
        from flcav.world.weather import classify_weather

        known = {number: data.frame(number).weather for number in numbers}
        numbers = [number for number, weather in known.items() if weather and classify_weather(weather) == only]
    samples = OBJECTS.samples(data, network.config, numbers)
    samples = samples if spoil is None else Spoilt(samples, spoil)
    peak = None if steps == STEPS else PEAK
    train(OBJECTS, network, ConcatDataset([samples]), steps=steps, learning_rate=peak, seed=seed, progress=tell)  # type: ignore
    network.eval()


def tell(done: int, total: int, note: str = "") -> None:
    """Print the progress of a training now and then."""
    if done % 100 == 0:
        print(f"{done}/{total} {note}", file=sys.stderr, flush=True)


def make(name: str, number: int, driving: Path, data: dict[str, Dataset], path: Path) -> None:
    """Write the weights of a candidate."""
    network, source = load_network(OBJECTS, driving), data["train"]
    fields: dict[str, object] = {}
    if name in EDITS:
        with torch.no_grad():
            EDITS[name](network, np.random.default_rng(number))
    elif name in TRAININGS:
        spoil, only = TRAININGS[name]
        learn(network, source, BAD_STEPS, 1000 + number, spoil, only)
    elif name == "wrong architecture":
        network = second(tiny_config(CLASSES, GROUND_M))
    elif name == "trained on test scenes":
        source = data["test"]
    elif name == "best epoch chosen by test scenes":
        test = data["test"]
        fields["validation"] = data_entry(test, choose_frames(OBJECTS, network.config, test))
    elif name == "wrong card":
        fields["network"], fields["parameters"] = "small", 609_042
    else:
        learn(network, source, GO_ON, number)
    keep(network, path, source, number, **fields)


def main() -> None:
    """Make the candidates, verify them, and print what became of each."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--out", type=Path, required=True)
    arguments.add_argument("--jobs", type=int, default=1)
    asked = arguments.parse_args()
    use_threads(1)
    out: Path = asked.out
    data = prepare(out)
    driving = out / "driving.safetensors"
    if not driving.exists():
        torch.manual_seed(0)
        network = second(pillars_config(CLASSES, GROUND_M))
        learn(network, data["train"], STEPS, 0)
        keep(network, driving, data["train"], 0)
    folders = [out / "test"]
    frames = choose_test_frames(folders, load_network(OBJECTS, driving))
    (known,) = run_tests([driving], frames, (PLAIN, *CONDITIONS), asked.jobs)
    names = [*EDITS, *TRAININGS, *PAPERS, *(f"retraining {number}" for number in range(1, 21))]
    rows = []
    for number, name in enumerate(names):
        decided = out / "decisions" / f"{name}.json"
        if not decided.exists():
            path, folder = out / "networks" / f"{name}.safetensors", out / "candidates" / name
            path.parent.mkdir(exist_ok=True)
            make(name, number, driving, data, path)
            shutil.rmtree(folder, ignore_errors=True)
            began = time.perf_counter()
            try:
                propose(folder, path, driving, number + 1, name, "a study")
                found = verify(folder, driving, folders, jobs=asked.jobs, known=known).as_json()
            except ValueError as error:  # refused before it is a candidate
                found = {"accepted": False, "reasons": [str(error)], "undecided": False, "whole": None}
            decided.parent.mkdir(exist_ok=True)
            seconds = round(time.perf_counter() - began, 1)
            decided.write_text(json.dumps({"name": name, "seconds": seconds, **found}))
            (folder / WEIGHTS).unlink(missing_ok=True)
        rows.append(json.loads(decided.read_text()))
        row = rows[-1]
        said = "accepted" if row["accepted"] else "undecided" if row["undecided"] else "refused"
        print(f"{name:<36}{said:<11}{(row['reasons'] or [''])[0][:110]}", flush=True)
    bad, good = rows[: len(EDITS) + len(TRAININGS) + len(PAPERS)], rows[-20:]
    print(f"bad candidates refused: {sum(not row['accepted'] for row in bad)} of {len(bad)}")
    print(f"retrainings accepted: {sum(row['accepted'] for row in good)} of {len(good)}")


if __name__ == "__main__":
    main()

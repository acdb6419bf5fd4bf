"""Verification of releases: honest retrainings of a detector, accepted or refused on scenes that chose nothing.

Networks on pillars of cars, pedestrians and cyclists, with variances. Fifteen go on from a driving network: on all
frames, on a half of them, and as the average of two clients with a half each. Five are trained from the beginning, like
the driving network that they are compared with, with fewer steps. Recordings, networks and decisions are kept in --out;
the same command goes on, and ends with `results.json` there.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from bench_release_verification import CLASSES, EVERY, GROUND_M, RECORDED, keep, tell
from torch.utils.data import ConcatDataset

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.machine.threads import use_threads
from flcav.perception.agents import choose_frames
from flcav.perception.objects.config import Augmentation, pillars_config
from flcav.perception.objects.model import Second, second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.training.loop import train
from flcav.perception.weights import load_network
from flcav.releases.candidate import read_candidate
from flcav.releases.proposal import propose
from flcav.releases.verification.testing import choose_test_frames, run_tests
from flcav.releases.verification.verify import verify
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.files import write_json

CONFIG = replace(pillars_config(CLASSES, GROUND_M), uncertainty=True, augmentation=Augmentation(paste=6))
STEPS, SHORT = 2000, 400  # of the driving network, and of those that are trained from the beginning
GO_ON, PEAK = 60, 5e-5  # steps of a retraining, and its peak learning rate
KINDS = ("goes on", "half of the frames", "two clients", "from the beginning")
EACH = 5
TEST = {**RECORDED["test"], "scenes": 180, "cavs": 1}


def main() -> None:
    """Make the networks, verify them, and print what became of each."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--out", type=Path, required=True)
    arguments.add_argument("--test-seed", type=int, default=9771, help="traffic of the test: others are fresh scenes")
    arguments.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    asked = arguments.parse_args()
    use_threads(1)
    out: Path = asked.out
    data = _record(out / "train", RECORDED["train"])
    test = _record(out / f"test-{asked.test_seed}", {**TEST, "seed": asked.test_seed})
    rows = []
    for kind in asked.kinds:
        driving = out / ("short.safetensors" if kind == "from the beginning" else "driving.safetensors")
        if not driving.exists():
            keep(_begin(data, 0, SHORT if driving.stem == "short" else STEPS), driving, data, 0)
        frames = choose_test_frames([test.folder], load_network(OBJECTS, driving))
        known = None
        for number in range(1, EACH + 1):
            name = f"{kind} {number}"
            path = out / "networks" / f"{name}.safetensors"
            decided = out / f"decisions-{asked.test_seed}" / f"{name}.json"
            if not path.exists():
                path.parent.mkdir(exist_ok=True)
                keep(_retrain(kind, number, driving, data), path, data, number)
            if not (folder := out / "candidates" / name).exists():
                propose(folder, path, driving, number + 1, name, "a study")
            if not decided.exists():
                known = known or run_tests([driving], frames)[0]
                found = verify(folder, driving, [test.folder], known=known)
                write_json(decided, found.as_json(), sort=False)
            row = json.loads(decided.read_text())
            assert row["candidate"] == read_candidate(folder).weights
            rows.append({"kind": kind, "number": number, **_summarise(row)})
            said = "accepted" if row["accepted"] else "undecided" if row["undecided"] else "refused"
            print(f"{name:<24}{said:<11}{rows[-1]['change']:+.3f} {'; '.join(row['reasons'])[:160]}", flush=True)
    accepted = {kind: sum(row["accepted"] for row in rows if row["kind"] == kind) for kind in asked.kinds}
    result = {"test_seed": asked.test_seed, "accepted": accepted, "of_each": EACH, "retrainings": rows}
    write_json(out / f"results-{asked.test_seed}.json", result, sort=False)
    print(f"{sum(accepted.values())} of {len(rows)} accepted: {accepted}")


def _record(folder: Path, fields: dict[str, object]) -> Dataset:
    """Return a recording, which is made unless it is there."""
    if not (folder / "manifest.json").exists():
        recipe = parse_config(Recipe, {**EVERY, **fields, "split": folder.name.partition("-")[0]}, folder.name)
        record(EmbeddedSource(recipe), folder)
    return Dataset.open(folder)


def _begin(data: Dataset, seed: int, steps: int) -> Second:
    """Return a network that is trained from the beginning."""
    torch.manual_seed(seed)
    network = second(CONFIG)
    _learn(network, data, _frames(data), steps, None, seed)
    return network


def _retrain(kind: str, number: int, driving: Path, data: Dataset) -> Second:
    """Return a retraining of a kind; the number draws its frames and its random numbers."""
    if kind == "from the beginning":
        return _begin(data, number, SHORT)
    frames = np.random.default_rng(number).permutation(_frames(data)).tolist()
    half = len(frames) // 2
    parts = {"goes on": [frames], "half of the frames": [frames[:half]], "two clients": [frames[:half], frames[half:]]}
    networks = []
    for part in parts[kind]:
        networks.append(load_network(OBJECTS, driving))
        _learn(networks[-1], data, part, GO_ON // len(parts[kind]), PEAK, number)
    states = [network.state_dict() for network in networks]
    mean = {key: torch.stack([state[key] for state in states]).float().mean(0) for key in states[0]}
    networks[0].load_state_dict({key: value.to(states[0][key].dtype) for key, value in mean.items()})
    return networks[0]


def _frames(data: Dataset) -> Sequence[int]:
    return choose_frames(OBJECTS, CONFIG, data).frames


def _learn(network: Second, data: Dataset, frames: Sequence[int], steps: int, peak: float | None, seed: int) -> None:
    samples = OBJECTS.samples(data, network.config, tuple(frames))
    train(OBJECTS, network, ConcatDataset([samples]), steps=steps, learning_rate=peak, seed=seed, progress=tell)  # type: ignore
    network.eval()


def _summarise(row: dict) -> dict[str, object]:
    """Return what a page tells of a decision."""
    whole = row["whole"]
    return {
        "accepted": row["accepted"],
        "undecided": row["undecided"],
        "driving": round(whole["driving"], 4),
        "candidate": round(whole["candidate"], 4),
        "change": round(whole["candidate"] - whole["driving"], 4),
        "low": round(whole["low"], 4),
        "guards": len(row["guards"]),
        "reasons": row["reasons"],
    }


if __name__ == "__main__":
    main()

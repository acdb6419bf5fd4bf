"""Stage I: labelled samples travel to the cloud, which trains on them until validation levels off."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from flcav.dataset.store import Dataset
from flcav.experiments.protocol import TASK, Protocol, Training
from flcav.experiments.recording import opened
from flcav.experiments.steps import Work
from flcav.federation.stages import Schedule
from flcav.files import write_json
from flcav.network.ledger import Budget, Ledger, LedgerEntry
from flcav.perception.metrics import match
from flcav.perception.objects.detect import detect_all
from flcav.perception.objects.evaluate import Evaluation, asked_of, evaluate
from flcav.perception.objects.model import Second, second_tiny
from flcav.perception.objects.samples import Sample, sample_from_frame
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.weights import load_network, load_weights, save_network
from flcav.perception.training import train_steps
from flcav.seeds import child_seed, stream

WEIGHTS, LEDGER, CURVE = "weights.safetensors", "ledger.parquet", "curve.json"
EDGE_SERVER = "suburb"  # relays stage I samples to the cloud
PRECISION = 0.9  # on validation, of the detections that a vehicle may take for labels


def pretrain(work: Work, protocol: dict[str, Any]) -> dict[str, Any]:
    """Upload the planned samples, train on them, and fix the threshold of own labels."""
    setting = Protocol.model_validate(protocol)
    pool, validation = opened(work, "suburb-pool"), opened(work, "suburb-validation")
    samples = int(work.result("plan")["tasks"][0]["samples"])
    chosen = np.sort(stream(setting.seed, "upload").permutation(len(pool))[:samples])
    book = Ledger(Budget(setting.wireless_mb, setting.wireline_mb))
    _upload(book, pool, chosen)
    book.save(work.folder / LEDGER)
    config = second_tiny().config
    learned = [sample_from_frame(pool.frame(int(i)), config) for i in chosen]
    curve = _train_until_level(work, setting, learned, validation)
    network = load_network(work.folder / WEIGHTS)
    return {
        "samples": len(chosen),
        "uploaded": [int(i) for i in chosen],
        "curve": curve,
        "steps": setting.training.block_steps * len(curve),
        "threshold": own_label_threshold(network, validation),
    }


def _upload(book: Ledger, pool: Dataset, chosen: Sequence[int] | np.ndarray) -> None:
    """Enter each sample twice: vehicle to edge server by wireless, edge server to cloud by wireline."""
    for i in chosen:
        key = pool.keys[int(i)]
        size = pool.payload_bytes(int(i))
        book.enter(LedgerEntry("pretrain", TASK, "wireless", "up", 0, f"{key.scene}/{key.agent}", size))
        book.enter(LedgerEntry("pretrain", TASK, "wireline", "up", 0, EDGE_SERVER, size))


def _train_until_level(
    work: Work, setting: Protocol, samples: Sequence[Sample], validation: Dataset
) -> list[dict[str, float]]:
    """Train in blocks; return validation AP after each. A killed step goes on from its last whole block."""
    training, path = setting.training, work.folder / WEIGHTS
    curve: list[dict[str, float]] = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(child_seed(setting.seed, "weights"))
        network = second_tiny()
    if (work.folder / CURVE).exists():
        curve = json.loads((work.folder / CURVE).read_text())
        load_weights(network, work.folder / f"block{len(curve)}.safetensors")
    while (factor := next_factor([row["ap50"] for row in curve], training)) is not None:
        block = len(curve) + 1
        loss = train_steps(
            OBJECTS,
            network,
            samples,
            steps=training.block_steps,
            batch=training.batch,
            learning_rate=training.learning_rate * factor,
            seed=child_seed(setting.seed, "pretrain", block),
        )
        ap50 = _ap(evaluate(network, (validation.frame(i) for i in range(len(validation)))))
        curve.append({"block": block, "factor": factor, "loss": loss, "ap50": ap50})
        save_network(network, work.folder / f"block{block}.safetensors")
        write_json(work.folder / CURVE, curve)
        work.report(block, training.max_blocks + len(training.cooldown), f"validation AP {ap50:.3f}")
    save_network(network, path)
    return curve


def next_factor(aps: Sequence[float], training: Training) -> float | None:
    """Return the learning rate factor of the block after those that reached `aps`; None when training is over."""
    full = _full_rate_blocks(aps, training)
    if full is None:
        return 1.0
    cooled = len(aps) - full
    return training.cooldown[cooled] if cooled < len(training.cooldown) else None


def _full_rate_blocks(aps: Sequence[float], training: Training) -> int | None:
    """Return after how many blocks validation AP has levelled off (or `max_blocks` are spent); None if not yet.

    Level: the last `patience` blocks brought less than `min_gain` over the best before them.
    """
    for spent in range(training.patience + 1, min(len(aps), training.max_blocks) + 1):
        before, recent = aps[: spent - training.patience], aps[spent - training.patience : spent]
        if max(recent) < max(before) + training.min_gain:
            return spent
    return training.max_blocks if len(aps) >= training.max_blocks else None


def train_on(
    network: Second, samples: Sequence[Sample], training: Training, rounds: int, clients: int, seed: int
) -> None:
    """Train in place for as many steps as a federation of `clients` takes in `rounds`, at the same rates."""
    schedule = Schedule(
        rounds, training.local_steps * clients, training.local_learning_rate, training.final_learning_rate, seed
    )
    for round_ in range(1, rounds + 1):
        task = schedule.work(round_)
        train_steps(
            OBJECTS,
            network,
            samples,
            steps=task.steps,
            batch=training.batch,
            learning_rate=task.learning_rate,
            seed=task.seed,
        )


def own_label_threshold(network: Second, validation: Dataset) -> float:
    """Return the lowest score from which on at least `PRECISION` of the detections on `validation` are right."""
    frames = [validation.frame(i) for i in range(len(validation))]
    truths = [asked_of(frame, network.config) for frame in frames]
    found = detect_all(network, [frame.lidar["lidar"] for frame in frames])
    matches = match(found, [t.targets for t in truths], [t.neutral for t in truths], 0.5)
    precision = np.cumsum(matches.hit) / np.arange(1, len(matches.hit) + 1)
    good = np.flatnonzero(precision >= PRECISION)
    return float(matches.score[good[-1]]) if len(good) else 1.0


def _ap(evaluation: Evaluation) -> float:
    return evaluation.score("Car", "3d", 0.5).ap

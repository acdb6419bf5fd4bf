"""The stages as functions: what is trained on what, from which weights, on whose account.

Stage I: labelled samples travel to the cloud, which trains on them until validation levels off. Stage II: vehicles
federate with their edge server. Stage III: edge servers federate with the cloud (Wang et al., IEEE Network 37(3),
2023).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save

from flcav.federation.rounds import OnRound
from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import EdgeServer, Schedule, federate
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import Trainable, Weights
from flcav.files import write_bytes, write_json
from flcav.network.ledger import Budget, Ledger, LedgerEntry
from flcav.perception.client import TaskClient, shared
from flcav.perception.outcomes import score_on
from flcav.perception.task import Task, configuration, fresh
from flcav.perception.training import train_steps
from flcav.perception.weights import from_arrays, load_network, load_weights, save_network, to_arrays
from flcav.pipeline.frames import Frames
from flcav.pipeline.recipe import CLOUD, EDGE, PRETRAIN, Training
from flcav.pipeline.results import LEDGER, WEIGHTS, Block
from flcav.progress import Report
from flcav.seeds import child_seed, stream

BLOCKS, ROUND = "blocks.json", "round.json"


@dataclass(frozen=True)
class Learning:
    """How a task's networks learn in a run."""

    task: Task
    network: str | None  # name of the configuration
    training: Training
    seed: int

    @property
    def batch(self) -> int:
        """Return the samples of a step."""
        return self.training.batch or self.task.practice.batch

    @property
    def config(self) -> Any:
        """Return the network's configuration."""
        return configuration(self.task, self.network)

    def fresh(self) -> Any:
        """Return a network with weights drawn from the seed."""
        return fresh(self.task, self.config, self.seed)

    def schedule(self, rounds: int, steps: int, *names: str) -> Schedule:
        """Return what clients do in `rounds` rounds of `steps` local steps."""
        rate, training = self.task.practice.learning_rate, self.training
        rates = training.local_rate * rate, training.final_rate * rate
        return Schedule(rounds, steps, *rates, child_seed(self.seed, *names))


def choose_uploads(pools: Mapping[str, Sequence[int]], samples: int, seed: int) -> dict[str, tuple[int, ...]]:
    """Return which frames of each region's pool are uploaded, drawn at random over all of them."""
    every = [(region, frame) for region, frames in pools.items() for frame in frames]
    drawn = np.sort(stream(seed, "upload").permutation(len(every))[:samples])
    chosen: dict[str, list[int]] = {region: [] for region in pools}
    for number in drawn:
        region, frame = every[number]
        chosen[region].append(frame)
    return {region: tuple(frames) for region, frames in chosen.items()}


def book_uploads(book: Ledger, task: Task, config: Any, region: str, pool: Frames, chosen: Sequence[int]) -> None:
    """Enter each sample twice: vehicle to edge server by wireless, edge server to cloud by wireline."""
    sizes = shared(task).sample_bytes(pool.data, config, chosen)
    for frame, size in zip(chosen, sizes, strict=True):
        key = pool.data.keys[frame]
        book.enter(LedgerEntry(PRETRAIN, task.name, "wireless", "up", 0, f"{key.scene}/{key.agent}", size))
        book.enter(LedgerEntry(PRETRAIN, task.name, "wireline", "up", 0, region, size))


def train_until_level(
    learning: Learning, samples: Sequence[Any], validation: Sequence[Frames], folder: Path, report: Report
) -> tuple[Block, ...]:
    """Train in blocks until validation levels off, and write the weights; return how each block went.

    What is kept is the last block's network: the rate has cooled down by then. A killed training goes on from its last
    whole block.
    """
    training, task = learning.training, learning.task
    blocks: list[Block] = []
    network = learning.fresh()
    if (folder / BLOCKS).exists():
        blocks = [Block(**row) for row in json.loads((folder / BLOCKS).read_text())]
        load_weights(task, network, folder / f"block{len(blocks)}.safetensors")
    while (rate := next_rate([block.score for block in blocks], training)) is not None:
        number = len(blocks) + 1
        loss = train_steps(
            task,
            network,
            samples,
            steps=training.block_steps,
            batch=learning.batch,
            learning_rate=rate * task.practice.learning_rate,
            seed=child_seed(learning.seed, PRETRAIN, number),
        )
        score = mean_score(task, network, validation)
        blocks.append(Block(rate, loss, score))
        save_network(task, network, folder / f"block{number}.safetensors")
        write_json(folder / BLOCKS, [vars(block) for block in blocks])
        report(number, training.max_blocks + len(training.cooldown), f"validation {score:.3f}")
    save_network(task, network, folder / WEIGHTS)
    return tuple(blocks)


def mean_score(task: Task, network: Any, splits: Sequence[Frames]) -> float:
    """Return the mean over regions of the task's measure on their vehicles' frames."""
    return float(np.mean([score_on(task, network, split.data, split.vehicles) for split in splits]))


def next_rate(scores: Sequence[float], training: Training) -> float | None:
    """Return the rate of the block after those that reached `scores`; None when training is over."""
    full = _full_rate_blocks(scores, training)
    if full is None:
        return 1.0
    cooled = len(scores) - full
    return training.cooldown[cooled] if cooled < len(training.cooldown) else None


def _full_rate_blocks(scores: Sequence[float], training: Training) -> int | None:
    """Return after how many blocks validation has levelled off (or `max_blocks` are spent); None if not yet.

    Level: the last `patience` blocks brought less than `min_gain` over the best before them.
    """
    for spent in range(training.patience + 1, min(len(scores), training.max_blocks) + 1):
        before, recent = scores[: spent - training.patience], scores[spent - training.patience : spent]
        if max(recent) < max(before) + training.min_gain:
            return spent
    return training.max_blocks if len(scores) >= training.max_blocks else None


def train_centrally(
    learning: Learning, network: Any, samples: Sequence[Any], rounds: int, clients: int, name: str
) -> tuple[float, ...]:
    """Train in place for as many steps as a federation of `clients` takes in `rounds`, at the same rates.

    Returns the mean loss of each round.
    """
    schedule = learning.schedule(rounds, learning.training.local_steps * clients, "more", name)
    losses = []
    for round_ in range(1, rounds + 1):
        work = schedule.work(round_)
        losses.append(
            train_steps(
                learning.task,
                network,
                samples,
                steps=work.steps,
                batch=learning.batch,
                learning_rate=work.learning_rate,
                seed=work.seed,
            )
        )
    return tuple(losses)


def clients_of(learning: Learning, config: Any, samples: Mapping[str, Sequence[Any]]) -> dict[str, TaskClient]:
    """Return a federation's vehicles with their samples, those without any left out."""
    return {
        name: TaskClient(learning.task, config, samples[name], batch=learning.batch)
        for name in sorted(samples)
        if len(samples[name])
    }


class Federating:
    """A federation that goes on after a kill: each round's weights, its loss, and what the ledger held then."""

    def __init__(self, task: Task, folder: Path, book: Ledger, report: Report) -> None:
        self._task, self._folder, self._book, self._report = task, folder, book, report
        self.losses: list[float] = []

    def resume(self, weights: Weights) -> tuple[Weights, int]:
        """Return the weights to go on from and the rounds done, with the ledger as it was then."""
        if not (self._folder / ROUND).exists():
            return weights, 0
        state = json.loads((self._folder / ROUND).read_text())
        kept = Ledger.load(self._folder / LEDGER).entries[: state["entries"]]
        for entry in kept[len(self._book.entries) :]:
            self._book.enter(entry)
        self.losses = state["losses"]
        return load_file(round_path(self._folder, state["round"])), state["round"]

    def keeping(self, rounds: int) -> OnRound:
        """Return what keeps each of `rounds` rounds."""

        def keep(round_: int, weights: Weights, loss: float) -> None:
            self.losses.append(loss)
            write_bytes(round_path(self._folder, round_), save(dict(weights)))
            self._book.save(self._folder / LEDGER)
            state = {"round": round_, "entries": len(self._book.entries), "losses": self.losses}
            write_json(self._folder / ROUND, state)
            self._report(round_, rounds, f"loss {loss:.3f}")

        return keep

    def finish(self, network: Any, rounds: int) -> None:
        """Write the last round's weights, those of `network` where there was none, and the ledger."""
        if rounds:
            network = round_network(self._task, network.config, self._folder, rounds)
        save_network(self._task, network, self._folder / WEIGHTS)
        self._book.save(self._folder / LEDGER)


def federate_edge(
    learning: Learning,
    network: Any,
    clients: Mapping[str, TaskClient],
    rounds: int,
    region: str,
    strategy: Strategy,
    book: Ledger,
    folder: Path,
    report: Report,
) -> tuple[float, ...]:
    """Run stage II of a region from the pretrained `network`; write weights and ledger, return each round's loss."""
    federating = Federating(learning.task, folder, book, report)
    start, done = federating.resume(to_arrays(network))
    schedule = learning.schedule(rounds, learning.training.local_steps, EDGE, region)
    account = Account(book, EDGE, learning.task.name, "wireless")
    keep = federating.keeping(rounds)
    federate(clients, start, schedule, account, strategy=strategy, done=done, on_round=keep)
    federating.finish(network, rounds)
    return tuple(federating.losses)


def federate_cloud(
    learning: Learning,
    network: Any,
    regions: Mapping[str, tuple[Mapping[str, TaskClient], Weights]],
    rounds: int,
    edge_rounds: int,
    strategy: Strategy,
    book: Ledger,
    folder: Path,
    report: Report,
) -> tuple[float, ...]:
    """Run stage III: `regions` are each edge server's vehicles and its stage II weights.

    Writes weights and ledger, returns each round's loss.
    """
    federating = Federating(learning.task, folder, book, report)
    start, done = federating.resume(to_arrays(network))
    wireless, wireline = (Account(book, CLOUD, learning.task.name, link) for link in ("wireless", "wireline"))
    servers: dict[str, Trainable] = {
        region: EdgeServer(clients, edge_rounds, wireless, own, cloud_rounds_done=done, strategy=strategy)
        for region, (clients, own) in regions.items()
    }
    schedule = learning.schedule(rounds, learning.training.local_steps, CLOUD, "")
    keep = federating.keeping(rounds)
    federate(servers, start, schedule, wireline, strategy=strategy, done=done, on_round=keep)
    federating.finish(network, rounds)
    return tuple(federating.losses)


def purse(budget: Budget, planned: Mapping[str, tuple[float, float]], task: str) -> Budget:
    """Return a task's part of both budgets: in proportion to what is planned for it [MB wireless, wireline].

    Parts are rounded down to bytes, so that together they are never more than the whole.
    """
    parts = []
    for link, whole_mb in enumerate((budget.wireless_mb, budget.wireline_mb)):
        total = sum(each[link] for each in planned.values())
        share = planned[task][link] / total if total else 1 / len(planned)
        parts.append(whole_mb if len(planned) == 1 else np.floor(share * whole_mb * 1e6) / 1e6)
    return Budget(*map(float, parts))


def region_budget(stage_one: Ledger, vehicles: Mapping[str, int], region: str) -> Budget:
    """Return what a region's stage II may send: after stage I, its share of the wireless budget by its vehicles."""
    share = vehicles[region] / sum(vehicles.values())
    return Budget(share * stage_one.left_mb("wireless"), 0.0)


def round_path(folder: Path, round_: int) -> Path:
    """Return where a federation's weights after a round are kept."""
    return folder / f"round{round_}.safetensors"


def round_network(task: Task, config: Any, folder: Path, round_: int) -> Any:
    """Return a network with a federation's weights after a round."""
    network = task.build(config)
    from_arrays(network, load_file(round_path(folder, round_)))
    return network.eval()


def stage_network(task: Task, folder: Path) -> Any:
    """Return the network that a stage ended with."""
    return load_network(task, folder / WEIGHTS)

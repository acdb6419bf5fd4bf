"""Proposal of a release: creates a candidate's folder from a trained network and its provenance."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import nn

from flcav.config import InputError, check_is_file, parse_config
from flcav.dataset.store import Dataset
from flcav.network.ledger import Ledger
from flcav.perception.agents import choose_frames
from flcav.perception.task import Task
from flcav.perception.tasks import task_named
from flcav.perception.weights import Card, DataEntry, data_entry, load_network, read_card, save_network, write_card
from flcav.releases.candidate import (
    CANDIDATE,
    CARD,
    LEDGER,
    RECIPE,
    WEIGHTS,
    Candidate,
    DataHash,
    LedgerSum,
    hash_card,
)
from flcav.storage.files import sha256, write_json


def propose(
    out: Path,
    weights: Path,
    driving: Path,
    release: int,
    changes: str,
    audience: str,
    *,
    task: str = "objects",
    data: Sequence[Path] = (),
    recipe: Path | None = None,
    ledger: Path | None = None,
) -> Candidate:
    """Write a candidate's folder at `out` and return its description.

    Args:
        out: the folder, which may not exist yet.
        weights: safetensors file of the candidate with its model card.
        driving: safetensors file of the driving network.
        release: number of the release.
        changes: description of the changes.
        audience: description of its users.
        task: name of the perception task.
        data: training datasets besides those of its card; weights without a card, such as a federation's, get one.
        recipe: recipe of the run that trained it.
        ledger: ledger of that run.

    Raises:
        InputError: for a folder that exists, weights that are no network of the task or have no card, or an invalid
            ledger.
    """
    if out.exists():
        raise InputError(f"{out}: exists already; a candidate is a new folder")
    learned = task_named(task)
    network = load_network(learned, weights)
    load_network(learned, driving)
    entries = tuple(_enter(learned, Dataset.open(folder), network.config) for folder in data)
    if recipe is not None:
        check_is_file(recipe)
    spent = () if ledger is None else sum_ledger(Ledger.load(ledger))
    out.mkdir(parents=True)
    try:
        for source, name in ((weights, WEIGHTS), (recipe, RECIPE), (ledger, LEDGER)):
            if source is not None:
                shutil.copyfile(source, out / name)
        card = _complete_card(learned, network, out / WEIGHTS, entries)
        write_card(card, out / CARD)
        values = {
            "task": task,
            "release": release,
            "changes": changes,
            "audience": audience,
            "network": card.network,
            "weights": sha256(out / WEIGHTS),
            "driving": sha256(driving),
            "card": hash_card(out / WEIGHTS),
            "data": trace_data(card),
            "recipe": None if recipe is None else sha256(recipe),
            "ledger": None if ledger is None else sha256(ledger),
            "spent": spent,
        }
        candidate = parse_config(Candidate, values, "the candidate")
        write_json(out / CANDIDATE, candidate.model_dump(mode="json"), sort=False)
    except BaseException:
        shutil.rmtree(out)
        raise
    return candidate


def _enter(task: Task, data: Dataset, config: object) -> DataEntry:
    return data_entry(data, choose_frames(task, config, data))


def _complete_card(task: Task, network: nn.Module, path: Path, entries: tuple[DataEntry, ...]) -> Card:
    """Return the card of the weights at `path` plus the datasets in `entries`, and write it into the file.

    Raises `InputError` for weights without a card if no dataset is given.
    """
    try:
        card = read_card(path)
    except InputError:
        if not entries:
            raise
        known = {config: name for name, config in task.configurations.items()}
        card = Card(
            task=task.name,
            network=known.get(network.config, "own"),  # pyright: ignore[reportArgumentType]
            parameters=sum(each.numel() for each in network.parameters()),
            seed=0,
            samples=sum(entry.frames for entry in entries),
            training={"trained": "by a federation", "steps": 0, "loss": 0.0, "scores": []},
            data=(),
            metrics={},
        )
    if not entries:
        return card
    card = card.model_copy(update={"data": (*card.data, *entries)})
    save_network(task, network, path, card)
    return card


def trace_data(card: Card) -> tuple[DataHash, ...]:
    """Return the datasets in a card: those of training, and that of validation.

    Raises `InputError` where a manifest's SHA-256 in the card is invalid.
    """
    known = tuple(_trace(entry, "training") for entry in card.data)
    return known if card.validation is None else (*known, _trace(card.validation, "validation"))


def _trace(entry: DataEntry, use: Literal["training", "validation"]) -> DataHash:
    town, seed, split = (entry.recipe.get(name) for name in ("town", "seed", "split"))
    values = {
        "name": entry.name,
        "manifest": entry.manifest,
        "town": town if isinstance(town, str) else None,
        "seed": seed if isinstance(seed, int) else None,
        "split": split if isinstance(split, str) else None,
        "use": use,
    }
    return parse_config(DataHash, values, f"card's data {entry.name}")


def sum_ledger(ledger: Ledger) -> tuple[LedgerSum, ...]:
    """Return the sums of a ledger by stage, link and direction [bytes]."""
    sums: dict[tuple[str, str, str], int] = {}
    for entry in ledger:
        key = (entry.stage, entry.link, entry.direction)
        sums[key] = sums.get(key, 0) + entry.bytes
    return tuple(
        LedgerSum.model_validate({"stage": stage, "link": link, "direction": direction, "bytes": count})
        for (stage, link, direction), count in sums.items()
    )

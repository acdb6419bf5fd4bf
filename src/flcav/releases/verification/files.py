"""Checks of a candidate's files without running the network: hashes, numbers, architecture, card, provenance."""

from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path

from flcav.config import InputError
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.network.ledger import Ledger
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import load_network, read_card
from flcav.releases.candidate import LEDGER, WEIGHTS, Candidate, check_bundle, check_files
from flcav.releases.proposal import sum_ledger, trace_data
from flcav.releases.verification.records import VerificationData
from flcav.storage.files import sha256

LAYERS = ("sparse_channels", "pillar_channels", "bev_layers", "bev_channels", "bev_up_channels", "voxel_m")
FREE = ("calibration", "augmentation", "bfloat16")  # settings that an update may change


def describe_data(data: Dataset, frames: int, scenes: int) -> VerificationData:
    """Return the record of a test dataset."""
    recipe = data.manifest.recipe
    town, seed = recipe.get("town"), recipe.get("seed")
    return VerificationData(
        name="/".join(data.folder.resolve().parts[-2:]),
        manifest=sha256(data.folder / MANIFEST),
        town=town if isinstance(town, str) else None,
        seed=seed if isinstance(seed, int) and data.manifest.imported is None else None,
        frames=frames,
        scenes=scenes,
    )


def find_faults(folder: Path, candidate: Candidate, driving: Path, tested: Sequence[VerificationData]) -> Iterator[str]:
    """Yield the reasons to refuse a candidate because of its files; the network is not run.

    driving: weights of the driving network. tested: the test datasets of the verification.
    """
    try:
        check_files(folder, candidate)
        network, now = load_network(OBJECTS, folder / WEIGHTS), load_network(OBJECTS, driving)
        card = read_card(folder / WEIGHTS)
        known = trace_data(card)
        spent = () if candidate.ledger is None else sum_ledger(Ledger.load(folder / LEDGER))
    except InputError as error:
        yield str(error)
        return
    if sha256(driving) != candidate.driving:
        yield f"it is proposed to replace another network than {driving}"
    yield from _compare_interfaces(network, now)
    if below := [name for name, values in network.named_buffers() if "variance" in name and bool((values < 0).any())]:
        yield f"a variance below 0 in '{below[0]}': nothing that the network says is a number"
    try:
        check_bundle(folder)
    except InputError as error:
        yield str(error)
    if card.parameters != sum(each.numel() for each in network.parameters()):
        yield "a card of other weights: it names another number of parameters"
    if card.task != candidate.task or card.network != candidate.network or not _fits_name(network, card.network):
        yield "a card of other weights: it names another task or network"
    if known != candidate.data:
        yield "its provenance is another than that of the card in its weights"
    if spent != candidate.spent:
        yield "its description names other megabytes than its ledger"
    if not candidate.data:
        yield "its provenance names no training data"
    yield from find_overlap(candidate, tested)


def find_overlap(candidate: Candidate, tested: Sequence[VerificationData]) -> Iterator[str]:
    """Yield a sentence per training dataset of the candidate whose scenes are among the test scenes.

    Scenes are the same if the manifests are, or if town and seed are, whatever the split, the sensors and the name.
    """
    for known in candidate.data:
        for test in tested:
            same = known.seed is not None and (known.town, known.seed) == (test.town, test.seed)
            if known.manifest == test.manifest or same:
                yield f"{known.use} on test scenes: {known.name} has those of {test.name}"


def _fits_name(network: Second, name: str) -> bool:
    """Return whether a network's layers are those of the configuration `name`, whatever its classes.

    A name unknown to flcav fits any network.
    """
    known = OBJECTS.configurations.get(name)
    return known is None or all(getattr(known, layer) == getattr(network.config, layer) for layer in LAYERS)


def _compare_interfaces(network: Second, driving: Second) -> Iterator[str]:
    new, old = network.config, driving.config
    names = [field.name for field in fields(new) if field.name not in FREE]
    if odd := [name for name in names if getattr(new, name) != getattr(old, name)]:
        yield f"another architecture than that of the network that drives: {', '.join(odd)}"

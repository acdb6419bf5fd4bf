"""Stages II and III as steps: who trains on what, from which weights, on whose account."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file, save

from flcav.experiments.pretraining import LEDGER, WEIGHTS, train_on
from flcav.experiments.protocol import REGIONS, TASK, Protocol
from flcav.experiments.recording import opened
from flcav.experiments.steps import Work
from flcav.experiments.vehicles import grouped, held, region
from flcav.federation.rounds import OnRound
from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import EdgeServer, Schedule, federate
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import Trainable, Weights
from flcav.files import write_bytes, write_json
from flcav.network.ledger import Budget, Ledger, LedgerEntry
from flcav.perception.objects.model import Second, second
from flcav.perception.objects.samples import sample_from_frame
from flcav.perception.objects.weights import load_network, save_network
from flcav.perception.weights import from_arrays, to_arrays
from flcav.seeds import child_seed

ROUND = "round.json"


def edge_fl(work: Work, town: str, sensor: str, protocol: dict[str, Any], strategy: Strategy) -> dict[str, Any]:
    """Stage II in one region; `sensor`: the pole that helps label, "chosen" | "densest" | "none"."""
    setting = Protocol.model_validate(protocol)
    rounds = int(work.result("plan")["tasks"][0]["edge_rounds"])
    book = _share_of(Ledger.load(work.inputs["pretrain"] / LEDGER), setting, town)
    pole = None if sensor == "none" else int(work.result(f"{town}-place")[sensor])
    clients = region(work, town, pole, setting, book)
    network = load_network(work.inputs["pretrain"] / WEIGHTS)
    schedule = _schedule(setting, rounds, "edge", town)
    account = Account(book, "edge", TASK, "wireless")
    start, done = _resumed(work, to_arrays(network), book)
    keep = _checkpoint(work, book, schedule.rounds)
    federate(clients, start, schedule, account, strategy=strategy, done=done, on_round=keep)
    return _finish(work, network, book, rounds) | {"pole": pole, "samples": held(clients)}


def cloud_fl(work: Work, protocol: dict[str, Any], strategy: Strategy) -> dict[str, Any]:
    """Stage III: the edge servers of all regions federate with the cloud, vehicles with their edge servers."""
    setting = Protocol.model_validate(protocol)
    rounds, k = int(work.result("plan")["tasks"][0]["cloud_rounds"]), setting.edge_rounds_per_cloud_round
    book = Ledger(Budget(setting.wireless_mb, setting.wireline_mb), _spent(work))
    wireless, wireline = (Account(book, "cloud", TASK, link) for link in ("wireless", "wireline"))
    network = load_network(work.inputs["pretrain"] / WEIGHTS)
    start, done = _resumed(work, to_arrays(network), book)
    servers: dict[str, Trainable] = {}
    sweeps = 0
    for town in REGIONS:
        own = to_arrays(load_network(work.inputs[f"{town}-edge-chosen"] / WEIGHTS))
        clients = region(work, town, int(work.result(f"{town}-place")["chosen"]), setting)
        servers[town] = EdgeServer(clients, k, wireless, own, cloud_rounds_done=done, strategy=strategy)
        sweeps += held(clients)
    schedule = _schedule(setting, rounds, "cloud", "")
    keep = _checkpoint(work, book, rounds)
    federate(servers, start, schedule, wireline, strategy=strategy, done=done, on_round=keep)
    return _finish(work, network, book, rounds) | {"samples": sweeps}


def more_training(work: Work, source: str, protocol: dict[str, Any]) -> dict[str, Any]:
    """Centralised training from the pretrained weights, as many steps as stage II takes in `grid`, on ground truth.

    `source` "suburb": more pretraining on the uploaded samples. "grid": the oracle, on the frames of stage II.
    """
    setting = Protocol.model_validate(protocol)
    network = load_network(work.inputs["pretrain"] / WEIGHTS)
    if source == "suburb":
        data, chosen = opened(work, "suburb-pool"), work.result("pretrain")["uploaded"]
    else:
        data, chosen = opened(work, "grid-edge"), grouped(work, "grid", setting)
    samples = [sample_from_frame(data.frame(i), network.config) for i in chosen]
    rounds = int(work.result("plan")["tasks"][0]["edge_rounds"])
    train_on(
        network, samples, setting.training, rounds, setting.vehicles["grid"], child_seed(setting.seed, "more", source)
    )
    save_network(network, work.folder / WEIGHTS)
    return {"samples": len(samples), "rounds": rounds}


def _schedule(setting: Protocol, rounds: int, *names: str) -> Schedule:
    training = setting.training
    rates = training.local_learning_rate, training.final_learning_rate
    return Schedule(rounds, training.local_steps, *rates, child_seed(setting.seed, *names))


def _share_of(stage_one: Ledger, setting: Protocol, town: str) -> Ledger:
    """Return a region's own ledger: after stage I, its share of the wireless budget by its number of vehicles."""
    share = setting.vehicles[town] / sum(setting.vehicles.values())
    return Ledger(Budget(share * stage_one.left_mb("wireless"), 0.0))


def _spent(work: Work) -> list[LedgerEntry]:
    """Return what the chosen arm's earlier stages have spent, in their order."""
    ledgers = ["pretrain", *(f"{town}-edge-chosen" for town in REGIONS)]
    return [entry for name in ledgers for entry in Ledger.load(work.inputs[name] / LEDGER).entries]


def _checkpoint(work: Work, book: Ledger, rounds: int) -> OnRound:
    """Keep each round's weights, and what the ledger held then, so that a killed step goes on after it."""

    def keep(round_: int, weights: Weights, loss: float) -> None:
        write_bytes(round_path(work.folder, round_), save(dict(weights)))
        book.save(work.folder / LEDGER)
        write_json(work.folder / ROUND, {"round": round_, "entries": len(book.entries)})
        work.report(round_, rounds, f"loss {loss:.3f}")

    return keep


def _resumed(work: Work, weights: Mapping[str, Any], book: Ledger) -> tuple[Weights, int]:
    """Return the weights to go on from and the rounds done, with the ledger as it was then."""
    if not (work.folder / ROUND).exists():
        return weights, 0
    state = json.loads((work.folder / ROUND).read_text())
    kept = Ledger.load(work.folder / LEDGER).entries[: state["entries"]]
    for entry in kept[len(book.entries) :]:
        book.enter(entry)
    return load_file(round_path(work.folder, state["round"])), state["round"]


def round_path(folder: Path, round_: int) -> Path:
    """Return where a federation's weights after a round are kept."""
    return folder / f"round{round_}.safetensors"


def round_network(config_of: Second, folder: Path, round_: int) -> Second:
    """Return the network of `config_of` with a federation's weights after a round."""
    network = second(config_of.config)
    from_arrays(network, load_file(round_path(folder, round_)))
    return network.eval()


def _finish(work: Work, network: Second, book: Ledger, rounds: int) -> dict[str, int]:
    if rounds:
        network = round_network(network, work.folder, rounds)
    save_network(network, work.folder / WEIGHTS)
    book.save(work.folder / LEDGER)
    return {"rounds": rounds}

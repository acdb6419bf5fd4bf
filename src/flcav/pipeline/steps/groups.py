"""Calling a group in stage II: vehicles check the network that drives, ask, are called, and train on copies of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.federation.leads import Term
from flcav.federation.runtimes.embedded import update_bytes
from flcav.network.ledger import Ledger
from flcav.network.messages import pack, send
from flcav.perception.client import TaskClient
from flcav.perception.objects.samples import Sample
from flcav.perception.outcomes import score_network
from flcav.perception.weights import to_arrays
from flcav.pipeline.engine import Work
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.roadside import label_roadside
from flcav.pipeline.poles import find_sites
from flcav.pipeline.radio.driving import link_scenes
from flcav.pipeline.recipe import EDGE, Requests
from flcav.pipeline.results.groups import Checked, Group
from flcav.pipeline.results.plans import Placed
from flcav.pipeline.results.training import Pretrained
from flcav.pipeline.steps.settings import FederationSettings, RegionInputs
from flcav.pipeline.training.groups import (
    ABSENT,
    NO_LINK,
    SERVER_RANGE,
    GroupWatch,
    Offer,
    Picked,
    choose_members,
    count_labels,
    find_gradient,
    find_in_range,
    find_lead,
    hold_back,
    measure_loss,
    sketch_gradient,
    weigh_offers,
)
from flcav.pipeline.training.learning import Learning, load_stage_network
from flcav.statistics.streams import derive_seed

EVERY_SCENE = 10**6  # more than there are


@dataclass(frozen=True)
class Called:
    """A group that was called, or not, in a region."""

    group: Group
    samples: Mapping[str, Sequence[Any]]  # that its members train on, by client
    watch: GroupWatch
    terms: tuple[Term, ...] = ()  # of the leads of an ad hoc group

    @property
    def vehicles(self) -> list[str]:
        """Return the members that are vehicles."""
        return [*self.group.members]

    def dissolve(self, folder: Path, before: Path, shown: Frames | None, most_rounds: int) -> Group:
        """Return the group after its rounds, with what the network in `folder` does on what members held back.

        Of the frames `shown` its score is told beside that of the network in the folder `before`.
        """
        if not self.group.members:
            return self.group
        task, ended = self.watch.task, load_stage_network(self.watch.task, folder)
        reached, scores = self.watch.measure(to_arrays(ended)), tuple[float, ...]()
        if shown is not None:
            networks = (load_stage_network(task, before), ended)
            scores = tuple(score_network(task, each, shown.data, shown.vehicles) for each in networks)
        vehicles = {name: replace(each, after=reached.get(name)) for name, each in self.group.vehicles.items()}
        over = "the loss has levelled off" if self.watch.over else "the plan's rounds are over"
        losses = tuple(self.watch.losses)
        led = tuple(term for term in self.terms if term.first < len(losses) or term.first == 1)
        about: Any = {"losses": losses, "most_rounds": most_rounds, "dissolved": over, "terms": led, "scores": scores}
        return replace(self.group, vehicles=vehicles, **about)


def call_group(
    work: Work,
    settings: FederationSettings,
    inputs: RegionInputs,
    how: Requests,
    samples: Mapping[str, Sequence[Any]],
    book: Ledger,
    most: int | None = None,
    poles: Sequence[int] = (),
) -> Called:
    """Return the group that a region's vehicles form, `most` of them by the plan; requests and offers enter `book`.

    Units on the `poles` join, if `how` says so, that are in range of one that asked; what they send crosses no radio.

    Who asks is there when the vehicle that errs most is first there. Raises `InputError` where pretraining has no loss,
    and `BudgetExceeded`.
    """
    learning = settings.learning.resolve()
    task, frozen = learning.task, load_stage_network(learning.task, work.inputs[inputs.pretrain])
    weights, validated = to_arrays(frozen), Pretrained.load(work.inputs[inputs.pretrain]).validated
    if not validated:
        raise InputError("requests: vehicles ask by the loss at the end of pretraining, and there is no pretraining")
    limit = how.excess * validated[-1].loss
    clients = [name for name in sorted(samples) if len(samples[name])]
    parts = {name: hold_back(len(samples[name]), how.held_back) for name in clients}
    held = {name: Picked(samples[name], own) for name, (_, own) in parts.items()}
    vehicles: dict[str, Checked] = {}
    for name, own in held.items():
        loss = measure_loss(task, frozen.config, weights, own, learning.batch) if len(own) else 0.0
        vehicles[name] = Checked(len(own), loss, asks=loss > limit)
    watch = GroupWatch(task, frozen.config, learning.batch, how, {})
    asked = [name for name, own in vehicles.items() if own.asks]
    if not asked:
        return Called(Group(limit, vehicles, ""), {}, watch)
    split, before = Frames.open(work.inputs[inputs.frames]), len(book.entries)
    worst = max(asked, key=lambda name: vehicles[name].before)
    scene, positions = find_positions(split, inputs.region, worst, clients)
    placed = Placed.load(work.inputs[inputs.place])
    present = [name for name in asked if name in positions]
    lead = find_lead(positions, present, find_servers(split, placed, inputs), how.range_m)
    where: Any = {"stage": EDGE, "task": task.name, "link": "wireless", "direction": "up"}
    for name in present:
        about = {"position": positions[name].astype(np.float32), "loss": np.array([vehicles[name].before], np.float32)}
        send(book, pack(about), client=name, **where)
    near = find_in_range(positions, present, how.range_m)
    linked = find_linked(settings, learning, split, placed, scene, inputs.region, near, how.link_s)
    stayed = {name: ABSENT for name in clients if name not in positions}
    stayed |= {name: SERVER_RANGE for name in positions if name not in near}
    stayed |= {name: NO_LINK for name in near if name not in linked}
    offers = {}
    for name in linked:
        own = Picked(samples[name], parts[name][0])
        client = TaskClient(task, frozen.config, own, batch=learning.batch)
        seed = derive_seed(learning.seed, "offer")
        sketch = sketch_gradient(find_gradient(client, weights, seed), seed)
        offers[name] = Offer(len(own), count_labels(own), sketch)
        send(book, offers[name].message(), client=name, **where)
    if not offers:
        return Called(Group(limit, vehicles, lead, stayed=stayed), {}, watch)
    asking = sorted((name for name in present if name in linked), key=lambda name: -vehicles[name].before)
    chosen = choose_members(how, asking, weigh_offers(offers), stayed, most)
    watch.held = {name: held[name] for name in chosen.members}
    watch.note(weights)
    sent = sum(entry.bytes for entry in book.entries[before:] if entry.direction == "up")
    trained: dict[str, Sequence[Any]] = {name: Picked(samples[name], parts[name][0]) for name in chosen.members}
    units: dict[str, list[Sample]] = {}
    if how.roadside:
        there = find_units(split, inputs, poles, positions, present, how.range_m)
        spins = {(split.data.keys[i].scene, split.data.keys[i].index) for i in split.vehicles}
        units = label_roadside(split, there, spins, frozen.config, inputs.region)
    group = Group(limit, vehicles, lead, chosen.members, chosen.quality, chosen.stayed, sent, roadside=tuple(units))
    return Called(group, trained | units, watch)


def find_units(
    split: Frames,
    inputs: RegionInputs,
    poles: Sequence[int],
    positions: Mapping[str, NDArray[np.float64]],
    asked: Sequence[str],
    range_m: float,
) -> list[int]:
    """Return those of the poles that are in range of one that asked."""
    sites = find_sites(split, split if inputs.recorded else None)
    places = {f"pole{n}": at for n, at in zip(sites.number.tolist(), sites.position, strict=True) if n in poles}
    near = find_in_range({**positions, **places}, asked, range_m)
    return [pole for pole in poles if f"pole{pole}" in near]


def find_positions(
    split: Frames, region: str, worst: str, clients: Sequence[str]
) -> tuple[str, dict[str, NDArray[np.float64]]]:
    """Return the first scene with the vehicle `worst`, and where (3,) [m] clients are when they are first in it."""
    keys = split.data.keys
    scene = next(keys[i].scene for i in split.vehicles if f"{region}/{keys[i].agent}" == worst)
    found: dict[str, NDArray[np.float64]] = {}
    for i in split.vehicles:
        name = f"{region}/{keys[i].agent}"
        if keys[i].scene == scene and name in clients and name not in found:
            found[name] = np.asarray(split.data.frame(i).world_from_agent[:3, 3], np.float64)
    return scene, found


def find_servers(split: Frames, placed: Placed, inputs: RegionInputs) -> dict[str, NDArray[np.float64]]:
    """Return the positions (3,) [m] of the units on the poles with sensors, or on the one with most traffic."""
    if not placed.poles:
        return {}
    sites, poles = find_sites(split, split if inputs.recorded else None), placed.chosen or (placed.densest,)
    pairs = zip(sites.number.tolist(), sites.position, strict=True)
    return {f"pole{number}": position for number, position in pairs if number in poles}


def find_linked(
    settings: FederationSettings,
    learning: Learning,
    split: Frames,
    placed: Placed,
    scene: str,
    region: str,
    clients: Sequence[str],
    most_s: float,
) -> list[str]:
    """Return the clients whose update, alone on the air, takes so many seconds at most; all without a network."""
    network = settings.federation.network
    if network is None:
        return [*clients]
    scenes = list(dict.fromkeys(split.data.keys[i].scene for i in split.vehicles))
    links = link_scenes(split, placed, network, EVERY_SCENE, learning.seed)[scenes.index(scene)]
    bits = 8 * update_bytes(to_arrays(learning.build_network()), settings.federation.upload)
    rates = dict(zip(links.vehicle, links.rate_bps[0].max(axis=1).tolist(), strict=True))
    return [name for name in clients if bits <= most_s * rates.get(name.removeprefix(f"{region}/"), 0.0)]

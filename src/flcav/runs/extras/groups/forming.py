"""Formation of a group in stage II: vehicles check the deployed network, send requests and offers, and are selected."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from flcav.config import InputError
from flcav.federation.links.in_process import update_bytes
from flcav.federation.links.link import NOTHING, UNREADABLE, Ask, open_questions
from flcav.federation.links.metered import Account
from flcav.federation.loop import OnRound
from flcav.federation.state import FederationState
from flcav.federation.trainable import Trainable, Weights
from flcav.network.clock.records import RoundTiming
from flcav.network.ledger import Ledger, send_message
from flcav.perception.objects.samples import Sample
from flcav.perception.outcomes import score_network
from flcav.perception.task import Task
from flcav.perception.weights import to_arrays
from flcav.runs.driving import link_scenes
from flcav.runs.engine import Work
from flcav.runs.extras.groups.choosing import (
    ABSENT,
    NO_LINK,
    SERVER_RANGE,
    GroupWatch,
    choose_members,
    find_in_range,
    find_lead,
    read_losses,
    weigh_offers,
)
from flcav.runs.extras.groups.leads import federate_led, follow_leads
from flcav.runs.extras.groups.members import (
    ASKS,
    CHECK,
    HELD,
    LOSS,
    MESSAGE,
    OFFER,
    REQUEST,
    SCENE,
    GroupMember,
    Offer,
    Picked,
    Unreadable,
    answer_requests,
    hold_back,
    read_position,
    take_requests,
)
from flcav.runs.extras.groups.roadside import label_roadside
from flcav.runs.extras.groups.rows import CheckedNetwork, Group, LeadTerm
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.frames import Frames
from flcav.runs.poles import find_sites
from flcav.runs.recipe import EDGE
from flcav.runs.results.plans import Placed, Plan
from flcav.runs.results.training import Pretrained
from flcav.runs.stages.federating import EdgeSettings
from flcav.runs.stages.regions import LabelledSamples
from flcav.runs.stages.rounds import Conduct, RunRounds
from flcav.runs.stages.settings import FederationSettings, RegionInputs
from flcav.runs.training.checkpoints import round_path
from flcav.runs.training.learning import Learning, load_stage_network
from flcav.statistics.streams import derive_seed

if TYPE_CHECKING:
    from flcav.federation.links.flower import RegionalDeployment
    from flcav.runs.stages.rounds import Deployed

EVERY_SCENE = 10**6  # more than any dataset has
AnswerT = TypeVar("AnswerT")
Places = Mapping[str, NDArray[np.float64]]  # (scenes, 3) by client, world frame [m], see `find_client_places`


@dataclass(frozen=True)
class Called(Conduct):
    """Conduct of the rounds of a region's group, which is empty if no vehicle sent a request."""

    group: Group
    samples: Mapping[str, Sequence[Any]]  # training samples of its members and roadside units, by client
    watch: GroupWatch
    task: Task
    book: Ledger
    terms: tuple[LeadTerm, ...] = ()  # of the leads of an ad hoc group; none: an edge server leads

    @property
    def within(self) -> frozenset[str]:
        """The roadside units, which are at the edge server itself."""
        return frozenset(self.group.roadside)

    @property
    def vacant(self) -> bool:
        """Whether the group has no members and no roadside units."""
        return not self.samples

    @property
    def over(self) -> bool:
        """Whether the group is to dissolve."""
        return self.watch.over

    def choose(self, samples: Mapping[str, Sequence[Any]]) -> Mapping[str, Sequence[Any]]:
        """Return the training samples of the members and roadside units."""
        return self.samples

    def enlist(self, clients: Mapping[str, Trainable]) -> Mapping[str, Trainable]:
        """Return the clients of the rounds; those of members also answer questions."""
        return self.watch.enlist(clients)

    def resume(
        self, folder: Path, clients: Mapping[str, Trainable], deployed: Any, account: Account, done: int
    ) -> None:
        """Record the losses after the finished rounds, whose weights are in `folder`."""
        with open_questions(clients, deployed if done else None, account) as ask:
            for number in range(1, done + 1):
                self.watch.note(self.watch.hear(ask, load_file(round_path(folder, number)), counted=False))

    def follow(self, number: int, weights: Weights, ask: Ask) -> None:
        """Record the loss after a round; the members' messages enter the ledger. Raises `BudgetExceeded`."""
        self.watch.follow(self.book, number, weights, ask)

    def foresee(self, records: tuple[RoundTiming, ...], region: str) -> "Called":
        """Return the group with the terms of its leads, if a vehicle leads it."""
        vehicles = [*self.group.members]
        if self.group.lead not in vehicles:
            return self
        return replace(self, terms=follow_leads(vehicles, self.group.lead, records, region))

    def run(
        self, run: RunRounds, start: Weights, account: Account, on_round: OnRound, state: FederationState, done: int
    ) -> None:
        """Run the rounds after `done`, under successive leads if vehicles lead."""
        if self.terms:
            federate_led(run, start, account, self.terms, on_round, state=state, done=done)
        else:
            run(start, account, done, on_round)

    def report(self, work: Work, settings: EdgeSettings, rounds: int, deployed: "Deployed") -> dict[str, Any]:
        """Return the group's row of the results after its rounds; `rounds`: their planned number."""
        shown = Frames.open(work.inputs[settings.shown]) if settings.shown else None
        with open_questions(self.watch.members, deployed, Account(self.book, EDGE, self.task.name, "wireless")) as ask:
            return {"group": self.dissolve(work.folder, work.inputs[settings.inputs.pretrain], shown, rounds, ask)}

    def dissolve(self, folder: Path, before: Path, shown: Frames | None, most_rounds: int, ask: Ask) -> Group:
        """Return the group after its rounds, with the loss of the network in `folder` on its members' held-back frames.

        On the frames `shown`, the network is scored, and so is the one in the folder `before` for comparison.
        """
        if not self.group.members:
            return self.group
        ended, scores = load_stage_network(self.task, folder), tuple[float, ...]()
        reached = read_losses(self.watch.hear(ask, to_arrays(ended), counted=False))
        if shown is not None:
            networks = (load_stage_network(self.task, before), ended)
            scores = tuple(score_network(self.task, network, shown.data, shown.vehicles) for network in networks)
        vehicles = {name: replace(check, after=reached.get(name)) for name, check in self.group.vehicles.items()}
        over = "the loss has levelled off" if self.watch.over else "the plan's rounds are over"
        losses = tuple(self.watch.losses)
        led = tuple(term for term in self.terms if term.first < len(losses) or term.first == 1)
        about: Any = {"losses": losses, "most_rounds": most_rounds, "dissolved": over, "terms": led, "scores": scores}
        return replace(self.group, vehicles=vehicles, **about)


def call_group(
    work: Work,
    settings: EdgeSettings,
    labelled: LabelledSamples,
    book: Ledger,
    plan: Plan,
    deployed: "RegionalDeployment | None",
) -> Called | None:
    """Form the group of a region's vehicles; requests and offers enter `book`. None: all vehicles federate.

    It has as many members as the plan calls. If the recipe says so, units on poles in range of a vehicle that asked
    join; their messages do not use the radio. Vehicles that are `deployed` answer there, and those with FL requests
    waiting in their fleet count as having asked.

    The group forms in the first scene in which the vehicle with the largest error is present. Raises `InputError` where
    pretraining has no loss, and `BudgetExceeded`.
    """
    how = settings.federation.requests
    inputs = settings.inputs
    samples = labelled.samples
    if how is None:
        return None
    learning = settings.learning.resolve()
    task = learning.task
    frozen = load_stage_network(task, work.inputs[inputs.pretrain])
    validated = Pretrained.load(work.inputs[inputs.pretrain]).validated
    if not validated:
        raise InputError("requests: vehicles ask by the loss at the end of pretraining, and there is no pretraining")
    limit = how.excess * validated[-1].loss
    split = Frames.open(work.inputs[inputs.frames])
    places = find_client_places(split, inputs.region, [name for name in sorted(samples) if len(samples[name])])
    members = make_members(learning, frozen, how, limit, samples, places)
    with open_questions(members, deployed, Account(book, EDGE, task.name, "wireless")) as ask:
        uplink, entered = GroupUplink(ask, book, task.name), len(book.entries)
        vehicles = uplink.check([*members])
        taken = take_requests(deployed, work.folder, [*members], task.name)
        before = {name: request for name, request in taken.read().items() if name in vehicles}
        vehicles |= {name: replace(vehicles[name], asks=True, told=request.loss) for name, request in before.items()}
        asked = sorted((name for name, check in vehicles.items() if check.asks), key=lambda name: -vehicles[name].error)
        if not asked:
            return Called(Group(limit, vehicles, "", stayed=uplink.silent), {}, GroupWatch(how, {}), task, book)
        scene = int(np.flatnonzero(np.isfinite(places[asked[0]]).all(axis=1))[0])
        positions = {name: places[name][scene] for name in vehicles if np.isfinite(places[name][scene]).all()}
        for name, request in before.items():
            uplink.enter(name, *(message.encode() for message in taken.messages[name]))
            height_m = positions[name][2] if name in positions else 0.0  # a request states x and y alone
            positions[name] = np.array([request.x, request.y, height_m])
        asking = [name for name in vehicles if name in asked and name in positions and name not in before]
        positions |= uplink.hear(REQUEST, asking, read_position, {SCENE: np.array([scene])})
        present = [name for name in vehicles if name in asked and name in positions and name not in uplink.silent]
        if not present:
            return Called(Group(limit, vehicles, "nobody", stayed=uplink.silent), {}, GroupWatch(how, {}), task, book)
        placed = Placed.load(work.inputs[inputs.place])
        lead = find_lead(positions, present, find_servers(split, placed, inputs), how.range_m)
        near = find_in_range(positions, present, how.range_m)
        linked = find_linked(settings, learning, split, placed, scene, near, how.link_s)
        offers = uplink.hear(OFFER, linked, Offer.read)
    stayed = {name: ABSENT for name in vehicles if name not in positions}
    stayed |= {name: SERVER_RANGE for name in positions if name not in near}
    stayed |= {name: NO_LINK for name in near if name not in linked}
    stayed |= uplink.silent
    if not offers:
        return Called(Group(limit, vehicles, lead, stayed=stayed), {}, GroupWatch(how, {}), task, book)
    chosen = choose_members(
        how,
        [name for name in asked if name in offers],
        weigh_offers(offers),
        stayed,
        plan.tasks[settings.learning.task].called,
    )
    answer_requests(deployed, taken, chosen.members)
    held = {name: members[name] for name in chosen.members if len(members[name].held)}
    watch = GroupWatch(how, held, [float(np.mean([vehicles[name].before for name in held])) if held else 0.0])
    sent = sum(entry.bytes for entry in book.entries[entered:] if entry.direction == "up")
    units: dict[str, list[Sample]] = {}
    if how.roadside:
        there = find_units(split, inputs, labelled.poles, positions, present, how.range_m)
        spins = {(split.data.keys[i].scene, split.data.keys[i].index) for i in split.vehicles}
        units = label_roadside(split, there, spins, frozen.config, inputs.region)
    group = Group(limit, vehicles, lead, chosen.members, chosen.quality, chosen.stayed, sent, roadside=tuple(units))
    return Called(group, {name: members[name].data for name in chosen.members} | units, watch, task, book)


def make_members(
    learning: Learning, network: Any, how: Requests, limit: float, samples: Mapping[str, Sequence[Any]], places: Places
) -> dict[str, GroupMember]:
    """Return the possible members of a group: a vehicle holds some of its samples back, and trains on the others."""
    weights = to_arrays(network)
    seed = derive_seed(learning.seed, "offer")
    members = dict[str, GroupMember]()
    for name, at in places.items():
        trained, held = (Picked(samples[name], indices) for indices in hold_back(len(samples[name]), how.held_back))
        about = learning.task, network.config, learning.batch, trained, held, weights
        members[name] = GroupMember(*about, limit, seed, at)
    return members


@dataclass(frozen=True)
class GroupUplink:
    """Uplink of a region's vehicles before a group forms: requests, offers and their ledger entries."""

    ask: Ask
    book: Ledger
    task: str
    silent: dict[str, str] = field(default_factory=dict)  # reason for the lack of an answer, by client

    def check(self, clients: Sequence[str]) -> dict[str, CheckedNetwork]:
        """Return the clients' checks of the deployed network; they are recorded, but sent over no link."""
        replies = self.ask(CHECK, clients, counted=False)
        found = dict[str, CheckedNetwork]()
        for name, answer in replies.answers.items():
            arrays: Any = answer
            try:
                found[name] = CheckedNetwork(int(arrays[HELD][0]), float(arrays[LOSS][0]), asks=bool(arrays[ASKS][0]))
            except (KeyError, IndexError, TypeError, ValueError) as error:
                self.silent[name] = f"{UNREADABLE}: {error}"
        self.silent.update(replies.missing)
        return found

    def hear(
        self, question: str, clients: Sequence[str], read: Callable[[bytes], AnswerT], arrays: Weights = NOTHING
    ) -> dict[str, AnswerT]:
        """Return the clients' messages, decoded by `read`, after entering them in the ledger."""
        replies = self.ask(question, clients, arrays)
        found = dict[str, AnswerT]()
        for name, answer in replies.answers.items():
            message = answer.get(MESSAGE, np.zeros(0, np.uint8)).tobytes()
            self.enter(name, message)
            try:
                found[name] = read(message)
            except Unreadable as error:
                self.silent[name] = f"{UNREADABLE}: {error}"
        self.silent.update(replies.missing)
        return found

    def enter(self, client: str, *messages: bytes) -> None:
        """Enter a client's messages; raises `BudgetExceeded`."""
        for message in messages:
            send_message(self.book, message, stage=EDGE, task=self.task, link="wireless", direction="up", client=client)


def find_units(
    split: Frames,
    inputs: RegionInputs,
    poles: Sequence[int],
    positions: Mapping[str, NDArray[np.float64]],
    asked: Sequence[str],
    range_m: float,
) -> list[int]:
    """Return those of `poles` within `range_m` [m] of a vehicle that `asked`; `positions`: (3,), world frame [m]."""
    sites = find_sites(split, split if inputs.recorded else None)
    places = {f"pole{n}": at for n, at in zip(sites.number.tolist(), sites.position, strict=True) if n in poles}
    near = find_in_range({**positions, **places}, asked, range_m)
    return [pole for pole in poles if f"pole{pole}" in near]


def find_client_places(split: Frames, region: str, clients: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Return the clients' first positions in the scenes of a split (scenes, 3), world frame [m]; NaN if absent."""
    keys = split.data.keys
    scenes = {scene: number for number, scene in enumerate(dict.fromkeys(keys[i].scene for i in split.vehicles))}
    found = {name: np.full((len(scenes), 3), np.nan) for name in clients}
    for i in split.vehicles:
        name = f"{region}/{keys[i].agent}"
        scene = scenes[keys[i].scene]
        if name in found and np.isnan(found[name][scene, 0]):
            found[name][scene] = split.data.world_from_agent(i)[:3, 3]
    return found


def find_servers(split: Frames, placed: Placed, inputs: RegionInputs) -> dict[str, NDArray[np.float64]]:
    """Return the positions (3,) of the units on poles with sensors, or else with most traffic, world frame [m]."""
    if not placed.poles:
        return {}
    sites = find_sites(split, split if inputs.recorded else None)
    poles = placed.chosen or (placed.densest,)
    pairs = zip(sites.number.tolist(), sites.position, strict=True)
    return {f"pole{number}": position for number, position in pairs if number in poles}


def find_linked(
    settings: FederationSettings,
    learning: Learning,
    split: Frames,
    placed: Placed,
    scene: int,
    clients: Sequence[str],
    most_s: float,
) -> list[str]:
    """Return the clients whose update, alone on the channel, takes at most `most_s` [s]; all without a network."""
    network = settings.federation.network
    if network is None:
        return [*clients]
    links = link_scenes(split, placed, network, EVERY_SCENE, learning.seed)[scene]
    bits = 8 * update_bytes(to_arrays(learning.build_network()), settings.federation.upload)
    rates = dict(zip(links.vehicle, links.rate_bps[0].max(axis=1).tolist(), strict=True))
    return [name for name in clients if bits <= most_s * rates.get(name.partition("/")[2], 0.0)]

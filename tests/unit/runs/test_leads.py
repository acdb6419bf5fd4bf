"""Ad hoc groups: who takes over when a lead leaves, and that the round goes on to the same weights."""

from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from flcav.federation.links.metered import Account, Outage
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.loop import OnRound, Schedule, federate
from flcav.federation.state import FederationState
from flcav.federation.strategies import strategy_named
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.clock.records import ClientTiming, RoundTiming
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.runs.extras.groups.leads import federate_led, follow_leads
from flcav.runs.extras.groups.rows import LeadTerm

SCHEDULE = Schedule(rounds=4, steps=2, learning_rate=0.1, final_learning_rate=0.05, seed=3)
START = {"w": np.arange(6, dtype=np.float64)}


@dataclass
class Client:
    """A client whose update depends on the weights, its data and the round's seed, and that counts when it trains."""

    pull: float
    trained: list[int] = field(default_factory=list)

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        self.trained.append(seed)
        noise = np.random.default_rng(seed).normal(size=6)
        return LocalUpdate({"w": weights["w"] * (1 - learning_rate) + self.pull + noise}, int(self.pull * 10), 1.0)


def clients() -> dict[str, Client]:
    return {name: Client(pull) for name, pull in (("r/a", 0.1), ("r/b", 0.5), ("r/c", 0.9), ("r/d", 1.3))}


def account(outages: dict[tuple[int, str], Outage] | None = None, **more: Any) -> Account:
    return Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "t", "wireless", outages or {}, **more)


def lead(
    clients: Any, weights: Weights, own: Account, terms: list[LeadTerm], on_round: OnRound, **about: Any
) -> Weights:
    """Federate under the leads of these terms."""
    state, done = about.pop("state", None) or FederationState(), about.pop("done", 0)
    schedule = about.pop("schedule", SCHEDULE)

    def run(weights: Weights, account: Account, done: int, on_round: OnRound) -> LocalUpdate:
        return federate(clients, weights, schedule, account, state=state, done=done, on_round=on_round, **about)

    return federate_led(run, weights, own, terms, on_round, state=state, done=done).weights


def led(terms: list[LeadTerm], outages: dict[tuple[int, str], Outage], **how: Any) -> tuple[Weights, Account, dict]:
    own, vehicles, reached = account(outages), clients(), dict[int, Weights]()
    keep = lambda number, weights, _loss: reached.__setitem__(number, weights)  # noqa: E731
    weights = lead(vehicles, START, own, terms, keep, **how)
    assert [*reached] == [*range(how.get("done", 0) + 1, 5)]
    np.testing.assert_array_equal(weights["w"], reached[4]["w"])
    return weights, own, vehicles


LEAVES = {(3, "r/a"): Outage("left the town", 17), (4, "r/a"): Outage("not in the town")}


def test_a_lead_that_leaves_in_mid_round_is_replaced_and_the_weights_are_those_of_the_next_lead_from_its_start() -> (
    None
):
    weights, own, vehicles = led([LeadTerm("r/a", 1, 3, 2), LeadTerm("r/b", 3)], LEAVES)
    away = {key: Outage("left the town") for key in LEAVES}
    alone = account(away, within=frozenset({"r/b"}))
    expected = federate(clients(), START, SCHEDULE, alone).weights
    np.testing.assert_array_equal(weights["w"], expected["w"])
    up = Counter((each.round, each.client) for each in own.ledger if each.direction == "up")
    size = max(each.bytes for each in own.ledger if each.direction == "up")
    assert [up[1, name] for name in vehicles] == [0, 1, 1, 1]  # the lead's own crosses no link
    received = [name for name in vehicles if name not in ("r/a", "r/b")]
    assert sum(up[3, name] for name in vehicles) == 2 + len(received)  # two to a, which are lost; two to b
    assert [up[4, name] for name in vehicles] == [0, 0, 1, 1]
    assert own.ledger.used_bytes("wireless") == pytest.approx((3 + 3 + 4 + 2) * size, rel=0.01)
    assert Counter(vehicles["r/b"].trained).most_common(1)[0][1] == 2  # its update was with a, and is asked again
    assert up[3, "r/d"] == 1  # it had not arrived
    assert len(set(vehicles["r/b"].trained)) == 4  # the same round: no random number of its own


@pytest.mark.parametrize("received", [0, 1, 2])
def test_however_many_updates_it_had(received: int) -> None:
    weights, own, _ = led([LeadTerm("r/a", 1, 3, received), LeadTerm("r/b", 3)], LEAVES)
    np.testing.assert_array_equal(weights["w"], led([LeadTerm("r/a", 1, 3), LeadTerm("r/b", 3)], LEAVES)[0]["w"])
    assert sum(each.round == 3 and each.direction == "up" for each in own.ledger) == received + 2


def test_several_leave_one_after_another() -> None:
    outages = LEAVES | {(3, "r/b"): Outage("left the town", 0), (4, "r/b"): Outage("not in the town")}
    terms = [LeadTerm("r/a", 1, 3, 1), LeadTerm("r/b", 3, 3, 1), LeadTerm("r/c", 3)]
    weights, own, _ = led(terms, outages)
    away = account({key: Outage("gone") for key in outages}, within=frozenset({"r/c"}))
    np.testing.assert_array_equal(weights["w"], federate(clients(), START, SCHEDULE, away).weights["w"])
    assert sum(each.round == 3 and each.direction == "up" for each in own.ledger) == 1 + 1 + 1


def test_a_stopped_group_goes_on_in_the_term_of_its_round() -> None:
    terms, states, reached = [LeadTerm("r/a", 1, 3, 2), LeadTerm("r/b", 3)], FederationState(), dict[int, Weights]()
    whole, own, _ = led(terms, LEAVES)

    def stop(number: int, weights: Weights, _loss: float | None) -> None:
        reached[number] = weights
        if number == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lead(clients(), START, account(LEAVES), terms, stop, state=states)
    rest = account(LEAVES)
    keep = lambda number, weights, loss: None  # noqa: E731
    after = lead(clients(), reached[2], rest, terms, keep, state=states, done=2)
    np.testing.assert_array_equal(after["w"], whole["w"])
    assert [e for e in own.ledger if e.round > 2] == [*rest.ledger]
    assert [each.round for each in states.records] == [1, 2, 3, 4]


def test_what_a_lead_kept_is_lost_with_it() -> None:
    strategy: Any = {"strategy": strategy_named({"fedavgm": {"momentum": 0.9}})}
    weights, _, _ = led([LeadTerm("r/a", 1, 3), LeadTerm("r/b", 3)], LEAVES, **strategy)
    first = federate(clients(), START, Schedule(4, 2, 0.1, 0.05, 3), account(LEAVES), **strategy).weights
    assert not np.array_equal(weights["w"], first["w"])  # which has the moments of all rounds


def timing(number: int, *clients: tuple[str, float, str]) -> RoundTiming:
    rows = [ClientTiming(name, "pole1", number, 0, 0, 0, 0, end, 0, 0, why) for name, end, why in clients]
    return RoundTiming(number, 0, 9, 0, 0, tuple(rows))


@pytest.mark.parametrize(
    ("rounds", "terms"),
    [
        ([timing(1, ("a", 1, ""), ("b", 2, "")), timing(2, ("a", 1, ""), ("b", 2, ""))], [LeadTerm("r/a", 1)]),
        (  # b's update is there, c's is not
            [timing(1, ("a", 2, "left the town"), ("b", 1, ""), ("c", 3, "")), timing(2, ("b", 1, ""), ("c", 1, ""))],
            [LeadTerm("r/a", 1, 1, 1), LeadTerm("r/b", 1)],
        ),
        (  # it leaves when all updates are there, and is away in the next round
            [timing(1, ("a", 4, "left the town"), ("b", 1, ""), ("c", 3, "")), timing(2, ("b", 1, ""), ("c", 1, ""))],
            [LeadTerm("r/a", 1, 2), LeadTerm("r/b", 2)],
        ),
        (  # past a deadline its update is late, but it is there
            [timing(1, ("a", 2, "past the deadline"), ("b", 1, ""), ("c", 3, ""))],
            [LeadTerm("r/a", 1)],
        ),
        (  # a comes back, and leads no more while another can
            [timing(1, ("b", 1, ""), ("c", 1, "")), timing(2, ("a", 1, ""), ("c", 1, "")), timing(3, ("a", 1, ""))],
            [LeadTerm("r/a", 1, 1), LeadTerm("r/b", 1, 2), LeadTerm("r/c", 2, 3), LeadTerm("r/a", 3)],
        ),
        ([timing(1)], [LeadTerm("r/a", 1)]),  # nobody is there
    ],
)
def test_who_leads_by_the_clock(rounds: list[RoundTiming], terms: list[LeadTerm]) -> None:
    assert [*follow_leads(["r/a", "r/b", "r/c"], "r/a", rounds, "r")] == terms


def test_a_round_begins_again_where_clients_train_in_processes() -> None:
    terms, found = [LeadTerm("r/a", 1, 2, 1), LeadTerm("r/b", 2)], []
    for count in (1, 2):
        own, vehicles = account(), clients()
        with ClientProcesses(vehicles, 2) if count == 2 else nullcontext() as where:
            weights = lead(vehicles, START, own, terms, lambda *_: None, runtime=where)
        found.append((weights["w"].tobytes(), Counter(own.ledger.entries)))
    assert found[0] == found[1]

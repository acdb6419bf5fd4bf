"""Rounds on a network: who takes part, who is lost, by name and in bytes, and how long a round takes."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from moving import made_links

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer, edge_seeds
from flcav.federation.exchange import ClientFailed
from flcav.federation.links.metered import Account, Outage
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.robust import Krum, TrimmedMean
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.network.clock.rounds import NetworkSettings, RoundRules
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.network.radio.links import RadioLinks, Wireline
from flcav.runs import driving as prediction
from flcav.runs.driving import (
    DrivenRounds,
    Fleet,
    drive_rounds,
    join_regions,
    link_drive,
    measure_uplinks,
    predict_air_s,
)
from flcav.runs.poles import Sites
from flcav.runs.recipe import CLOUD, Stragglers, draw_stragglers

GOOD, NONE = 30.0, -40.0  # dB: 20 Mbit/s of 10 MHz; nothing
MB = 1_000_000
NAN = np.nan
NAMES = tuple(f"grid/cav{i}" for i in range(3))
FLEET = Fleet("grid", NAMES, 5 * MB, 10 * MB, 1.0, {"grid/cav2": 0.25})
TIMES = np.arange(0.0, 60.0)


def drive(
    scenes: list[RadioLinks],
    rules: Any = None,
    rounds: int = 1,
    earlier: int = 0,
    deadline_s: float | None = None,
) -> DrivenRounds:
    settings = NetworkSettings(rounds=RoundRules(deadline_s=deadline_s))
    return drive_rounds(FLEET, scenes, settings, Rules.model_validate(rules or {}), range(1, rounds + 1), earlier)


def test_a_round_takes_download_training_and_upload_of_all_that_share_the_band() -> None:
    driven = drive([made_links(TIMES, {"cav0": GOOD, "cav2": GOOD})])
    assert driven.outages == {(1, "grid/cav1"): Outage("not in the town")}  # the recording has no such vehicle
    # both download 5 MB at 10 Mbit/s: 4 s; cav0 trains 1 s, cav2 4 s; cav0 uploads alone from 5 s to 8 s, 7.5 of 10 MB,
    # the rest shared until 10 s; cav2 has 2.5 MB by then and sends 7.5 MB alone, in 3 s
    assert driven.seconds == pytest.approx([13.0])
    assert [client.end_s for client in driven.records[0].clients] == pytest.approx([10.0, 13.0])
    assert driven.rules == Rules()


def test_a_straggler_prolongs_a_round_and_misses_its_deadline() -> None:
    scenes = [made_links(TIMES, dict.fromkeys(("cav0", "cav1", "cav2"), GOOD))]
    drawn = draw_stragglers(Stragglers(share=0.3, slower=12), ["cav0", "cav1", "cav2"], 1, "grid")
    slowed = {f"grid/{vehicle}": speed for vehicle, speed in drawn.items()}
    late = NetworkSettings(rounds=RoundRules(deadline_s=20))
    plain, driven, missed = (
        drive_rounds(replace(FLEET, speeds=speeds), scenes, settings, Rules(), range(1, 2), 0)
        for speeds, settings in (({}, NetworkSettings()), (slowed, NetworkSettings()), (slowed, late))
    )
    assert len(slowed) == 1
    assert driven.seconds[0] > plain.seconds[0]
    assert missed.outages.keys() == {(1, name) for name in slowed}


def test_rounds_are_driven_in_the_scenes_in_turn_one_after_another() -> None:
    alone = [made_links(TIMES + 100, {"cav0": GOOD}), made_links(TIMES, {"cav1": GOOD})]
    driven = drive(alone, rounds=3, earlier=1)
    assert [[client.client for client in record.clients] for record in driven.records] == [["cav1"], ["cav0"], ["cav1"]]
    assert [(record.start_s, record.end_s) for record in driven.records] == [
        pytest.approx((7.0 * n, 7.0 * (n + 1)))
        for n in range(3)  # 2 s down, 1 s training, 4 s up
    ]


def test_turns_go_on_after_the_rounds_before() -> None:
    scenes = [made_links(TIMES, dict.fromkeys(("cav0", "cav1", "cav2"), GOOD))]
    turns = {"selection": {"rule": "round-robin", "clients": 2}}
    driven = [client.client for record in drive(scenes, turns, 2, earlier=1).records for client in record.clients]
    assert driven == ["cav0", "cav2", "cav1", "cav2"]  # the first round had 0 and 1


def test_vehicles_that_are_lost_have_sent_what_came_before() -> None:
    leaves = np.where(TIMES < 5, GOOD, NAN)  # 2 s down, 1 s training: 2 s of sending, 5 MB
    driven = drive([made_links(TIMES, {"cav0": leaves})])
    assert driven.outages[1, "grid/cav0"] == Outage("left the town", 5 * MB)
    silent = np.where(TIMES < 4, GOOD, NONE)
    driven = drive([made_links(TIMES, {"cav0": silent})])
    assert driven.outages[1, "grid/cav0"] == Outage("out of coverage", int(2.5 * MB))
    assert driven.seconds == pytest.approx([5.0])  # a second without a rate
    late = drive([made_links(TIMES, {"cav0": GOOD})], deadline_s=6.0)
    assert late.outages[1, "grid/cav0"] == Outage("past the deadline", int(7.5 * MB))


def test_deadline_selection_asks_those_whose_round_is_predicted_to_end_in_time() -> None:
    scene = made_links(TIMES, {"cav0": GOOD, "cav2": GOOD})
    rules = {"selection": {"rule": "deadline", "deadline_s": 12.0}}
    driven = drive([scene, made_links(TIMES, {"cav2": GOOD})], rules, rounds=2)
    assert driven.outages == {
        (1, "grid/cav1"): Outage("not in the town"),
        (1, "grid/cav2"): Outage("predicted past the deadline"),  # its round ends at 13 s
        (2, "grid/cav0"): Outage("not in the town"),
        (2, "grid/cav1"): Outage("not in the town"),
    }
    assert driven.rules.selection.rule == "planned"
    assert driven.rules.selection.joins == {"grid/cav0": (1,), "grid/cav1": (), "grid/cav2": (2,)}
    assert driven.seconds == pytest.approx([7.0, 10.0])  # alone, and so faster
    seconds = dict(zip(NAMES, (13.0, 1.0, 1.0), strict=True))
    given = drive([scene], {"selection": {"rule": "deadline", "deadline_s": 12.0, "seconds": seconds}})
    assert given.rules.selection.rule == "deadline"
    assert [client.client for client in given.records[0].clients] == ["cav2"]
    with pytest.raises(InputError, match="'seconds' has no time of a round for 2 of 3 clients, such as grid/cav1"):
        drive([scene], {"selection": {"rule": "deadline", "deadline_s": 12.0, "seconds": {"grid/cav0": 13.0}}})


class Walk:
    def __init__(self) -> None:
        self.trained = 0

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        self.trained += 1
        return LocalUpdate({"w": weights["w"] + np.float32(1 + seed % 7)}, 3, 0.5)


START = {"w": np.zeros(1000, np.float32)}
OUTAGES = {(1, "grid/cav1"): Outage("out of coverage", 999), (2, "grid/cav2"): Outage("not in the town")}


@pytest.mark.parametrize("masked", [False, True])
def test_a_round_goes_on_without_those_that_the_network_loses(masked: bool) -> None:
    clients = {name: Walk() for name in NAMES}
    book, state = Ledger(LinkMegabytes(1.0, 0.0)), FederationState()
    rules = Rules.model_validate({"secure": {}} if masked else {})
    account = Account(book, "edge", "t", "wireless", OUTAGES)
    federate({**clients}, START, Schedule(2, 1, 0.1, 0.1, 3), account, rules=rules, state=state)
    assert [record.clients for record in state.records] == [(NAMES[0], NAMES[2]), NAMES[:2]]
    assert [record.failed for record in state.records] == [
        {"grid/cav1": "out of coverage"},
        {"grid/cav2": "not in the town"},
    ]
    assert [clients[name].trained for name in NAMES] == [2, 2, 1]
    ups = [(e.round, e.client, e.bytes) for e in book.entries if e.direction == "up" and e.bytes > 3000]
    assert [each[:2] for each in ups] == [(1, NAMES[0]), (1, NAMES[2]), (2, NAMES[0]), (2, NAMES[1])]
    assert [e.bytes for e in book.entries if (e.round, e.client, e.direction) == (1, NAMES[1], "up")][-1] == 999


def test_a_round_that_loses_everybody_leaves_the_weights() -> None:
    book, state = Ledger(LinkMegabytes(1.0, 1.0)), FederationState()
    lost = {(1, name): Outage("not in the town") for name in NAMES}
    clients: dict[str, Trainable] = {name: Walk() for name in NAMES}
    server = EdgeServer(clients, 1, Account(book, CLOUD, "t", "wireless", lost), START, state=state)
    schedule = Schedule(1, 1, 0.1, 0.1, 3)
    end = federate({"grid": server}, START, schedule, Account(book, CLOUD, "t", "wireline"))
    assert np.array_equal(end.weights["w"], START["w"])
    assert (state.records[0].clients, state.records[0].loss, len(state.records[0].failed)) == ((), None, 3)


LATE, GONE = Outage("past the deadline", 7), Outage("not in the town")


@pytest.mark.parametrize(
    ("lost", "joins", "others"),
    [
        ({NAMES[0]: GONE, NAMES[1]: GONE}, NAMES, "1 clients sent keys"),
        ({NAMES[0]: LATE, NAMES[1]: GONE}, NAMES, "1 clients sent an update"),
        (dict.fromkeys(NAMES, LATE), NAMES, "0 clients sent an update"),
        ({}, NAMES[2:], "1 clients sent keys"),
    ],
    ids=["not there", "late", "all late", "one by the plan"],
)
def test_a_masked_round_that_the_network_leaves_too_few_for_has_no_update_and_the_next_goes_on(
    lost: dict[str, Outage], joins: tuple[str, ...], others: str
) -> None:
    clients: dict[str, Trainable] = {name: Walk() for name in NAMES}
    plan = {name: (1, 2, 3) if name in joins else (1, 3) for name in NAMES}
    rules = Rules.model_validate({"secure": {}, "selection": {"rule": "planned", "joins": plan}})
    book, state, after = Ledger(LinkMegabytes(1.0, 0.0)), FederationState(), []
    account = Account(book, "edge", "t", "wireless", {(2, name): outage for name, outage in lost.items()})
    federate(
        clients,
        START,
        Schedule(3, 1, 0.1, 0.1, 3),
        account,
        rules=rules,
        state=state,
        on_round=lambda number, weights, loss: after.append((weights["w"][0], loss)),
    )
    assert [record.clients for record in state.records] == [NAMES, (), NAMES]
    failed = state.records[1].failed
    assert {name: failed[name] for name in lost} == {name: outage.reason for name, outage in lost.items()}
    assert {*failed} == {*lost, *joins}
    assert all(others in failed[name] and "2 are needed" in failed[name] for name in joins if name not in lost)
    assert (state.records[1].samples, state.records[1].loss) == (0, None)
    assert after[1] == (after[0][0], None)
    assert after[2][0] != after[1][0]


@pytest.mark.parametrize(
    ("rules", "why"),
    [
        ({"secure": {}}, "secure aggregation: 1 clients sent keys, and 2 are needed"),
        ({"secure": {"threshold": 2}}, "secure aggregation: 1 clients sent keys, and 2 are needed"),
        ({"least_clients": 2}, "least_clients: 2 are wanted in a round, and 1 takes part"),
        ({"least_clients": 3, "secure": {}}, "least_clients: 3 are wanted in a round, and 1 takes part"),
    ],
)
def test_a_first_round_that_the_network_predicts_for_one_vehicle_has_no_update_and_the_run_goes_on(
    rules: dict[str, Any], why: str
) -> None:
    plan = {"rule": "planned", "joins": {name: (1, 2) if name == NAMES[0] else (2,) for name in NAMES}}
    clients = {name: Walk() for name in NAMES}
    account, state, after = Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "t", "wireless"), FederationState(), []
    federate(
        {**clients},
        START,
        Schedule(2, 1, 0.1, 0.1, 3),
        account,
        rules=Rules.model_validate(rules | {"selection": plan}),
        state=state,
        on_round=lambda number, weights, loss: after.append((weights["w"][0], loss)),
    )
    assert [record.clients for record in state.records] == [(), NAMES]
    assert state.records[0].failed == {NAMES[0]: why}
    assert after[0] == (0.0, None)
    assert after[1][0] > 0
    assert [client.trained for client in clients.values()] == [1, 1, 1]


SLOW = Outage("predicted past the deadline")
SHORT = "least_clients: 2 are wanted in a round, and {} part"


@pytest.mark.parametrize(
    ("rule", "away", "failed"),
    [
        ("planned", {NAMES[1]: SLOW, NAMES[2]: GONE}, {NAMES[0]: SHORT.format("1 takes")}),
        ("planned", dict.fromkeys(NAMES, SLOW), dict.fromkeys(NAMES, SLOW.reason)),
        (
            "all",
            {NAMES[0]: GONE, NAMES[2]: GONE},
            {NAMES[0]: GONE.reason, NAMES[1]: SHORT.format("1 takes"), NAMES[2]: GONE.reason},
        ),
        ("all", dict.fromkeys(NAMES, GONE), dict.fromkeys(NAMES, GONE.reason)),
    ],
    ids=["one in time", "none in time", "one there", "none there"],
)
def test_a_round_that_fewer_vehicles_are_there_for_than_are_wanted_has_no_update_and_the_next_goes_on(
    rule: str, away: dict[str, Outage], failed: dict[str, str]
) -> None:
    joins = {name: (2,) if name in away else (1, 2) for name in NAMES} if rule == "planned" else {}
    rules = Rules.model_validate({"selection": {"rule": rule, "joins": joins}, "least_clients": 2})
    clients, state = {name: Walk() for name in NAMES}, FederationState()
    lost = {(1, name): outage for name, outage in away.items()}
    account = Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "t", "wireless", lost)
    federate({**clients}, START, Schedule(2, 1, 0.1, 0.1, 3), account, rules=rules, state=state)
    assert [record.clients for record in state.records] == [(), NAMES]
    assert [record.failed for record in state.records] == [failed, {}]
    assert [client.trained for client in clients.values()] == [1, 1, 1]


def test_all_are_those_who_are_there() -> None:
    state, book = FederationState(), Ledger(LinkMegabytes(1.0, 0.0))
    account = Account(book, "edge", "t", "wireless", {(1, NAMES[1]): GONE, (2, NAMES[1]): LATE})
    schedule, rules = Schedule(2, 1, 0.1, 0.1, 3), Rules(least_clients="all")
    with pytest.raises(ClientFailed, match=r"round 2: 2 of 3 clients .*, 3 are wanted \(grid/cav1: past the deadline"):
        federate({name: Walk() for name in NAMES}, START, schedule, account, rules=rules, state=state)
    assert [(record.clients, record.failed) for record in state.records] == [(NAMES[::2], {NAMES[1]: GONE.reason})]


def test_a_round_that_chance_leaves_to_nobody_names_nobody() -> None:
    state, account = FederationState(), Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "t", "wireless")
    rules = Rules.model_validate({"selection": {"rule": "poisson", "probability": 1e-9}, "least_clients": 1})
    federate({name: Walk() for name in NAMES}, START, Schedule(1, 1, 0.1, 0.1, 3), account, rules=rules, state=state)
    assert [(record.clients, record.failed) for record in state.records] == [((), {})]


def test_a_round_with_fewer_than_were_to_take_part_by_chance_has_no_update() -> None:
    names = [f"grid/cav{i}" for i in range(6)]
    state, account = FederationState(), Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "t", "wireless")
    rules = Rules.model_validate({"selection": {"rule": "poisson", "probability": 0.4}, "least_clients": 3})
    federate({name: Walk() for name in names}, START, Schedule(8, 1, 0.1, 0.1, 3), account, rules=rules, state=state)
    chosen = [len(record.clients) or len(record.failed) for record in state.records]
    assert [len(record.clients) for record in state.records] == [count if count >= 3 else 0 for count in chosen]
    assert min(chosen) < 3 <= max(chosen)


FIVE = tuple(f"grid/cav{i}" for i in range(5))


@pytest.mark.parametrize("left", [0, 1, 4])
@pytest.mark.parametrize(
    ("strategy", "told"),
    [(Krum(), "krum: 5 clients or more are wanted"), (TrimmedMean(), "trimmed-mean: a fraction of 0.2")],
    ids=["krum", "trimmed-mean"],
)
def test_a_round_with_fewer_than_the_strategy_needs_has_no_update_and_the_next_goes_on(
    strategy: Strategy, told: str, left: int
) -> None:
    state, after = FederationState(), []
    lost = {(2, name): GONE for name in FIVE[left:]}
    federate(
        {name: Walk() for name in FIVE},
        START,
        Schedule(3, 1, 0.1, 0.1, 3),
        Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "t", "wireless", lost),
        strategy=strategy,
        state=state,
        on_round=lambda number, weights, loss: after.append((weights["w"][0], loss)),
    )
    assert [record.clients for record in state.records] == [FIVE, (), FIVE]
    failed = state.records[1].failed
    assert {name: failed[name] for name in FIVE[left:]} == dict.fromkeys(FIVE[left:], GONE.reason)
    assert {*failed} == {*FIVE}
    assert all(told in failed[name] for name in FIVE[:left])
    assert after[1] == (after[0][0], None)
    assert after[2][0] != after[1][0]


def test_half_of_those_whom_the_network_leaves_are_enough() -> None:
    class Fails(Walk):
        def train(self, weights: Weights, **how: Any) -> LocalUpdate:
            raise OSError("no power")

    def run(fails: tuple[str, ...], rules: Rules) -> FederationState:
        clients: dict[str, Trainable] = {name: Fails() if name in fails else Walk() for name in NAMES}
        state, account = FederationState(), Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "t", "wireless", OUTAGES)
        federate(clients, START, Schedule(1, 1, 0.1, 0.1, 3), account, rules=rules, state=state)
        return state

    assert run(NAMES[:1], Rules()).records[0].clients == NAMES[2:]  # one of the two whom the network did not lose
    with pytest.raises(ClientFailed, match=r"0 of 2 clients sent an update that can be used, 1 are wanted"):
        run((NAMES[0], NAMES[2]), Rules())
    for rules, wanted in ((Rules(least_clients=2), 2), (Rules(least_clients="all"), 3)):
        with pytest.raises(ClientFailed, match=f"1 of 3 clients .*, {wanted} are wanted"):
            run(NAMES[:1], rules)


def test_the_network_knows_whom_an_edge_server_will_draw() -> None:
    names = [f"grid/cav{i}" for i in range(6)]
    rules, state = Rules.model_validate({"selection": {"rule": "uniform", "clients": 2}}), FederationState()
    book, schedule = Ledger(LinkMegabytes(1.0, 1.0)), Schedule(3, 1, 0.1, 0.1, 3)
    clients: dict[str, Trainable] = {name: Walk() for name in names}
    server = EdgeServer(clients, 2, Account(book, CLOUD, "t", "wireless"), START, rules=rules, state=state)
    federate({"grid": server}, START, schedule, Account(book, CLOUD, "t", "wireline"))
    seeds = [seed for number in (1, 2, 3) for seed in edge_seeds(schedule, number, "grid", 2)]
    drawn = [tuple(rules.selection.choose(names, number, seed)) for number, seed in enumerate(seeds, start=1)]
    assert [record.clients for record in state.records] == drawn
    assert len(set(drawn)) > 1


def test_a_cloud_round_waits_for_the_slowest_region_and_the_wireline() -> None:
    grid = drive([made_links(TIMES, {"cav0": GOOD})], rounds=4)
    two = drive([made_links(TIMES, {"cav0": GOOD}), made_links(TIMES, {"cav0": GOOD, "cav2": GOOD})], rounds=4)
    settings = NetworkSettings(wireline=Wireline(rate_mbps=8.0, latency_s=0.5))
    both = join_regions({"grid": grid, "ring": two}, 2, 2 * settings.wireline.seconds(2 * MB))
    assert both.rules == grid.rules
    assert both.seconds[CLOUD] == pytest.approx([2 * 2.5 + 7 + 13] * 2)
    assert both.seconds["grid"] == pytest.approx([7.0] * 4)
    assert set(both.outages) == set(grid.outages) | set(two.outages)


def test_a_plan_s_time_on_the_air_is_the_mean_of_those_that_share_the_band():
    """5 MB down and 10 MB up at 20 Mbit/s: 6 s alone, 12 s for each of two; a third has no rate, a fourth is away."""
    alone = made_links(np.arange(0.0, 40.0), {"cav0": 30.0})
    pair = made_links(np.arange(0.0, 40.0), {"cav0": 30.0, "cav1": 30.0, "cav3": np.nan})
    deaf = made_links(np.arange(0.0, 40.0), {"cav2": -60.0})
    assert predict_air_s([alone], 5_000_000, 10_000_000) == pytest.approx(6.0)
    assert predict_air_s([alone, pair, deaf], 5_000_000, 10_000_000) == pytest.approx((6.0 + 12.0 + 12.0) / 3)
    assert predict_air_s([deaf, made_links([0.0], {"cav0": 30.0})], 5_000_000, 10_000_000) is None


def test_before_sensors_are_placed_vehicles_are_linked_to_the_pole_with_most_traffic(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    linked = {"s0": made_links(TIMES, {"cav0": GOOD, "cav1": NAN}), "s1": made_links(TIMES, {"cav0": NONE})}
    asked: list[Any] = []

    def link(data: Any, radio: Any, poles: Any, scene: str, seed: int) -> Any:
        asked.append((poles, scene, seed))
        return SimpleNamespace(links=linked[scene])

    sites, nowhere = (
        Sites(np.array([4, 7]), np.array([[0.0, 0, 6], [50.0, 0, 6]])),
        Sites(np.zeros(0, int), np.zeros((0, 3))),
    )
    monkeypatch.setattr(prediction, "link_scene", link)
    monkeypatch.setattr(prediction, "find_sites", lambda drive, edge: sites if edge is None else nowhere)
    monkeypatch.setattr(prediction, "read_traces", lambda data, frames: ())
    monkeypatch.setattr(prediction, "measure_traffic_density", lambda at, traces, range_m: np.array([1.0, 3.0]))
    keys = [SimpleNamespace(scene=scene) for scene in ("s0", "s0", "s1")]
    pool: Any = SimpleNamespace(data=SimpleNamespace(keys=keys, town=lambda: "grid"), vehicles=(0, 1, 2))
    settings = NetworkSettings()
    assert link_drive("grid", pool, settings, 40.0, 3, recorded=False) == [*linked.values()]
    assert asked == [((7,), "s0", 3), ((7,), "s1", 3)]
    rates = measure_uplinks("grid", pool, settings, 40.0, 3)
    best = linked["s0"].rate_bps[0, 0, 0] / 1e6
    assert rates == pytest.approx({"grid/cav0": best / 2, "grid/cav1": 0.0}, abs=1e-3)
    with pytest.raises(InputError, match="'grid' has no poles"):
        link_drive("grid", pool, settings, 40.0, 3, recorded=True)

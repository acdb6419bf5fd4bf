"""Clients that fail in a round: how many may, who is named, and what says that too few are left."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from regression import START, Regression, ledger, vehicles

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer
from flcav.federation.exchange import ClientFailed
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy
from flcav.federation.rules import Rules, SecureAggregation
from flcav.federation.secure.messages import TooFewClients
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy, strategy_named
from flcav.federation.strategies.fedavg import average
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.robust import Krum, Median
from flcav.federation.trainable import LocalUpdate, Trainable, Update, Weights
from flcav.network.ledger import BudgetExceeded

SCHEDULE = Schedule(rounds=2, steps=5, learning_rate=0.05, final_learning_rate=0.01, seed=3)


def edge() -> Account:
    return Account(ledger(), "edge", "regression", "wireless")


def failing(number: int, fail: int) -> dict[str, Regression]:
    clients = vehicles("grid", number)
    for each in [*clients.values()][:fail]:
        each.fail = True
    return clients


@pytest.mark.parametrize(("number", "fail"), [(4, 2), (5, 2), (2, 1)])
def test_by_default_a_round_goes_on_with_half_of_the_clients_and_names_the_others(number: int, fail: int):
    clients, state = failing(number, fail), FederationState()
    found = federate(clients, START, SCHEDULE, edge(), state=state)
    usable = {name: client for name, client in clients.items() if not client.fail}
    assert [record.clients for record in state.records] == [tuple(usable)] * SCHEDULE.rounds
    assert all(record.failed.keys() == clients.keys() - usable.keys() for record in state.records)
    assert all("no power" in reason for record in state.records for reason in record.failed.values())
    np.testing.assert_array_equal(found.weights["w"], federate(usable, START, SCHEDULE, edge()).weights["w"])


@pytest.mark.parametrize(
    ("number", "fail", "least", "wanted"),
    [(4, 3, None, 2), (5, 3, None, 3), (1, 1, None, 1), (4, 1, "all", 4), (4, 2, 3, 3), (4, 4, 1, 1)],
)
def test_fewer_clients_than_are_wanted_end_the_federation_with_their_reasons(
    number: int, fail: int, least: Any, wanted: int
):
    told = f"round 1: {number - fail} of {number} clients sent an update that can be used, {wanted} are wanted"
    with pytest.raises(ClientFailed, match=rf"{told} \(grid/cav0: .*no power"):
        federate(failing(number, fail), START, SCHEDULE, edge(), rules=Rules(least_clients=least))


def test_half_of_all_have_to_tell_their_samples_and_half_of_those_drawn_have_to_send():
    class Miscounting(Regression):
        def count_samples(self, steps: int) -> int:
            raise OSError("no memory")

    def run(clients: Mapping[str, Trainable], rule: str, least: Any = None) -> FederationState:
        state, selection = FederationState(), Selection.model_validate({"rule": rule, "clients": 2, **extra[rule]})
        rules = Rules(selection=selection, least_clients=least)
        federate(clients, START, replace(SCHEDULE, rounds=1), edge(), rules=rules, state=state)
        return state

    extra: dict[str, dict[str, bool]] = {"uniform": {"unbiased": True}, "importance": {}}
    deaf = {
        name: Miscounting(each.inputs, each.targets) if i < 3 else each
        for i, (name, each) in enumerate(vehicles("grid", 5).items())
    }
    with pytest.raises(ClientFailed, match=r"2 of 5 clients .*, 3 are wanted .*no memory"):
        run(deaf, "uniform")
    assert run(failing(5, 2), "importance").records[0].failed.keys() == {"grid/cav0", "grid/cav1"}
    with pytest.raises(ClientFailed, match=r"2 of 5 clients .*, 3 are wanted .*no power"):
        run(failing(5, 3), "importance")
    for clients, rule, left in ((deaf, "uniform", 2), (failing(5, 3), "importance", 2)):
        with pytest.raises(ClientFailed, match=f"{left} of 5 clients .*, 5 are wanted"):
            run(clients, rule, "all")
    assert len(run(failing(5, 3), "importance", 1).records[0].failed) == 3  # of those who were to report
    with pytest.raises(ClientFailed, match=r"0 of 2 clients .*, 1 are wanted .*no memory"):  # cav1 and cav2 are drawn
        run(deaf, "uniform", 1)
    record = run(deaf | {"grid/cav2": vehicles("grid", 5)["grid/cav2"]}, "uniform", 1).records[0]
    assert (record.clients, {*record.failed}) == (("grid/cav2",), {"grid/cav0", "grid/cav1"})


def test_a_client_s_word_that_a_budget_is_exceeded_ends_nothing_and_an_edge_server_s_does():
    class Claiming(Regression):
        def train(self, weights: Any, **how: Any) -> LocalUpdate:
            raise BudgetExceeded("wireless uplink budget exceeded")

    clients, state = vehicles("grid", 3), FederationState()
    first = clients["grid/cav0"]
    given = {**clients, "grid/cav0": Claiming(first.inputs, first.targets)}
    for rules in (Rules(), Rules.model_validate({"secure": {}})):
        federate(given, START, SCHEDULE, edge(), rules=rules, state=state)
        assert all(record.failed.keys() == {"grid/cav0"} for record in state.records)
        assert "wireless uplink budget exceeded" in state.records[0].failed["grid/cav0"]
        state.records.clear()
    account = Account(ledger(wireless_mb=1e-4), "cloud", "regression", "wireless")
    server = EdgeServer(clients, 1, account, START)
    with pytest.raises(BudgetExceeded, match="wireless uplink budget exceeded"):
        federate({"grid": server}, START, SCHEDULE, edge())


@pytest.mark.parametrize("least", [None, 1, "all"])
@pytest.mark.parametrize(
    "selection",
    [
        {"rule": "uniform", "clients": 2, "unbiased": True},
        {"rule": "poisson", "probability": 0.9, "unbiased": True},
        {"rule": "importance", "clients": 2},
    ],
    ids=["uniform", "poisson", "importance"],
)
def test_a_round_in_which_no_client_reports_is_no_chance_and_ends_the_federation(selection: dict[str, Any], least: Any):
    class Broken(Regression):
        def count_samples(self, steps: int) -> int:
            raise OSError("no power")

    clients = {name: Broken(each.inputs, each.targets, fail=True) for name, each in vehicles("grid", 6).items()}
    rules, state = Rules.model_validate({"selection": selection, "least_clients": least}), FederationState()
    with pytest.raises(ClientFailed, match=r"^round 1: .* wanted.*\(grid/cav0: .*no power"):
        federate(clients, START, SCHEDULE, edge(), rules=rules, state=state)
    assert not state.records


@pytest.mark.parametrize("samples", [0, -1, 2.5, 10**30, np.nan, np.inf])
@pytest.mark.parametrize(
    "rules",
    [
        {},
        {"secure": {}},
        {"selection": {"rule": "uniform", "clients": 5, "unbiased": True}},
        {"selection": {"rule": "importance", "clients": 5}},
    ],
    ids=["open", "secure", "unbiased", "importance"],
)
def test_a_client_of_no_number_of_samples_is_named_and_the_others_go_on(samples: Any, rules: dict[str, Any]):
    class Odd(Regression):
        def train(self, *weights: Any, **how: Any) -> LocalUpdate:
            return replace(super().train(*weights, **how), samples=samples)

        def count_samples(self, steps: int) -> int:
            return samples

    honest, state = vehicles("grid", 5), FederationState()
    odd = Odd(honest["grid/cav1"].inputs, honest["grid/cav1"].targets)
    how = {"rules": Rules.model_validate(rules), "strategy": FEDAVG if rules else Krum(byzantine=0)}
    federate(honest | {"grid/cav1": odd}, START, SCHEDULE, edge(), state=state, **how)
    for record in state.records:
        assert record.failed.keys() == {"grid/cav1"}
        assert "samples" in record.failed["grid/cav1"]


def test_samples_and_loss_may_be_numbers_of_numpy():
    class Scalars(Regression):
        def train(self, *weights: Any, **how: Any) -> LocalUpdate:
            found = super().train(*weights, **how)
            return replace(found, samples=np.int64(found.samples), loss=np.float32(0.5))

        def count_samples(self, steps: int) -> int:
            return np.int64(3)  # type: ignore[return-value]

    clients = {name: Scalars(each.inputs, each.targets) for name, each in vehicles("grid", 3).items()}
    for selection in ({"rule": "importance", "clients": 3}, {"rule": "uniform", "clients": 3, "unbiased": True}):
        state = FederationState()
        rules = Rules.model_validate({"selection": selection})
        federate(clients, START, SCHEDULE, edge(), rules=rules, state=state)
        assert [(record.failed, record.loss) for record in state.records] == [({}, 0.5)] * SCHEDULE.rounds


def test_one_client_that_fails_to_report_does_not_pass_for_a_small_draw():
    rules = Rules.model_validate({"selection": {"rule": "importance", "clients": 1}, "least_clients": 5})
    with pytest.raises(ClientFailed, match=r"^round 1: least_clients: 5 are wanted .*\(grid/cav0: .*no power"):
        federate(failing(6, 1), START, SCHEDULE, edge(), rules=rules)
    state = FederationState()
    federate(failing(6, 0), START, SCHEDULE, edge(), rules=rules, state=state)
    assert [record.clients for record in state.records] == [(), ()]


@pytest.mark.parametrize(
    "selection",
    [{"rule": "poisson", "probability": 0.9}, {"rule": "importance", "clients": 3}, {"rule": "planned"}],
    ids=["poisson", "importance", "planned"],
)
def test_more_clients_than_there_are_cannot_be_wanted(selection: dict[str, Any]):
    def run(least: int) -> None:
        rules = Rules.model_validate({"selection": selection, "least_clients": least})
        federate(vehicles("grid", 6), START, SCHEDULE, edge(), rules=rules)

    run(6)
    with pytest.raises(InputError, match="least_clients: 7 are wanted in a round, and 6 take part"):
        run(7)


@pytest.mark.parametrize(
    ("strategy", "told"),
    [(Krum(byzantine=1), "krum: 5 clients or more are wanted .* there are 4"), (Median(), None)],
    ids=["krum", "median"],
)
def test_a_strategy_that_needs_more_than_half_says_so(strategy: Strategy, told: str | None):
    """A minority does not end a federation, whatever it sends: the round has no update, and its record says why."""
    clients, state = failing(7, 3), FederationState()
    found = federate(clients, START, SCHEDULE, edge(), strategy=strategy, state=state)
    unmoved = all((found.weights[name] == START[name]).all() for name in START)
    assert unmoved == (told is not None)
    failed = state.records[0].failed
    assert "no power" in failed["grid/cav0"]
    assert len(failed) == (3 if told is None else 7)
    if told is not None:
        assert re.match(told, failed["grid/cav6"])


def test_the_cloud_needs_every_edge_server():
    servers = {name: EdgeServer(failing(4, fail), 1, edge(), START) for name, fail in (("grid", 3), ("ring", 2))}
    with pytest.raises(ClientFailed, match=r"1 of 2 clients .*, 2 are wanted \(grid: .*1 of 4 clients"):
        federate(servers, START, SCHEDULE, edge(), rules=Rules().of_servers())


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "half", 10**6 + 1])
def test_bounds_that_make_no_sense_are_one_sentence(wrong: Any):
    with pytest.raises(ValidationError, match="expected 'all' or a whole number from 1 to 1000000") as caught:
        Rules(least_clients=wrong)
    assert caught.value.error_count() == 1


class Collecting(Regression):
    """Has samples in all of its trainings but those whose numbers are given."""

    def __init__(self, like: Regression, idle: tuple[int, ...]) -> None:
        super().__init__(like.inputs, like.targets)
        self.idle, self.trained, self.counted = idle, 0, 0

    def train(self, weights: Weights, *, shift: Any = None, **how: Any) -> LocalUpdate:
        self.trained += 1
        found = super().train(weights, **how)
        gradient = {"w": found.weights["w"] - weights["w"]} if shift is not None else {}
        return LocalUpdate(found.weights, 0, np.nan) if self.trained in self.idle else replace(found, gradient=gradient)

    def count_samples(self, steps: int) -> int:
        self.counted += 1
        if self.counted not in self.idle:
            return len(self.inputs)
        self.trained += 1  # it is not asked to
        return 0


def collecting(number: int, *idle: int, who: int | None = None) -> dict[str, Collecting]:
    """Return clients of which the first `who` (None: all) have no samples in these trainings."""
    named = enumerate(vehicles("grid", number).items())
    return {name: Collecting(each, idle if who is None or i < who else ()) for i, (name, each) in named}


def follow(clients: Mapping[str, Trainable], rounds: int = 4, account: Account | None = None, **how: Any) -> Any:
    """Return the weights that each round begins with and the last ends with, the records, and the result."""
    state, reached = how.pop("state", None) or FederationState(), [how.pop("start", START)]
    schedule, keep = replace(SCHEDULE, rounds=rounds), lambda _, weights, loss: reached.append(weights)
    found = federate(clients, reached[0], schedule, account or edge(), state=state, on_round=keep, **how)
    return reached, state.records, found


def same(one: Weights, other: Weights) -> bool:
    return {*one} == {*other} and all(np.array_equal(one[name], other[name]) for name in one)


NO_SAMPLES = "0 samples to train on: at least 1 is wanted"


@pytest.mark.parametrize("least", [None, 2, "all"])
@pytest.mark.parametrize(
    ("strategy", "rules"),
    [
        ("fedavg", {}),
        ("fedavgm", {}),
        ("scaffold", {}),
        ("krum", {}),
        ({"trimmed-mean": {"fraction": 0.2}}, {}),
        ("fedavg", {"upload": {"compression": "top-k"}}),
        ("fedavg", {"secure": {}}),
        ("fedavg", {"selection": {"rule": "uniform", "clients": 5, "unbiased": True}}),
        ("fedavg", {"selection": {"rule": "importance", "clients": 5}}),
        ("fedavg", {"selection": {"rule": "round-robin", "clients": 5}}),
    ],
    ids=["fedavg", "fedavgm", "scaffold", "krum", "trimmed", "top-k", "secure", "unbiased", "importance", "turns"],
)
def test_a_round_in_which_no_client_has_samples_is_empty_and_the_next_goes_on(strategy: Any, rules: Any, least: Any):
    clients, account = collecting(5, 2), edge()
    how = {"strategy": strategy_named(strategy), "rules": Rules.model_validate({**rules, "least_clients": least})}
    reached, records, found = follow(clients, account=account, **how)
    assert [record.empty for record in records] == [False, True, False, False]
    assert records[1].failed == dict.fromkeys(clients, NO_SAMPLES)
    assert (records[1].clients, records[1].samples, records[1].loss) == ((), 0, None)
    assert same(reached[2], reached[1])
    assert not same(reached[1], reached[0])
    assert not same(reached[3], reached[2])
    assert same(found.weights, reached[4])
    assert {entry.client for entry in account.ledger.entries if entry.round == 2} == {*clients}


def test_clients_without_samples_leave_the_round_to_the_others():
    idle, state = collecting(5, 1, 2, who=4), FederationState()
    found = federate(idle, START, SCHEDULE, edge(), state=state)
    alone = federate({"grid/cav4": idle["grid/cav4"]}, START, SCHEDULE, edge())
    assert same(found.weights, alone.weights)
    assert [record.clients for record in state.records] == [("grid/cav4",)] * 2
    assert not any(record.empty for record in state.records)
    for rules in (Rules(least_clients=2), Rules(secure=SecureAggregation())):  # fewer are left than these want
        reached, records, _ = follow(collecting(5, 2, who=4), 3, rules=rules)
        assert [record.empty for record in records] == [False, True, False]
        assert "are wanted" in records[1].failed["grid/cav4"] or "are needed" in records[1].failed["grid/cav4"]
        assert same(reached[2], reached[1])
    with pytest.raises(ClientFailed, match="0 of 1 clients"):
        federate({**collecting(5, 1, who=4), "grid/cav4": failing(5, 5)["grid/cav4"]}, START, SCHEDULE, edge())


def test_empty_rounds_in_a_row_end_a_federation_with_what_it_has_reached():
    state = FederationState()
    reached, records, found = follow(collecting(3, 2, 4, 5), 8, rules=Rules(empty_rounds=2), state=state)
    assert [record.empty for record in records] == [False, True, False, True, True]
    assert same(found.weights, reached[3])
    assert not same(found.weights, START)
    assert (found.samples, found.loss) == (0, 0.0)
    how: Any = {"rules": Rules(empty_rounds=2), "state": state, "done": 5}  # a resumed one has ended, too
    assert same(federate(collecting(3), found.weights, replace(SCHEDULE, rounds=8), edge(), **how).weights, reached[3])
    assert len(state.records) == 5
    assert len(follow(collecting(3, 2, 4, 5), 8)[1]) == 8
    with pytest.raises(ValidationError, match="empty_rounds"):
        Rules(empty_rounds=0)


def test_a_buffer_without_samples_is_an_empty_round():
    clients = collecting(3, 2, 3)
    reached, records, _ = follow(clients, 6, strategy=FedBuff(buffer=2))
    for before, after, record in zip(reached, reached[1:], records, strict=False):
        assert same(before, after) == record.empty == (not record.clients)
    assert 0 < sum(record.empty for record in records) < 6
    assert any(record.clients and record.failed for record in records)  # a buffer of one that has samples and another


def test_noise_that_hides_who_was_drawn_hides_empty_rounds():
    selection = Selection.model_validate({"rule": "poisson", "probability": 0.9})
    rules = Rules(selection=selection, privacy=Privacy(clip=1.0, noise=1.0))
    _, records, _ = follow(collecting(5, 1), 1, rules=rules)
    assert [(record.clients, record.failed, record.empty) for record in records] == [((), {}, False)]
    with pytest.raises(InputError, match="an end after 'empty_rounds' would reveal them"):
        follow(collecting(5), rules=rules.model_copy(update={"empty_rounds": 3}))


def test_the_cloud_goes_on_without_a_region_that_has_no_samples():
    def run(k: int, grid: tuple[int, ...], ring: tuple[int, ...], rounds: int) -> Any:
        own = {name: collecting(2, *idle) for name, idle in (("grid", grid), ("ring", ring))}
        own["ring"] = {name.replace("grid", "ring"): each for name, each in own["ring"].items()}
        servers = {name: EdgeServer(own[name], k, edge(), START) for name in own}
        states = {name: server.state.records for name, server in servers.items()}
        return *follow(servers, rounds, rules=Rules().of_servers())[:2], states

    reached, records, states = run(1, (2,), (2, 3), 4)
    assert [record.empty for record in records] == [False, True, False, False]
    assert records[1].failed.keys() == {"grid", "ring"}
    assert same(reached[2], reached[1])
    assert (records[2].clients, records[2].failed) == (("grid",), {"ring": NO_SAMPLES})
    assert [each.empty for each in states["ring"]] == [False, True, True, False]
    _, records, states = run(2, (2,), (), 2)  # the last edge round of the first cloud round
    assert [each.empty for each in states["grid"]] == [False, True, False, False]
    assert records[0].samples == 2 * (4 + 5)
    _, records, _ = run(1, (1,), (1,), 1)  # in the first cloud round each region has its network of stage II
    assert (records[0].clients, records[0].samples, records[0].empty) == (("grid", "ring"), 2, False)


def test_whoever_fails_leaves_the_weights_of_the_last_round_that_ended():
    class Breaks(Collecting):
        def train(self, *given: Any, **how: Any) -> LocalUpdate:
            if self.trained == 2:
                raise OSError("no power")
            return super().train(*given, **how)

    for rules in (Rules(), Rules(secure=SecureAggregation(), least_clients=1)):
        clients = {name: Breaks(each, ()) for name, each in vehicles("grid", 3).items()}
        with pytest.raises((ClientFailed, TooFewClients)) as caught:
            follow(clients, rules=rules)
        good = follow(collecting(3), 4, rules=rules)[0][2]
        assert caught.value.reached is not None
        np.testing.assert_allclose(caught.value.reached["w"], good["w"], atol=1e-6)


@pytest.mark.parametrize(
    ("weights", "told"),
    [
        ({"w": np.array([np.nan, 0.0, np.nan])}, "weights to begin with: 2 of 3 values of 'w' are not finite"),
        ({**START, "b.running_var": np.float32("inf")}, "1 of 1 values of 'b.running_var' are not finite"),
        ({**START, "h": np.array([1, np.inf], np.float16)}, "1 of 2 values of 'h' are not finite"),
        ({"w": [0.0, 1.0]}, "'w' is list, and arrays of NumPy's numbers are wanted"),
        ({"w": np.array(["a"])}, "'w' is ndarray of <U1, and"),
    ],
    ids=["nan", "scalar", "half", "list", "text"],
)
def test_weights_that_are_none_are_refused_by_name_and_no_client_is_blamed(weights: Any, told: str):
    state = FederationState()
    with pytest.raises(InputError, match=told):
        federate(vehicles("grid", 2), weights, SCHEDULE, edge(), state=state)
    assert not state.records


@dataclass(frozen=True)
class Weighing:
    """Averages by the same weight for all."""

    weight: float
    by_hand: bool = False

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        return average([each.weights for each in updates], [self.weight for _ in updates])


class Summing(Weighing):
    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        return updates[0].weights

    def weigh(self, update: Update) -> float:
        return self.weight


@pytest.mark.parametrize("kind", [Weighing, Summing])
def test_weights_of_a_strategy_that_are_all_zero_keep_the_model_and_others_are_refused(kind: type[Weighing]):
    reached, records, _ = follow(vehicles("grid", 3), 2, strategy=kind(0.0))
    assert all(same(each, START) for each in reached)
    assert all(record.empty and len(record.failed) == 3 for record in records)
    assert "not all 0" in records[0].failed["grid/cav0"]
    for wrong in (-1.0, np.nan):
        told = f"^strategy {kind.__name__}, round 1: clients cannot be averaged by shares of"
        with pytest.raises(InputError, match=told):
            follow(vehicles("grid", 3), 2, strategy=kind(wrong))


@pytest.mark.parametrize("samples", [2**63, -(2**63), 2**70, 2.5, np.nan, np.inf, "many", None])
def test_a_number_of_samples_that_no_message_holds_is_one_sentence(samples: Any):
    class Odd(Regression):
        def train(self, *weights: Any, **how: Any) -> LocalUpdate:
            return replace(super().train(*weights, **how), samples=samples)

    clients, state = vehicles("grid", 3), FederationState()
    clients["grid/cav1"] = Odd(clients["grid/cav1"].inputs, clients["grid/cav1"].targets)
    federate(clients, START, SCHEDULE, edge(), state=state)
    told = f"{samples!r} samples, and a whole number below 2^63 is wanted"
    assert [record.failed for record in state.records] == [{"grid/cav1": told}] * 2


@pytest.mark.parametrize("samples", [-1, 10**6 + 1, 2**63 - 1])
def test_numbers_of_samples_beyond_the_limits_are_told_with_them(samples: int):
    class Odd(Regression):
        def train(self, *weights: Any, **how: Any) -> LocalUpdate:
            return replace(super().train(*weights, **how), samples=samples, loss=0.5)

    clients, state = vehicles("grid", 3), FederationState()
    clients["grid/cav1"] = Odd(clients["grid/cav1"].inputs, clients["grid/cav1"].targets)
    federate(clients, START, SCHEDULE, edge(), state=state)
    told = f"{samples} samples and a loss of 0.5: 1 to 1000000 samples are taken, and a loss from -1e+12 to 1e+12"
    assert state.records[0].failed == {"grid/cav1": told}

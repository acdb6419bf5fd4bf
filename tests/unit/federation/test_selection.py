"""Who takes part in a round: rules, probabilities against an optimiser, the unbiased mean, what it costs."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any, cast

import cvxpy
import numpy as np
import pytest
from pydantic import ValidationError
from regression import START, ledger, vehicles

from flcav.config import InputError
from flcav.federation.checks import check_federation
from flcav.federation.links.metered import Account
from flcav.federation.links.processes import train_remotely
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection, optimal_probabilities
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.strategies.fedavg import average_inversely
from flcav.federation.strategies.robust import Krum
from flcav.federation.trainable import LocalUpdate, count_samples
from flcav.statistics.streams import derive_seed

SCHEDULE = Schedule(rounds=6, steps=5, learning_rate=0.05, final_learning_rate=0.02, seed=3)
NAMES = [f"grid/cav{i}" for i in range(6)]
SECONDS = dict(zip(NAMES, (0.5, 9.0, 3.0, 2.9, 3.1, 1.0), strict=True))
RULES: dict[str, Any] = {
    "uniform": {"rule": "uniform", "clients": 2},
    "poisson": {"rule": "poisson", "probability": 0.4},
    "round-robin": {"rule": "round-robin", "clients": 4},
    "importance": {"rule": "importance", "clients": 2},
    "deadline": {"rule": "deadline", "deadline_s": 3.0, "seconds": SECONDS},
}


def run(selection: Selection, **how: Any) -> tuple[np.ndarray, FederationState, Account]:
    account, state = Account(ledger(), "edge", "regression", "wireless"), how.pop("state", FederationState())
    start = how.pop("start", START)
    rules = Rules(selection=selection)
    result = federate(vehicles("grid", 6), start, SCHEDULE, account, rules=rules, state=state, **how)
    return result.weights["w"], state, account


@pytest.mark.parametrize("rule", RULES)
def test_a_selection_is_deterministic_resumes_and_books_only_who_takes_part(rule: str):
    selection, kept = Selection(**RULES[rule]), []
    once, state, account = run(selection, on_round=lambda round_, weights, loss: kept.append(dict(weights)))
    np.testing.assert_array_equal(run(selection)[0], once)
    np.testing.assert_array_equal(run(selection, start=kept[2], done=3)[0], once)
    assert not np.array_equal(once, run(Selection())[0])
    took_part = [(record.round, client) for record in state.records for client in record.clients]
    update = max(entry.bytes for entry in account.ledger.entries if entry.direction == "up")
    sent = [(e.round, e.client) for e in account.ledger.entries if e.direction == "up" and e.bytes == update]
    assert sorted(sent) == sorted(took_part)
    assert 0 < len(took_part) < 6 * SCHEDULE.rounds


def test_a_round_of_nobody_has_no_loss():
    losses: list[float | None] = []
    selection = Selection(rule="poisson", probability=0.05)
    _, state, _ = run(selection, on_round=lambda round_, weights, loss: losses.append(loss))
    assert losses == [record.loss for record in state.records]
    alone = [not record.clients for record in state.records]
    assert [loss is None for loss in losses] == alone
    assert set(alone) == {True, False}


def test_rules_choose_as_they_say():
    rounds = range(1, 4)
    assert [Selection(**RULES["round-robin"]).choose(NAMES, round_, 1) for round_ in rounds] == [
        NAMES[:4],
        [NAMES[i] for i in (0, 1, 4, 5)],
        NAMES[2:],
    ]
    assert Selection(**RULES["deadline"]).choose(NAMES, 1, 1) == [NAMES[i] for i in (0, 2, 3, 5)]
    uniform, poisson = Selection(**RULES["uniform"]), Selection(**RULES["poisson"])
    drawn = [uniform.choose(NAMES, 1, seed) for seed in range(3000)]
    assert {len(each) for each in drawn} == {2}
    share = [sum(name in each for each in drawn) / 3000 for name in NAMES]
    np.testing.assert_allclose(share, 2 / 6, atol=0.03)
    drawn = [poisson.choose(NAMES, 1, seed) for seed in range(3000)]
    np.testing.assert_allclose([sum(name in each for each in drawn) / 3000 for name in NAMES], 0.4, atol=0.03)
    both = sum({NAMES[0], NAMES[1]} <= set(each) for each in drawn) / 3000
    assert both == pytest.approx(0.16, abs=0.02)  # each by itself


@pytest.mark.parametrize("seed", range(8))
def test_importance_has_the_least_variance_of_all_probabilities(seed: int):
    rng = np.random.default_rng(seed)
    norms, expected = rng.lognormal(sigma=1.5, size=9), int(rng.integers(1, 9))
    p = cvxpy.Variable(9)
    variance: Any = cvxpy.sum(cvxpy.multiply(norms**2, cvxpy.inv_pos(p)))
    within: Any = [p <= 1, cvxpy.sum(p) <= expected]
    cvxpy.Problem(cvxpy.Minimize(variance), within).solve(solver="CLARABEL")
    assert p.value is not None
    found = optimal_probabilities(norms, expected)
    assert np.sum(found) == pytest.approx(expected)
    np.testing.assert_allclose(found, p.value, atol=2e-3)
    assert np.sum(norms**2 / found) <= variance.value * (1 + 1e-6)


def test_probabilities_of_norms_that_are_0():
    np.testing.assert_array_equal(optimal_probabilities(np.zeros(4), 1), np.full(4, 0.25))
    np.testing.assert_array_equal(optimal_probabilities(np.array([0.0, 2.0, 0.0]), 2), [0, 1, 0])
    np.testing.assert_array_equal(optimal_probabilities(np.array([1.0, 2.0]), 5), [1, 1])


def test_the_mean_under_importance_selection_is_unbiased():
    rng = np.random.default_rng(2)
    start = {"w": rng.normal(size=4), "count": np.array(3)}
    updates = {
        f"cav{i}": LocalUpdate({"w": rng.normal(size=4) * 2**i, "count": np.array(i)}, i + 1, 0.0) for i in range(5)
    }
    shares = {name: update.samples / 15 for name, update in updates.items()}
    lengths = {name: np.linalg.norm(update.weights["w"] - start["w"]) for name, update in updates.items()}
    norms = {name: float(shares[name] * length) for name, length in lengths.items()}
    selection = Selection(rule="importance", clients=2)
    estimates = []
    for seed in range(4000):
        drawn = selection.draw(norms, seed)
        mine = {name: updates[name] for name in drawn}
        weights = {name: shares[name] / p for name, p in drawn.items()}
        estimates.append(average_inversely(start, mine, weights)["w"] if drawn else start["w"])
    mean = np.average([update.weights["w"] for update in updates.values()], axis=0, weights=[*shares.values()])
    error = np.std(estimates, axis=0) / np.sqrt(len(estimates))
    assert (np.abs(np.mean(estimates, axis=0) - mean) < 4 * error).all()


@pytest.mark.parametrize(("lie", "liars"), [(1.7e308, 1), (1.7e308, 2), (1e30, 3), (np.inf, 3), (1e9, 4)])
def test_norms_of_a_minority_that_lies_neither_fill_nor_empty_the_draw(lie: float, liars: int):
    selection, honest = Selection(rule="importance", clients=3), {f"cav{i}": 1.0 + i for i in range(8)}
    told = honest | {f"liar{i}": lie for i in range(liars)}
    draws = [selection.draw(told, seed) for seed in range(300)]
    assert np.mean([len(each) for each in draws]) == pytest.approx(3, abs=0.3)
    assert np.mean([sum(name in honest for name in each) for each in draws]) > 0.9
    alike = {name: 1.0 + i / 4 for i, name in enumerate(honest)}  # no norm is that long: as they are told
    expected = optimal_probabilities(np.array([*alike.values()]), 3)
    found = {name: p for seed in range(60) for name, p in selection.draw(alike, seed).items()}
    assert [found[name] for name in alike] == [*expected]


def chances(selection: Selection, names: Sequence[str]) -> dict[tuple[str, ...], float]:
    """Return the probability of every set of clients that a selection may choose."""
    subsets = [set_ for size in range(len(names) + 1) for set_ in combinations(names, size)]
    if selection.rule == "uniform":
        drawn = [each for each in subsets if len(each) == selection.clients]
        return dict.fromkeys(drawn, 1 / len(drawn))
    p = selection.probability or 0.0
    return {each: p ** len(each) * (1 - p) ** (len(names) - len(each)) for each in subsets}


@pytest.mark.parametrize("rule", ["uniform", "poisson"])
def test_unbiased_rounds_are_those_of_all_clients_in_the_mean_of_all_draws(rule: str, monkeypatch: Any):
    clients: Any = vehicles("grid", 4)  # of 4, 5, 6 and 7 samples
    one = Schedule(rounds=1, steps=5, learning_rate=0.05, final_learning_rate=0.05, seed=8)

    def end(selection: Selection) -> np.ndarray:
        account = Account(ledger(), "edge", "r", "wireless")
        return federate(clients, START, one, account, rules=Rules(selection=selection)).weights["w"].astype(float)

    everybody, expected, biased = end(Selection()), np.zeros(3), np.zeros(3)
    plain = Selection(**RULES[rule])
    for drawn, chance in chances(plain, [*clients]).items():
        monkeypatch.setattr(Selection, "choose", lambda own, names, round_, seed, earlier=0, drawn=drawn: [*drawn])
        expected += chance * end(Selection(**RULES[rule], unbiased=True))
        biased += chance * end(plain)
    np.testing.assert_allclose(expected, everybody, atol=1e-6)
    assert np.abs(biased - everybody).max() > 1e-3  # a ratio of sums, and of poisson rounds without anybody


def test_numbers_of_samples_are_messages_with_a_price():
    _, state, account = run(Selection(**RULES["uniform"], unbiased=True))
    up = [entry for entry in account.ledger.entries if entry.direction == "up" and entry.round == 1]
    counts, updates = up[:6], up[6:]
    assert [entry.client for entry in counts] == NAMES
    assert [entry.client for entry in updates] == [*state.records[0].clients]
    assert 0 < max(entry.bytes for entry in counts) < min(entry.bytes for entry in updates)
    remote = train_remotely(vehicles("grid", 2), cast(Any, None))  # counted here, wherever they train
    assert [count_samples(remote[f"grid/cav{i}"], 5) for i in (0, 1)] == [4, 5]


def test_norms_are_messages_with_a_price():
    _, state, account = run(Selection(**RULES["importance"]))
    some = next(record for record in state.records if record.clients)
    up = [entry for entry in account.ledger.entries if entry.direction == "up" and entry.round == some.round]
    norms, updates = up[:6], up[6:]
    assert [entry.client for entry in norms] == NAMES
    assert [entry.client for entry in updates] == [*some.clients]
    assert 0 < max(entry.bytes for entry in norms) < min(entry.bytes for entry in updates)


def test_what_makes_no_sense_is_one_sentence():
    clients: Any = vehicles("grid", 6)
    for strategy, selection, said in (
        (FEDAVG, {"rule": "uniform", "clients": 7}, r"selection: 7 clients are wanted in a round, and there are 6"),
        (FEDAVG, {"rule": "deadline", "deadline_s": 1, "seconds": dict.fromkeys(NAMES, 2.0)}, r"no client is .* 1 s"),
        (
            FEDAVG,
            {"rule": "deadline", "deadline_s": 1, "seconds": {"cav0": 0.5, **dict.fromkeys(NAMES[1:5], 0.5)}},
            r"selection: 'seconds' has no time of a round for 2 of 6 clients, such as grid/cav0",
        ),
        (FEDAVG, {"rule": "deadline", "deadline_s": 1}, r"selection: a deadline needs 'seconds', the predicted time"),
        (
            Krum(),
            RULES["uniform"],
            r"krum: 5 clients or more are wanted for byzantine = 1 and kept = 1, and there are 2",
        ),
        (Krum(), RULES["poisson"], r"Krum needs a known number of clients"),
        (Scaffold(), RULES["importance"], r"Scaffold looks at each update, and importance selection gives"),
        (Scaffold(), {**RULES["uniform"], "unbiased": True}, r"Scaffold looks at each update, and unbiased selection"),
    ):
        with pytest.raises(InputError, match=said):
            check_federation(clients, strategy, Rules(selection=Selection(**selection)))
    unbiased = Selection(**RULES["poisson"], unbiased=True)
    with pytest.raises(InputError, match=r"selection: privacy has clients count the same, and 'unbiased' weighs"):
        check_federation(clients, FEDAVG, Rules(selection=unbiased, privacy=Privacy(clip=1.0, noise=1.0)))
    with pytest.raises(InputError, match=r"selection: unbiased weights need clients .* grid/cav0 \(object\) has no"):
        check_federation({name: cast(Any, object()) for name in NAMES}, FEDAVG, Rules(selection=unbiased))
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"rule": "uniform"}, "the rule uniform needs 'clients'"),
        ({"clients": 2}, "the rule all takes no 'clients'"),
        ({"unbiased": True}, "the rule all takes no 'unbiased'"),
        ({**RULES["importance"], "unbiased": True}, "the rule importance takes no 'unbiased'"),
        ({"rule": "poisson", "probability": 0}, "greater than 0"),
        ({"rule": "deadline", "deadline_s": 1, "seconds": {"cav0": -1.0}}, "greater than or equal to 0"),
        ({"rule": "uniform", "clients": 1, "seconds": SECONDS}, "the rule uniform takes no 'seconds'"),
    )
    for fields, said in wrong:
        with pytest.raises(ValidationError, match=said):
            Selection(**fields)


def test_clients_join_the_rounds_of_a_plan() -> None:
    planned = Selection(rule="planned", joins={"a": (1, 3), "b": (2,)})
    assert [planned.choose(["a", "b", "c"], number, 0) for number in (1, 2, 3, 4)] == [
        ["a", "c"],
        ["b", "c"],
        ["a", "c"],
        ["c"],
    ]
    assert planned.choose(["a", "b"], 4, 0) == ["a", "b"]  # else nobody would train
    with pytest.raises(ValueError, match="the rule all takes no 'joins'"):
        Selection(joins={"a": (1,)})


def test_a_round_by_importance_is_the_weighted_sum_of_those_drawn():
    clients: Any = vehicles("grid", 6)
    one = Schedule(rounds=1, steps=5, learning_rate=0.05, final_learning_rate=0.05, seed=8)
    rules = Rules(selection=Selection(rule="importance", clients=3))
    state, work = FederationState(), one.work(1)
    found = federate(clients, START, one, Account(ledger(), "edge", "r", "wireless"), rules=rules, state=state)
    how = {"steps": work.steps, "learning_rate": work.learning_rate}
    trained = {n: client.train(START, seed=derive_seed(work.seed, n), **how) for n, client in clients.items()}
    share = {name: update.samples / sum(each.samples for each in trained.values()) for name, update in trained.items()}
    norms = [share[name] * np.linalg.norm(update.weights["w"].astype(float)) for name, update in trained.items()]
    p = dict(zip(trained, optimal_probabilities(np.array(norms), 3), strict=True))
    drawn = state.records[0].clients
    assert 0 < len(drawn) < 6
    expected = np.sum([share[name] / p[name] * trained[name].weights["w"] for name in drawn], axis=0)
    np.testing.assert_allclose(found.weights["w"], expected, rtol=1e-5)

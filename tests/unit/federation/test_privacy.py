"""Differential privacy: norms after clipping, the noise that is added, and epsilon against another accountant."""

import math
from typing import Any, cast

import numpy as np
import pytest
from dp_accounting import (
    GaussianDpEvent,
    NeighboringRelation,
    PoissonSampledDpEvent,
    SampledWithoutReplacementDpEvent,
    pld,
    rdp,
)
from pydantic import ValidationError
from regression import ledger
from scipy.optimize import brentq
from scipy.stats import norm

from flcav.config import InputError
from flcav.federation.checks import check_federation
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import (
    Privacy,
    account_epsilon,
    affordable_rounds,
    average_privately,
    change_norm,
    clip_change,
    compose_epsilon,
    find_noise,
    most_participations,
)
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.strategies.fedopt import FedAdam
from flcav.federation.strategies.robust import Median
from flcav.federation.trainable import LocalUpdate, Weights

START = {
    "w": np.zeros((300, 20), np.float32),
    "b": np.ones(50, np.float32),
    "norm.running_var": np.full(4, 2.0, np.float32),
    "n": np.array(5),
}
SCHEDULE = Schedule(rounds=4, steps=1, learning_rate=0.1, final_learning_rate=0.1, seed=3)
NAMES = [f"cav{i}" for i in range(10)]
UNIFORM, POISSON = Selection(rule="uniform", clients=4), Selection(rule="poisson", probability=0.3)
EVERY = Selection()


class Stride:
    """Always goes the same way, by a norm of its own."""

    def __init__(self, length: float, samples: int = 3) -> None:
        self.length, self.samples = length, samples

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        size = math.sqrt(START["w"].size + START["b"].size)
        moved = {name: (weights[name] + self.length / size).astype(np.float32) for name in ("w", "b")}
        return LocalUpdate(
            {**moved, "norm.running_var": weights["norm.running_var"] + 1, "n": weights["n"]}, self.samples, 0.7
        )


def clients(length: float = 5.0) -> dict[str, Any]:
    return {name: Stride(length, i + 1) for i, name in enumerate(NAMES)}


def run(privacy: Privacy, selection: Selection = EVERY, **how: Any) -> tuple[Weights, FederationState]:
    state, account = how.pop("state", FederationState()), Account(ledger(10.0), "edge", "stride", "wireless")
    rules = Rules(privacy=privacy, selection=selection)
    update = federate(how.pop("clients", clients()), START, SCHEDULE, account, rules=rules, state=state, **how)
    return update.weights, state


def test_clipping_bounds_the_norm_of_all_arrays_together():
    rng = np.random.default_rng(0)
    change = {"a": rng.normal(size=(30, 4)), "b": rng.normal(size=7)}
    length = math.sqrt(sum(float((array**2).sum()) for array in change.values()))
    assert change_norm(change) == pytest.approx(length)
    clipped = clip_change(change, 0.5)
    assert change_norm(clipped) == pytest.approx(0.5)
    np.testing.assert_allclose(clipped["b"], change["b"] * 0.5 / length)
    np.testing.assert_array_equal(clip_change(change, 2 * length)["a"], change["a"])
    np.testing.assert_array_equal(clip_change({"a": np.array([3.0, 4.0])}, 5.0)["a"], [3.0, 4.0])
    assert not clip_change({"a": np.zeros(3)}, 1.0)["a"].any()


@pytest.mark.parametrize("clip", [1e3, 1.0, 1e-3, 1e-6])
@pytest.mark.parametrize(("kind", "longest"), [(np.float16, 6e4), (np.float32, 3.3e38), (np.float64, 1e120)])
def test_no_clipped_change_is_longer_than_the_bound_by_rounding(kind: Any, longest: float, clip: float):
    rng = np.random.default_rng(0)
    for size in (1, 10, 10**4, 10**5):
        for length in np.geomspace(1e-3, longest, 7):
            for values in (np.full(size, length), length * rng.uniform(-1, 1, size)):
                change = {"w": values.astype(kind), "b": np.array([-length]).astype(kind)}
                clipped = clip_change(change, clip)
                assert change_norm(clipped) <= clip
                assert change_norm(clipped) == pytest.approx(min(clip, change_norm(change)))


@pytest.mark.parametrize("seeded", [False, True])
@pytest.mark.parametrize("where", ["central", "local"])
def test_the_mean_has_the_noise_that_is_accounted_for(where: Any, seeded: bool):
    clip, noise, number = 0.2, 3.0, len(NAMES)
    found, _ = run(Privacy(where=where, clip=clip, noise=noise, seeded=seeded))
    rounds, size = SCHEDULE.rounds, math.sqrt(START["w"].size + START["b"].size)
    deviation = noise * clip * (1 / number if where == "central" else 1 / math.sqrt(number)) * math.sqrt(rounds)
    change = found["w"] - rounds * clip / size
    assert np.std(change) == pytest.approx(deviation, rel=0.05)
    assert np.mean(change) == pytest.approx(0, abs=5 * deviation / math.sqrt(change.size))
    np.testing.assert_array_equal(found["norm.running_var"], START["norm.running_var"])  # no noise covers it
    assert found["n"] == 5


def test_one_client_moves_the_sum_by_the_norm_at_most():
    privacy, names = Privacy(clip=0.3, noise=1.0, seeded=True), ["w", "b"]  # the same noise on each sum
    each = [Stride(length).train(START, steps=1, learning_rate=0.1, seed=0) for length in (0.1, 4.0, 900.0)]
    sums = [average_privately(START, updates, names, privacy, 1.0, 7) for updates in (each, each[:2], [])]
    moved = {name: sums[0][name] - sums[1][name] for name in names}
    assert change_norm(moved) == pytest.approx(0.3, rel=1e-3)
    assert change_norm({name: sums[1][name] - sums[2][name] for name in names}) == pytest.approx(0.4, rel=1e-3)


def test_seeded_noise_is_its_own_and_resumes():
    privacy, kept = Privacy(clip=1.0, noise=0.5, seeded=True), []
    for selection in (EVERY, POISSON):
        kept.clear()
        whole, state = run(privacy, selection, on_round=lambda number, weights, loss: kept.append(weights))
        np.random.seed(1)  # noqa: NPY002 - what the noise must not be drawn from
        assert np.array_equal(run(privacy, selection)[0]["w"], whole["w"])
        account = Account(ledger(10.0), "edge", "stride", "wireless")
        rules = Rules(privacy=privacy, selection=selection)
        resumed = federate(clients(), kept[1], SCHEDULE, account, rules=rules, done=2)
        assert np.array_equal(resumed.weights["w"], whole["w"])
        assert [record.epsilon for record in state.records] == [
            account_epsilon(privacy, selection, NAMES, number) for number in (1, 2, 3, 4)
        ]
    assert not np.array_equal(kept[0]["w"], kept[1]["w"])


def gaussian_epsilon(noise: float, rounds: int, delta: float) -> float:
    """Return epsilon of composed Gaussian mechanisms, exactly (Balle and Wang, ICML 2018, theorem 8)."""
    mu = math.sqrt(rounds) / noise

    def excess(e: float) -> Any:
        return norm.cdf(mu / 2 - e / mu) - math.exp(e) * norm.cdf(-mu / 2 - e / mu) - delta

    return cast(float, brentq(excess, 0, 200))


@pytest.mark.parametrize("rounds", [1, 7, 30])
def test_epsilon_is_just_above_what_other_accountants_say(rounds: int):
    privacy = Privacy(clip=1.0, noise=2.5, delta=1e-5)
    exact = gaussian_epsilon(2.5, rounds, 1e-5)
    deadline = Selection(rule="deadline", deadline_s=1.0)
    for selection in (EVERY, deadline):
        assert exact <= account_epsilon(privacy, selection, NAMES, rounds) < 1.2 * exact
    local, halved = Privacy(clip=1.0, noise=2.5, where="local"), gaussian_epsilon(1.25, rounds, 1e-5)
    assert halved <= account_epsilon(local, POISSON, NAMES, rounds) < 1.2 * halved  # any two data sets, not amplified
    accountant = pld.PLDAccountant(neighboring_relation=NeighboringRelation.ADD_OR_REMOVE_ONE)
    accountant.compose(PoissonSampledDpEvent(0.3, GaussianDpEvent(2.5)), rounds)
    found = account_epsilon(privacy, POISSON, NAMES, rounds)
    assert accountant.get_epsilon(1e-5) * 0.999 <= found < 1.35 * accountant.get_epsilon(1e-5)
    assert found < exact


def test_epsilon_of_a_fixed_number_is_between_one_client_and_all():
    privacy = Privacy(clip=1.0, noise=2.5)
    one, four, ten = (account_epsilon(privacy, Selection(rule="uniform", clients=n), NAMES, 5) for n in (1, 4, 10))
    assert one < four < ten
    assert ten == pytest.approx(gaussian_epsilon(1.25, 5, 1e-5), rel=0.2)  # replaced: twice the norm


def test_a_client_is_accounted_for_the_rounds_that_it_takes_part_in():
    turns = Selection(rule="round-robin", clients=4)
    counts = np.zeros(10, int)
    for number in range(1, 14):
        counts[[int(name[3:]) for name in turns.choose(NAMES, number, 0)]] += 1
        assert most_participations(turns, 10, number) == counts.max()
    privacy = Privacy(clip=1.0, noise=2.0)
    assert account_epsilon(privacy, turns, NAMES, 5) == account_epsilon(privacy, EVERY, NAMES, 2)


class Counting(Stride):
    """Counts its trainings."""

    taken = 0

    def train(self, weights: Weights, **how: Any) -> LocalUpdate:
        self.taken += 1
        return super().train(weights, **how)


@pytest.mark.parametrize("case", range(20))
def test_the_account_is_of_the_client_that_took_part_most_in_all_stages(case: int):
    """Stage II, and cloud rounds of several edge rounds each after it; counted are the trainings themselves."""
    rng = np.random.default_rng(case)
    number, edge, k, cloud = (int(rng.integers(low, high)) for low, high in ((2, 8), (1, 6), (1, 4), (1, 4)))
    names, total, some = NAMES[:number], edge + k * cloud, int(rng.integers(1, number + 1))
    seconds = dict(zip(names, rng.uniform(0, 1, number).tolist(), strict=True)) | {names[0]: 0.1}
    selection = (
        Selection(rule="round-robin", clients=some),
        Selection(),
        Selection(rule="deadline", deadline_s=0.5, seconds=seconds),
        Selection(rule="uniform", clients=some),
        Selection(rule="poisson", probability=0.3),
    )[case % 5 if case < 10 else 0]
    privacy = Privacy(clip=1.0, noise=1.5, where="local" if case % 2 else "central", seeded=True)
    rules, vehicles = Rules(privacy=privacy, selection=selection), {name: Counting(1.0) for name in names}
    account, state = Account(ledger(99.0), "edge", "stride", "wireless"), FederationState()
    given: Any = (START, Schedule(edge, 1, 0.1, 0.1, case), account)
    found = federate({**vehicles}, *given, rules=rules, state=state)
    records, state = state.records, FederationState()
    server = EdgeServer({**vehicles}, k, account, found.weights, rules=rules, state=state, earlier=edge)
    further: Any = ({"ring": server}, found.weights, Schedule(cloud, 1, 0.1, 0.1, case), account)
    federate(*further, rules=rules.of_servers())
    records += state.records
    assert len(records) == total
    most = max(each.taken for each in vehicles.values())
    if privacy.amplified(selection):
        relation = NeighboringRelation.REPLACE_ONE if selection.clients else NeighboringRelation.ADD_OR_REMOVE_ONE
        sampled = (
            SampledWithoutReplacementDpEvent(number, some, GaussianDpEvent(0.75))
            if selection.clients
            else PoissonSampledDpEvent(0.3, GaussianDpEvent(1.5))
        )
        accountant = rdp.RdpAccountant(neighboring_relation=relation).compose(sampled, total)
        assert records[-1].epsilon == pytest.approx(accountant.get_epsilon(privacy.delta))
    elif selection.rule in ("uniform", "poisson"):  # local noise: by chance it may be in every round
        assert records[-1].epsilon == account_epsilon(privacy, EVERY, names, total)
    else:
        assert records[-1].epsilon == account_epsilon(privacy, EVERY, names, most)


@pytest.mark.parametrize("selection", [EVERY, UNIFORM, POISSON, Selection(rule="round-robin", clients=4)])
def test_several_trainings_with_one_client_s_data_compose(selection: Selection):
    privacy = Privacy(clip=1.0, noise=1.5)
    one = account_epsilon(privacy, selection, NAMES, 5)
    four = compose_epsilon(privacy, selection, [(10, 5)] * 4)
    assert one < four < 4 * one
    if selection.rule == "round-robin":  # each begins with the same client, whose turn comes twice in five rounds
        assert four == account_epsilon(privacy, EVERY, NAMES, 8)
        assert compose_epsilon(privacy, selection, [(10, 20)]) == four
    else:
        assert four == pytest.approx(account_epsilon(privacy, selection, NAMES, 20))
    assert compose_epsilon(privacy, selection, [(10, 5), (7, 0)]) == one


def test_rounds_stop_at_the_budget():
    loose = Privacy(clip=1.0, noise=2.0)
    third = account_epsilon(loose, EVERY, NAMES, 3)
    privacy = loose.model_copy(update={"epsilon": third + 1e-9})
    _, state = run(privacy)
    assert [record.round for record in state.records] == [1, 2, 3]
    assert state.records[-1].epsilon == third
    assert affordable_rounds(privacy, EVERY, NAMES, 99, 1) == 2
    _, state = run(privacy, earlier=2)
    assert [record.epsilon for record in state.records] == [third]
    with pytest.raises(
        InputError, match=r"privacy: another round comes to epsilon = .* at delta = 1e-05, above .*budget"
    ):
        run(privacy, earlier=3)
    with pytest.raises(InputError, match=r"privacy: a first round comes to epsilon"):
        run(loose.model_copy(update={"epsilon": 1e-3}))


def test_a_failing_client_does_not_lose_the_round_nor_its_privacy():
    class Failing(Stride):
        def train(self, weights: Weights, **how: Any) -> LocalUpdate:
            raise OSError("no power")

    others = clients() | {"cav3": Failing(1.0)}
    account, state = Account(ledger(10.0), "edge", "stride", "wireless"), FederationState()
    rules = Rules(privacy=Privacy(clip=1.0, noise=1e-6), least_clients=5)
    found = federate(others, START, SCHEDULE, account, rules=rules, state=state).weights
    assert [*state.records[0].failed] == ["cav3"]
    size = math.sqrt(START["w"].size + START["b"].size)
    np.testing.assert_allclose(found["w"], SCHEDULE.rounds * 0.9 / size, rtol=1e-3)  # nine of ten, whoever came


def test_strategies_see_the_noisy_mean():
    privacy = Privacy(clip=1.0, noise=1.0)
    adaptive, plain = (run(privacy, strategy=strategy)[0]["w"] for strategy in (FedAdam(), FEDAVG))
    assert not np.array_equal(adaptive, plain)
    assert np.isfinite(adaptive).all()


def test_what_makes_no_sense_is_one_sentence():
    central, local = Privacy(clip=1.0, noise=1.0), Privacy(clip=1.0, noise=1.0, where="local")
    importance, many = Selection(rule="importance", clients=2), clients()
    poisson, uniform = Selection(rule="poisson", probability=0.5), Selection(rule="uniform", clients=2)
    for strategy, rules, said in (
        (Median(), Rules(privacy=central), r"Median looks at each update, and central noise covers their sum alone"),
        (Scaffold(), Rules(privacy=local), r"Scaffold sends further arrays beside the weights, which the noise"),
        (FEDAVG, Rules(privacy=local, selection=importance), r"privacy: importance selection reads norms"),
        (FEDAVG, Rules(privacy=central, selection=poisson, least_clients=2), r"privacy: epsilon of poisson selection"),
        (FEDAVG, Rules(privacy=central, selection=uniform, least_clients=2), r"privacy: epsilon of uniform selection"),
    ):
        with pytest.raises(InputError, match=said):
            check_federation(many, strategy, rules)
    check_federation(many, FEDAVG, Rules(privacy=local, selection=poisson, least_clients=2))
    check_federation(many, FEDAVG, Rules(privacy=central, selection=poisson, least_clients="all"))
    check_federation(many, FEDAVG, Rules(privacy=central, least_clients=2))
    check_federation(many, Median(), Rules(privacy=local))
    for wrong in ({"epsilon": 0}, {"noise": 0}, {"clip": -1}, {"delta": 1}):
        with pytest.raises(ValidationError, match="Input should be"):
            Privacy(**{"clip": 1.0, "noise": 1.0, **wrong})


@pytest.mark.slow
@pytest.mark.parametrize("where", ["central", "local"])
@pytest.mark.parametrize("selection", [EVERY, POISSON, UNIFORM, Selection(rule="round-robin", clients=4)])
@pytest.mark.parametrize(("epsilon", "rounds"), [(0.5, 3), (8.0, 12), (60.0, 1)])
def test_a_budget_alone_gives_the_least_noise_for_the_rounds(
    where: Any, selection: Selection, epsilon: float, rounds: int
):
    found = find_noise(Privacy(where=where, epsilon=epsilon), selection, len(NAMES), rounds)
    assert found.noise is not None
    assert account_epsilon(found, selection, NAMES, rounds) <= epsilon
    assert affordable_rounds(found, selection, NAMES, rounds, 0) == rounds
    less = found.model_copy(update={"noise": found.noise * 0.99})
    assert account_epsilon(less, selection, NAMES, rounds) > epsilon
    assert f"{found.noise:.3g}" == f"{found.noise:g}"


def test_noise_that_is_given_stays_and_a_budget_without_noise_affords_all_rounds():
    given = Privacy(noise=0.7, epsilon=3.0)
    assert find_noise(given, EVERY, 10, 99) is given
    with pytest.raises(ValidationError, match="'noise' or 'epsilon' is needed"):
        Privacy(clip=1.0)
    alone, noise = Privacy(epsilon=8.0, seeded=True), find_noise(Privacy(epsilon=8.0), EVERY, 10, SCHEDULE.rounds)
    weights, state = run(alone)
    assert len(state.records) == SCHEDULE.rounds
    assert state.records[-1].epsilon is not None
    assert 7.5 < state.records[-1].epsilon <= 8
    again, _ = run(alone.model_copy(update={"noise": noise.noise}))
    np.testing.assert_array_equal(weights["w"], again["w"])


def test_several_noises_are_composed():
    privacy = Privacy(noise=1.0)
    accountant = rdp.RdpAccountant().compose(GaussianDpEvent(1.0), 3).compose(GaussianDpEvent(2.0), 4)
    found = compose_epsilon(privacy, EVERY, [(10, 3), (10, 4)], [None, 2.0])
    assert found == pytest.approx(accountant.get_epsilon(privacy.delta))

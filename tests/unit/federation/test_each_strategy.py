"""Each strategy against its paper's formula written out, or against Flower's own implementation."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from flwr.app import Array, ArrayRecord, MetricRecord, RecordDict
from flwr.serverapp.strategy.multikrum import select_multikrum
from regression import START, TRUTH, Regression, ledger, vehicles
from scipy.stats import trim_mean

from flcav.config import InputError
from flcav.federation.checks import check_federation
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy
from flcav.federation.rules import RegionalModels, Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, STRATEGIES, of_servers, strategy_named
from flcav.federation.strategies.corrections import FedProx, Scaffold
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.fedopt import FedAdam, FedAvgM, FedYogi
from flcav.federation.strategies.robust import Krum, Median, TrimmedMean
from flcav.federation.trainable import LocalUpdate
from flcav.federation.upload import Upload
from flcav.statistics.streams import derive_seed

RATE, STEPS = 0.02, 5
SCHEDULE = Schedule(rounds=4, steps=STEPS, learning_rate=RATE, final_learning_rate=RATE, seed=3)


class Descent(Regression):
    """Gradient descent in float64, which corrects its gradients and tells their mean."""

    def train(self, weights, *, steps, learning_rate, seed, proximal=0.0, shift=None):
        rng, w, seen = np.random.default_rng(seed), weights["w"], []
        for _ in range(steps):
            i = rng.integers(len(self.inputs))
            seen.append(2 * (self.inputs[i] @ w - self.targets[i]) * self.inputs[i])
            w = w - learning_rate * (seen[-1] + proximal * (w - weights["w"]) + (shift or {}).get("w", 0.0))
        return LocalUpdate({"w": w, "count": weights["count"]}, len(self.inputs), 1.0, {"w": np.mean(seen, axis=0)})


FIRST = {"w": np.array([0.3, 0.1, -0.2]), "count": START["count"]}
CLIENTS = {name: Descent(each.inputs, each.targets) for name, each in vehicles("grid", 5).items()}


def account() -> Account:
    return Account(ledger(), "edge", "regression", "wireless")


COUNTS, SAMPLES = np.array([10, 1000, 0, 7, 400]), np.array([1, 100, 1, 3, 5])
COUNTED = {  # what strategies make of integers: their rule for floating arrays, rounded
    **dict.fromkeys(
        ("fedavg", "fedprox", "fedavgm", "fedadam", "fedyogi", "fedbuff"), SAMPLES @ COUNTS / SAMPLES.sum()
    ),
    **dict.fromkeys(("scaffold", "fedmd"), COUNTS.mean()),
    **dict.fromkeys(("median", "krum"), np.median(COUNTS)),
    "trimmed-mean": trim_mean(COUNTS, 0.2),
}
MOSTLY = {name for name, count in COUNTED.items() if count > 500}  # the first two clients have most of the samples


@pytest.mark.parametrize("name", STRATEGIES)
def test_integers_are_combined_by_one_rule_whatever_the_order_of_the_clients(name: str):
    strategy, expected = strategy_named(name), round(float(COUNTED[name]))
    for order in ([0, 1, 2, 3, 4], [4, 2, 0, 1, 3]):
        updates = [
            LocalUpdate(
                {
                    "w": np.full(2, float(i), np.float16),
                    "bn.num_batches_tracked": COUNTS[i].astype(np.int64)[()],
                    "counts": COUNTS[i].astype(np.uint16) * np.ones((2, 1), np.uint16),
                    "id": np.array([2**63 - 1, -(2**63), 2**60 + 1], np.int64),  # beyond float64
                    "mask": np.array([True, i < 2, False]),
                    "none": np.zeros((0, 3), np.float32),
                },
                int(SAMPLES[i]),
                0.0,
                extra={"w": np.zeros(2, np.float16)},
            )
            for i in order
        ]
        found = strategy.combine({**updates[0].weights, "w": np.zeros(2, np.float16)}, updates)
        assert found["bn.num_batches_tracked"] == expected
        assert (found["counts"] == expected).all()
        assert found["id"].tolist() == [2**63 - 1, -(2**63), 2**60 + 1]
        assert found["mask"].tolist() == [True, name in MOSTLY, False]
        assert {key: (array.shape, array.dtype) for key, array in found.items()} == {
            key: (np.shape(array), array.dtype) for key, array in updates[0].weights.items()
        }
        assert np.isfinite(found["w"]).all()


def run(strategy: Any, **how: Any) -> np.ndarray:
    return federate(CLIENTS, FIRST, SCHEDULE, account(), strategy=strategy, **how).weights["w"]


def plain_updates(w: np.ndarray, round_: int, proximal: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the clients' weights after local training, (clients, 3), and their numbers of samples."""
    work, how = SCHEDULE.work(round_), {"steps": STEPS, "learning_rate": RATE}
    ends = [
        client.train({**FIRST, "w": w}, seed=derive_seed(work.seed, name), proximal=proximal, **how)
        for name, client in CLIENTS.items()
    ]
    return np.array([end.weights["w"] for end in ends]), np.array([end.samples for end in ends])


def mean_change(w: np.ndarray, round_: int) -> np.ndarray:
    ends, samples = plain_updates(w, round_)
    return samples @ ends / samples.sum() - w


def test_fedprox_descends_the_proximal_objective():
    w = FIRST["w"]
    for round_ in range(1, 5):
        ends, samples = plain_updates(w, round_, proximal=3.0)
        w = samples @ ends / samples.sum()
    np.testing.assert_allclose(run(FedProx(mu=3.0)), w, rtol=1e-12)
    near, far = (np.linalg.norm(run(each) - FIRST["w"]) for each in (FedProx(mu=50.0), FedProx(mu=0.0)))
    assert near < 0.5 * far
    np.testing.assert_array_equal(run(FedProx(mu=0.0)), run(FEDAVG))


def test_fedavgm_is_momentum_of_the_mean_change():
    w, velocity = FIRST["w"], np.zeros(3)
    for round_ in range(1, 5):
        velocity = 0.7 * velocity + mean_change(w, round_)
        w = w + 0.5 * velocity
    np.testing.assert_allclose(run(FedAvgM(rate=0.5, momentum=0.7)), w, rtol=1e-12)
    np.testing.assert_allclose(run(FedAvgM(rate=1.0, momentum=0.0)), run(FEDAVG), rtol=1e-12)


@pytest.mark.parametrize("kind", [FedAdam, FedYogi])
def test_adaptive_optimisers_are_algorithm_2_of_reddi_et_al(kind: Any):
    rate, beta1, beta2, tau = 0.05, 0.8, 0.9, 0.02
    w, m, v = FIRST["w"], np.zeros(3), np.full(3, tau**2)
    for round_ in range(1, 5):
        delta = mean_change(w, round_)
        m = beta1 * m + (1 - beta1) * delta
        for j in range(3):  # lines 11 and 12, coordinate by coordinate
            if kind is FedYogi:
                v[j] = v[j] - (1 - beta2) * delta[j] ** 2 * np.sign(v[j] - delta[j] ** 2)
            else:
                v[j] = beta2 * v[j] + (1 - beta2) * delta[j] ** 2
        w = w + rate * m / (np.sqrt(v) + tau)
    np.testing.assert_allclose(run(kind(rate, beta1, beta2, tau)), w, rtol=1e-12)


def test_scaffold_is_algorithm_1_of_karimireddy_et_al_with_option_2():
    x, c, own = FIRST["w"], np.zeros(3), {name: np.zeros(3) for name in CLIENTS}
    for round_ in range(1, 5):
        work, moves, changes = SCHEDULE.work(round_), [], []
        for name, client in CLIENTS.items():
            rng, y = np.random.default_rng(derive_seed(work.seed, name)), x
            for _ in range(STEPS):
                i = rng.integers(len(client.inputs))
                gradient = 2 * (client.inputs[i] @ y - client.targets[i]) * client.inputs[i]
                y = y - RATE * (gradient - own[name] + c)
            after = own[name] - c + (x - y) / (STEPS * RATE)
            moves.append(y - x)
            changes.append(after - own[name])
            own[name] = after
        x, c = x + 1.5 * np.mean(moves, axis=0), c + np.sum(changes, axis=0) / len(CLIENTS)
    state = FederationState()
    np.testing.assert_allclose(run(Scaffold(rate=1.5), state=state), x, rtol=1e-9)
    np.testing.assert_allclose(state.server["w"], c, rtol=1e-9)
    np.testing.assert_allclose(state.clients["grid/cav3"]["own"]["w"], own["grid/cav3"], rtol=1e-9)


def test_scaffold_sends_its_variates_beside_the_weights():
    plain, controlled = account(), account()
    federate(CLIENTS, FIRST, SCHEDULE, plain)
    federate(CLIENTS, FIRST, SCHEDULE, controlled, strategy=Scaffold())
    sizes = [[entry.bytes for entry in each.ledger.entries if entry.direction == "up"] for each in (plain, controlled)]
    assert all(more - less > 3 * 8 for less, more in zip(*sizes, strict=True))


def random_updates(clients: int, seed: int = 0) -> list[LocalUpdate]:
    rng = np.random.default_rng(seed)
    return [
        LocalUpdate(
            {"a": rng.normal(size=(4, 2)).astype(np.float32), "b": rng.normal(size=3), "n": np.array(i)},
            int(rng.integers(1, 9)),
            0.5,
        )
        for i in range(clients)
    ]


def test_median_and_trimmed_mean_go_coordinate_by_coordinate():
    updates = random_updates(11)
    for name in ("a", "b"):
        stacked = np.stack([update.weights[name] for update in updates])
        middle = np.sort(stacked, axis=0)[5]
        np.testing.assert_array_equal(Median().combine(updates[0].weights, updates)[name], middle)
        trimmed = TrimmedMean(0.3).combine(updates[0].weights, updates)[name]
        np.testing.assert_allclose(trimmed, trim_mean(stacked.astype(float), 0.3, axis=0), rtol=1e-6)
    for strategy in (Median(), TrimmedMean(0.3)):
        assert strategy.combine(updates[3].weights, updates)["n"] == 5  # no single client's either


@pytest.mark.parametrize(("fraction", "clients", "out"), [(0.29, 100, 29), (0.07, 100, 7), (0.3, 10, 3), (0.3, 11, 3)])
def test_a_fraction_of_the_clients_is_the_number_that_it_says(fraction: float, clients: int, out: int):
    updates = [LocalUpdate({"w": np.array([float(i**3)])}, 1, 0.0) for i in range(clients)]
    kept = [float(i**3) for i in range(out, clients - out)]
    assert TrimmedMean(fraction).combine(updates[0].weights, updates)["w"] == pytest.approx(np.mean(kept))
    TrimmedMean(0.29).check_clients(100)


def normalised_updates(honest: int, rng: np.random.Generator, common: float = 1.0) -> list[LocalUpdate]:
    drift = common * rng.normal(size=400) * 0.01
    return [
        LocalUpdate(
            {
                "w": drift + rng.normal(size=400) * 0.01,
                "norm.running_mean": 0.1 * rng.normal(size=8),
                "norm.running_var": 1.0 + 0.1 * rng.random(8),
                "norm.num_batches_tracked": np.array(7),
            },
            9,
            0.0,
        )
        for _ in range(honest)
    ]


@pytest.mark.parametrize("kept", [1, 4])
@pytest.mark.parametrize("common", [0.0, 0.5, 2.0])
def test_krum_adopts_no_liar_s_statistics_and_no_claim_of_samples(kept: int, common: float):
    """Liars in what is learned send the start, or the mean of three trainings, which are near to all others."""
    poison = {
        "norm.running_mean": np.full(8, 1e30),
        "norm.running_var": np.full(8, -1e30),
        "norm.num_batches_tracked": np.array(2**60),
    }
    for seed in range(10):
        rng = np.random.default_rng(seed)
        honest, start = normalised_updates(7, rng, common), {"w": np.zeros(400)}
        band = np.mean([each.weights["w"] for each in normalised_updates(3, rng, common)], axis=0)
        for learned in (start["w"], band):
            liars = [LocalUpdate({"w": learned, **poison}, 2**62, 0.0)] * 3
            updates = [*liars, *honest]
            begun = {**start, **honest[0].weights}
            found = Krum(byzantine=3, kept=kept).combine(begun, updates)
            assert [*found] == [*begun]
            for name in ("norm.running_mean", "norm.running_var"):
                own = [each.weights[name] for each in honest]
                assert (np.min(own, axis=0) <= found[name]).all()
                assert (found[name] <= np.max(own, axis=0)).all()
            assert found["norm.num_batches_tracked"] == 7


def test_multi_krum_weighs_those_that_it_keeps_alike():
    updates = normalised_updates(8, np.random.default_rng(3))
    few, many = (replace(updates[2], samples=samples) for samples in (1, 10**15))
    found = [
        Krum(byzantine=2, kept=5).combine(each.weights, [*updates[:2], each, *updates[3:]]) for each in (few, many)
    ]
    np.testing.assert_array_equal(found[0]["w"], found[1]["w"])


@pytest.mark.parametrize("kept", [1, 3])
def test_krum_chooses_whom_flower_chooses(kept: int):
    for seed in range(20):
        updates = random_updates(9, seed)
        contents = [
            RecordDict(
                {
                    "arrays": ArrayRecord({name: Array(update.weights[name].astype(float)) for name in ("a", "b")}),
                    "metrics": MetricRecord({"place": place}),
                }
            )
            for place, update in enumerate(updates)
        ]
        chosen = [
            updates[int(cast(int, each.metric_records["metrics"]["place"]))]
            for each in select_multikrum(contents, 2, kept)
        ]
        found = Krum(byzantine=2, kept=kept).combine(updates[0].weights, updates)
        for name in ("a", "b"):
            mean = np.mean([each.weights[name] for each in chosen], axis=0)
            np.testing.assert_allclose(found[name], mean, rtol=1e-5)


class Byzantine(Descent):
    """A client that lies about what it learned."""

    lie = "none"

    def train(self, weights, **how):
        if self.lie == "labels":
            return Descent(self.inputs, -self.targets).train(weights, **how)
        update = super().train(weights, **how)
        factor = {"sign": -4.0, "scaled": 100.0}[self.lie]
        return replace(
            update, weights={**update.weights, "w": weights["w"] + factor * (update.weights["w"] - weights["w"])}
        )


@pytest.mark.slow
@pytest.mark.parametrize("lie", ["sign", "scaled", "labels"])
def test_byzantine_clients_mislead_the_mean_and_not_the_robust_strategies(lie: str):
    rng, clients = np.random.default_rng(1), {}
    for i in range(10):
        inputs = rng.normal(size=(30, 3))
        clients[f"cav{i}"] = (Byzantine if i in (1, 4, 8) else Descent)(inputs, inputs @ TRUTH)
        clients[f"cav{i}"].lie = lie
    schedule = Schedule(rounds=15, steps=40, learning_rate=0.02, final_learning_rate=0.01, seed=1)

    def error(strategy: Any) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            found = federate(clients, FIRST, schedule, account(), strategy=strategy, rules=Rules(least_clients=1))
        return float(np.linalg.norm(found.weights["w"] - TRUTH))

    misled = error(FEDAVG)
    assert misled > 0.3
    for strategy in (Median(), TrimmedMean(0.3), Krum(byzantine=3), Krum(byzantine=3, kept=4)):
        assert error(strategy) < 0.1 * misled, strategy


def test_what_makes_no_sense_is_one_sentence():
    plain = vehicles("grid", 3)
    for strategy, rules, said in (
        (FedProx(), Rules(), r"FedProx needs clients whose training takes 'proximal', and that of grid/cav0"),
        (Scaffold(), Rules(), r"Scaffold needs clients whose training takes 'shift'"),
        (Krum(byzantine=1), Rules(), r"krum: 5 clients or more are wanted for byzantine = 1 and kept = 1, .* are 3"),
        (TrimmedMean(0.2), Rules(), r"trimmed-mean: a fraction of 0\.2 of 3 clients leaves nobody out"),
        (FedMD(), Rules(), r"FedMD needs clients whose training takes 'own'"),
        (FedMD(), Rules(upload=Upload(layers=("w",))), r"FedMD sends class probabilities, and 'upload.layers' names"),
        (FedMD(), Rules(privacy=Privacy(clip=1.0, noise=1.0)), r"FedMD sends class probabilities, and noise is for"),
        (FedMD(), Rules(personal=RegionalModels(pull=1.0)), r"FedMD's vehicles have networks of their own, which regi"),
        (FEDAVG, Rules(least_clients=4), r"least_clients: 4 are wanted in a round, and 3 take part"),
    ):
        with pytest.raises(InputError, match=said):
            check_federation(plain, strategy, rules)
    for spec, said in (
        ({"fedprox": {"mu": -1}}, r"strategy 'fedprox': mu = -1: Input should be greater than or equal to 0"),
        ({"krum": {"mu": 1}}, r"strategy 'krum': has no setting 'mu'; it has byzantine, kept"),
        ({"fedavg": {"mu": 1}}, r"strategy 'fedavg': has no setting 'mu'; it has none"),
        ({"fedavg": {}, "krum": {}}, r"one name is wanted, with its settings"),
    ):
        with pytest.raises(InputError, match=said):
            strategy_named(spec)


def test_settings_are_by_name():
    assert strategy_named({"fedadam": {"rate": 0.5}}) == FedAdam(rate=0.5)
    assert all(strategy_named({name: {}}) == kind() for name, kind in STRATEGIES.items())


def test_edge_servers_take_no_local_steps_to_correct():
    assert of_servers(Scaffold()) == of_servers(FedProx()) == FEDAVG
    assert of_servers(FedAdam()) == FedAdam()
    server = EdgeServer(CLIENTS, 2, account(), FIRST, strategy=Scaffold())
    after = federate({"grid": server}, FIRST, SCHEDULE, account(), strategy=of_servers(Scaffold()))
    assert len(server.state.records) == 2 * SCHEDULE.rounds
    assert np.linalg.norm(after.weights["w"] - TRUTH) < np.linalg.norm(FIRST["w"] - TRUTH)


def mix_by_hand(rows: np.ndarray, byzantine: int) -> np.ndarray:
    """Return algorithm 2 of Allouah et al., 2023: y_i is the mean of the n - f vectors nearest to x_i, itself one."""
    mixed = []
    for x in rows:
        distances = [float(np.sum((other - x) ** 2)) for other in rows]
        nearest = sorted(range(len(rows)), key=lambda j: distances[j])[: len(rows) - byzantine]
        mixed.append(sum(rows[j] for j in nearest) / len(nearest))
    return np.array(mixed)


@pytest.mark.parametrize("byzantine", [1, 2, 3])
def test_nearest_neighbour_mixing_comes_before_each_robust_rule(byzantine: int):
    rng = np.random.default_rng(byzantine)
    rows = np.concatenate([rng.normal(size=(9 - byzantine, 4)), 30 + rng.normal(size=(byzantine, 4))])
    variances, counts = rng.random((9, 2)) + np.arange(9)[:, None], np.arange(9) ** 2
    updates = [
        LocalUpdate(
            {"a": row[:1], "b": row[1:].reshape(1, 3), "bn.running_var": variance, "n": np.array(count)}, 1 + i, 0.0
        )
        for i, (row, variance, count) in enumerate(zip(rows, variances, counts, strict=True))
    ]
    mixed = mix_by_hand(rows, byzantine)
    scores = [np.sort(((mixed - own) ** 2).sum(axis=1))[1 : 9 - byzantine - 1].sum() for own in mixed]
    nearest = np.argsort(scores, kind="stable")
    expected = {
        Median(byzantine): np.median(mixed, axis=0),
        TrimmedMean(0.25, byzantine): trim_mean(mixed, 0.25),
        Krum(byzantine, 1, byzantine): mixed[nearest[0]],
        Krum(byzantine, 4, byzantine): mixed[nearest[:4]].mean(axis=0),
    }
    for strategy, learned in expected.items():
        plain = replace(strategy, mixing=0).combine(updates[0].weights, updates)
        found = strategy.combine(updates[0].weights, updates)
        np.testing.assert_allclose(np.concatenate([found["a"], found["b"].ravel()]), learned, rtol=1e-12)
        assert not np.allclose(found["b"], plain["b"])
        np.testing.assert_array_equal(found["bn.running_var"], plain["bn.running_var"])  # statistics are not mixed
        assert found["n"] == plain["n"]


def test_mixing_needs_a_majority_of_honest_clients():
    for strategy in (Median(mixing=2), TrimmedMean(0.2, mixing=2), Krum(0, mixing=2)):
        strategy.check_clients(5)
        with pytest.raises(InputError, match="mixing: 5 clients or more are wanted for 2, and there are 4"):
            strategy.check_clients(4)
    assert strategy_named({"median": {"mixing": 2}}) == Median(2)
    with pytest.raises(InputError, match="mixing = -1"):
        strategy_named({"krum": {"mixing": -1}})
    state = FederationState()  # a round that is left with too few has no update
    clients: dict[str, Any] = {
        name: Regression(each.inputs, each.targets) for name, each in vehicles("grid", 5).items()
    }
    clients["grid/cav0"].fail = True
    found = federate(clients, START, replace(SCHEDULE, rounds=1), account(), strategy=Median(2), state=state)
    np.testing.assert_array_equal(found.weights["w"], START["w"])
    assert "mixing: 5 clients or more" in state.records[0].failed["grid/cav1"]

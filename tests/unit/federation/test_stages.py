from dataclasses import dataclass, replace

import numpy as np
import pytest
from flwr.supercore.task_identity import TaskIdentity
from regression import START, TRUTH, ledger, vehicles

from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.strategies.fedavg import FedAvg, average
from flcav.network.ledger import BudgetExceeded
from flcav.network.plan import MessageSizes, StagePlan, price
from flcav.statistics.streams import derive_seed

SCHEDULE = Schedule(rounds=4, steps=20, learning_rate=0.05, final_learning_rate=0.01, seed=3)


def edge(book=None):
    return Account(book or ledger(), "edge", "regression", "wireless")


def bare_fedavg(clients, weights, schedule):
    """FedAvg written out, with no framework between."""
    for round_ in range(1, schedule.rounds + 1):
        work = schedule.work(round_)
        updates = [
            client.train(weights, steps=work.steps, learning_rate=work.learning_rate, seed=derive_seed(work.seed, name))
            for name, client in clients.items()
        ]
        total = sum(update.samples for update in updates)
        w = np.sum([update.samples / total * update.weights["w"].astype(np.float64) for update in updates], axis=0)
        weights = {"w": w.astype(np.float32), "count": updates[0].weights["count"]}
    return weights


def test_a_federation_is_a_bare_fedavg_loop():
    clients = vehicles("grid", 4)
    result = federate(clients, START, SCHEDULE, edge())
    np.testing.assert_array_equal(result.weights["w"], bare_fedavg(clients, START, SCHEDULE)["w"])
    assert result.samples == sum(len(client.inputs) for client in clients.values())
    assert np.linalg.norm(result.weights["w"] - TRUTH) < 0.5 * np.linalg.norm(TRUTH)


def test_integer_buffers_are_averaged_and_rounded():
    a, b = {"n": np.array(3), "w": np.array([0.0])}, {"n": np.array(6), "w": np.array([4.0])}
    combined = average([a, b], [1, 3])
    assert combined["n"] == 5  # of 5.25
    assert combined["n"].dtype == np.array(3).dtype
    np.testing.assert_allclose(combined["w"], [3.0])


def test_clients_of_another_network_are_refused():
    with pytest.raises(ValueError, match="different"):
        average([{"w": np.zeros(3)}, {"w": np.zeros(4)}], [1, 1])


@dataclass(frozen=True)
class Only:
    """A strategy that listens to one client alone."""

    client: int = 0
    renamed: str = "w"

    def combine(self, start, updates):
        weights = dict(updates[self.client].weights)
        return {self.renamed: weights.pop("w"), **weights}


def test_a_federation_does_as_its_strategy_says():
    clients = vehicles("grid", 3)
    alone = federate({"grid/cav1": clients["grid/cav1"]}, START, SCHEDULE, edge())
    led = federate(clients, START, SCHEDULE, edge(), strategy=Only(1))
    np.testing.assert_array_equal(led.weights["w"], alone.weights["w"])
    assert led.samples == 4 + 5 + 6


def test_an_edge_server_has_a_strategy_of_its_own():
    clients = vehicles("grid", 3)
    update = {"steps": 5, "learning_rate": 0.05, "seed": 1}
    server, plain = (EdgeServer(clients, 2, edge(), START, strategy=how) for how in (Only(2), FedAvg()))
    alone = EdgeServer({"grid/cav2": clients["grid/cav2"]}, 2, edge(), START)
    found = [each.train(START, **update).weights["w"] for each in (server, alone, plain)]
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


def test_a_strategy_that_returns_other_arrays_is_refused():
    with pytest.raises(ValueError, match="Only returned arrays of other names"):
        federate(vehicles("grid", 2), START, SCHEDULE, edge(), strategy=Only(renamed="v"))


@pytest.mark.parametrize("shares", [[0, 0], [1, -1], [1, np.nan], [np.inf, 1]])
def test_shares_that_make_no_mean_are_refused(shares):
    with pytest.raises(ValueError, match="they must be 0 or more"):
        average([{"w": np.zeros(1)}] * 2, shares)


def test_a_resumed_federation_ends_where_an_uninterrupted_one_does():
    whole = federate(vehicles("grid", 3), START, SCHEDULE, edge())
    kept = {}

    def stop_after_two(round_, weights, loss):
        kept.update(weights=weights, round=round_)
        if round_ == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        federate(vehicles("grid", 3), START, SCHEDULE, edge(), on_round=stop_after_two)
    resumed = federate(vehicles("grid", 3), kept["weights"], SCHEDULE, edge(), done=kept["round"])
    np.testing.assert_array_equal(resumed.weights["w"], whole.weights["w"])


def test_every_message_is_in_the_ledger_and_the_sum_is_the_price():
    book = ledger()
    federate(vehicles("grid", 4), START, SCHEDULE, edge(book))
    up = [entry for entry in book.entries if entry.direction == "up"]
    down = [entry for entry in book.entries if entry.direction == "down"]
    assert len(up) == len(down) == 4 * 4
    assert {(entry.round, entry.client) for entry in up} == {
        (r, f"grid/cav{i}") for r in (1, 2, 3, 4) for i in range(4)
    }
    plan = StagePlan(samples=0, edge_rounds=4, cloud_rounds=0, edge_groups=(4,))
    sizes = MessageSizes(sample_mb=0, model_mb=up[0].bytes / 1e6)
    assert book.used_mb("wireless") == pytest.approx(price(plan, sizes).wireless_mb, rel=0.01)


def test_an_overspend_is_refused_and_names_the_budget():
    first = ledger()
    federate(vehicles("grid", 2), START, replace(SCHEDULE, rounds=1), edge(first))
    tight = ledger(wireless_mb=first.used_mb("wireless") * 1.75)
    with pytest.raises(BudgetExceeded, match="wireless uplink budget exceeded"):
        federate(vehicles("grid", 2), START, SCHEDULE, edge(tight))
    assert tight.used_mb("wireless") <= tight.budget.wireless_mb


def test_cloud_rounds_average_edge_servers_that_start_from_their_own_models():
    book = ledger()
    own = {"grid": {**START, "w": np.full(3, 1.0, np.float32)}, "ring": {**START, "w": np.full(3, -1.0, np.float32)}}
    account = Account(book, "cloud", "regression", "wireless")
    regions = {"grid": vehicles("grid", 4), "ring": vehicles("ring", 3)}
    servers = {name: EdgeServer(regions[name], 2, account, own[name]) for name in regions}
    frozen = Schedule(rounds=1, steps=1, learning_rate=1e-12, final_learning_rate=1e-12, seed=0)
    wireline = Account(book, "cloud", "regression", "wireline")
    result = federate(servers, START, frozen, wireline)
    grid, ring = (sum(len(vehicle.inputs) for vehicle in region.values()) for region in regions.values())
    np.testing.assert_allclose(result.weights["w"], np.full(3, (grid - ring) / (grid + ring)), rtol=1e-4)
    federate(servers, result.weights, replace(frozen, rounds=2), wireline, done=1)
    up = [entry for entry in book.entries if entry.direction == "up"]
    assert sum(entry.link == "wireless" for entry in up) == 2 * 2 * 7  # cloud rounds x k x vehicles
    assert sum(entry.link == "wireline" for entry in up) == 2 * 2  # cloud rounds x edge servers
    assert sorted({entry.round for entry in up if entry.link == "wireless"}) == [1, 2, 3, 4]


def test_a_federation_leaves_flowers_process_wide_identity_as_it_was():
    before = (TaskIdentity._run_id, TaskIdentity._node_id, TaskIdentity._task_id)
    federate(vehicles("grid", 1), START, replace(SCHEDULE, rounds=1), edge())
    assert (TaskIdentity._run_id, TaskIdentity._node_id, TaskIdentity._task_id) == before

"""The model of a round in 8 bits: bytes of the messages, what clients begin with, and what the server does not lose."""

from typing import Any

import numpy as np
import pytest
from regression import ledger
from safetensors.numpy import load, save

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules, SecureAggregation
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FedProx
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.upload import SCALES, Upload, decode_model, encode_model

SCHEDULE = Schedule(rounds=4, steps=3, learning_rate=0.5, final_learning_rate=0.5, seed=3)
RNG = np.random.default_rng(5)
START = {
    "body.weight": RNG.normal(size=(64, 50)).astype(np.float32),
    "body.running_var": np.full(5, 2.0, np.float32),
    "count": np.array(7),
    "head.weight": RNG.normal(size=(50, 8)).astype(np.float32),
}
LEARNED = ("body.weight", "head.weight")
DOWN = Rules(download="int8")


def nearest(weights: Weights) -> Weights:
    """Return what a round's model is after 8 bits, element by element."""
    told = {**weights}
    for name in LEARNED:
        step = max(abs(float(value)) for value in weights[name].ravel()) / 127
        told[name] = np.reshape([round(float(v) / step) * step for v in weights[name].ravel()], weights[name].shape)
    return told


class Nudged:
    """Adds a number to every weight, and keeps what it began with."""

    def __init__(self, by: float, samples: int = 1) -> None:
        self.by, self.samples, self.begun = by, samples, list[Weights]()

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, proximal: float = 0.0, **_: Any
    ) -> LocalUpdate:
        self.begun.append(weights)
        moved = {name: (weights[name] + self.by).astype(np.float32) for name in LEARNED}
        return LocalUpdate({**weights, **moved, "count": weights["count"] + 1}, self.samples, 1.0)


def test_a_model_in_eight_bits_is_by_an_oracle_the_nearest_level() -> None:
    sent = encode_model(START)
    assert [*sent] == [*START, SCALES]
    assert {sent[name].dtype for name in LEARNED} == {np.dtype(np.int8)}
    back, told = decode_model(sent), nearest(START)
    for name in START:
        assert back[name].dtype == START[name].dtype
        np.testing.assert_allclose(back[name], told[name], atol=1e-6)
    double = {"w": np.ones(3)}
    assert encode_model(double).keys() == double.keys()  # of another precision: as it is


def test_clients_begin_with_it_and_the_server_keeps_what_it_lost() -> None:
    clients = {"cav0": Nudged(0.25, 1), "cav1": Nudged(-0.05, 2)}
    account = Account(ledger(10.0), "edge", "walk", "wireless")
    once = Schedule(rounds=1, steps=1, learning_rate=1.0, final_learning_rate=1.0, seed=1)
    found = federate(clients, START, once, account, rules=DOWN).weights
    told = nearest(START)
    for name in LEARNED:
        np.testing.assert_allclose(clients["cav0"].begun[0][name], told[name], atol=1e-6)
        np.testing.assert_allclose(found[name], START[name] + 0.05, atol=1e-6)
    assert int(found["count"]) == 8
    down = [entry.bytes for entry in account.ledger.entries if entry.direction == "down"]
    weights = 64 * 50 + 50 * 8
    assert weights < min(down) <= max(down) < weights + 1200  # names, types and shapes of Flower's arrays


def test_changes_below_a_level_add_up() -> None:
    """A level is 1; 40 rounds of .02 are .8, of which rounding the server's model itself would have kept nothing."""
    start = {"body.weight": np.array([127.0, 0.0], np.float32), "head.weight": np.array([127.0, 5.0], np.float32)}
    clients = {"cav0": Nudged(0.02)}
    schedule = Schedule(rounds=40, steps=1, learning_rate=1.0, final_learning_rate=1.0, seed=1)
    found = federate(clients, {**start, "count": np.array(0)}, schedule, rules=DOWN).weights
    np.testing.assert_allclose(found["body.weight"], [127.8, 0.8], atol=1e-3)
    assert clients["cav0"].begun[39]["body.weight"][1] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    "rules",
    [
        DOWN,
        Rules(download="int8", upload=Upload(compression="int8")),
        Rules(download="int8", upload=Upload(compression="int4")),
        Rules(download="int8", upload=Upload(layers=("head.*",))),
        Rules(download="int8", selection=Selection(rule="importance", clients=2)),
        Rules(download="int8", secure=SecureAggregation(largest=8.0)),
    ],
    ids=["alone", "int8 up", "int4 up", "layers", "importance", "masked"],
)
def test_it_goes_with_other_forms_and_resumes_to_the_same_bits(rules: Rules) -> None:
    def run(start: Weights = START, **how: Any) -> Weights:
        clients = {f"cav{i}": Nudged(0.1) for i in range(3)}
        return federate(clients, start, SCHEDULE, rules=rules, **how).weights

    kept: list[tuple[Weights, bytes]] = []
    state = FederationState()

    def keep(round_: int, weights: Weights, loss: float | None) -> None:
        kept.append((weights, save({name: array.copy() for name, array in state.to_arrays().items()})))

    found = run(on_round=keep, state=state)
    changed = ("head.weight",) if rules.upload.layers else LEARNED
    for name in LEARNED:
        assert np.array_equal(found[name], START[name]) == (name not in changed)
    if rules.selection.rule == "all":
        for name in changed:
            np.testing.assert_allclose(found[name], START[name] + 0.4, atol=2e-3)
    weights, arrays = kept[1]
    resumed = FederationState()
    resumed.restore(load(arrays) if len(arrays) > 20 else {}, [])
    again = run(weights, done=2, state=resumed)
    assert all(np.array_equal(found[name], again[name]) for name in found)


def test_vehicles_get_it_in_cloud_rounds_too_edge_servers_do_not_and_other_strategies_take_it() -> None:
    book = ledger(10.0, 10.0)
    cloud, edge = Account(book, "cloud", "walk", "wireline"), Account(book, "grid", "walk", "wireless")
    server = EdgeServer({"cav0": Nudged(0.1)}, 2, edge, START, rules=DOWN)
    found = federate({"grid": server}, START, SCHEDULE, cloud, rules=DOWN.of_servers()).weights
    np.testing.assert_allclose(found["head.weight"], START["head.weight"] + 0.8, atol=4e-3)
    sent = [entry for entry in book.entries if entry.direction == "down"]
    down = {stage: [each.bytes for each in sent if each.stage == stage] for stage in ("cloud", "grid")}
    assert (len(down["grid"]), len(down["cloud"])) == (8, 4)
    assert max(down["grid"]) < 3600 + 1200 < 4 * 3600 < min(down["cloud"])
    nudged = {"cav0": Nudged(0.1)}
    found = federate(nudged, START, SCHEDULE, strategy=FedProx(mu=0.1), rules=DOWN).weights
    np.testing.assert_allclose(found["head.weight"], START["head.weight"] + 0.4, atol=2e-3)


def test_where_it_cannot_be_is_one_sentence() -> None:
    clients = {f"cav{i}": Nudged(0.1) for i in range(3)}
    for strategy, told in (
        (FedMD(), "'download' is a form of weights"),
        (FedBuff(buffer=2), "models of several rounds"),
    ):
        with pytest.raises(InputError, match=told):
            federate(clients, START, SCHEDULE, strategy=strategy, rules=DOWN)
    with pytest.raises(ValueError, match="download"):
        Rules.model_validate({"download": "int2"})
    assert "download" not in Rules().model_dump_json()

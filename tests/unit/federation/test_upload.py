"""What an update is sent as: bytes of the messages, what comes back, error feedback, and named layers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flwr.app import RecordDict
from flwr.common.serde import recorddict_to_proto
from hypothesis import given, settings
from hypothesis import strategies as st
from regression import ledger
from safetensors.numpy import load, save

from flcav.config import InputError
from flcav.federation.acceptance import Expected, ReplyRefused, read_update
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.in_process import update_bytes
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.upload import SCALES, VALUES, Upload, compress, decompress
from flcav.federation.wire import EXTRA, encode_update, to_array_record, update_content

SCHEDULE = Schedule(rounds=5, steps=3, learning_rate=0.5, final_learning_rate=0.5, seed=3)
SIZE = (64, 50)
START = {
    "body.weight": np.zeros(SIZE, np.float32),
    "head.weight": np.ones((50, 8), np.float32),
    "norm.running_var": np.full(5, 2.0, np.float32),
    "norm.count": np.array(7),
}
KINDS: dict[str, dict[str, Any]] = {
    "fp16": {"compression": "fp16"},
    "int8": {"compression": "int8"},
    "int8 with feedback": {"compression": "int8", "error_feedback": True},
    "int4": {"compression": "int4"},
    "int4 without feedback": {"compression": "int4", "error_feedback": False},
    "top-k": {"compression": "top-k", "fraction": 0.05},
    "layers": {"layers": ("head.*",)},
    "layers of int8": {"layers": ("head.*",), "compression": "int8"},
}


class Walk:
    """Walks towards its own target."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.targets = {name: rng.normal(size=START[name].shape) for name in ("body.weight", "head.weight")}

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int, layers: Any = ()) -> LocalUpdate:
        moved = dict(weights)
        for name, target in self.targets.items():
            if not layers or name.startswith("head"):
                noise = np.random.default_rng(seed).normal(size=target.shape, scale=0.01)
                moved[name] = (weights[name] + learning_rate * (target - weights[name] + noise)).astype(np.float32)
        moved["norm.running_var"] = np.full(5, 3.0, np.float32)
        return LocalUpdate(moved, 2, 1.0)


CLIENTS = {f"cav{i}": Walk(i) for i in range(3)}
MEAN = {
    name: np.mean([client.targets[name] for client in CLIENTS.values()], axis=0) for name in CLIENTS["cav0"].targets
}


@pytest.mark.parametrize(
    ("upload", "beside"), [(Upload(), ["body.weight", "head.weight"]), (Upload(layers=("head.*",)), ["head.weight"])]
)
def test_an_array_beside_each_that_is_learned_and_sent_is_priced(upload: Upload, beside: list[str]):
    more = recorddict_to_proto(RecordDict({EXTRA: to_array_record({name: START[name] for name in beside})})).ByteSize()
    assert update_bytes(START, upload, exchanging=True) - update_bytes(START, upload) == more


def run(upload: Upload, start: Weights = START, **how: Any) -> tuple[Weights, Account]:
    account = Account(ledger(10.0), "edge", "walk", "wireless")
    return federate(CLIENTS, start, SCHEDULE, account, rules=Rules(upload=upload), **how).weights, account


def up(account: Account) -> list[int]:
    return [entry.bytes for entry in account.ledger.entries if entry.direction == "up"]


def same(one: Weights, other: Weights) -> bool:
    return save(dict(one)) == save(dict(other))


@pytest.mark.parametrize("kind", KINDS)
def test_a_compressed_federation_is_deterministic_and_resumes_to_the_same_bits(kind: str):
    upload, kept = Upload(**KINDS[kind]), []
    state = FederationState()

    def keep(round_: int, weights: Weights, loss: float | None) -> None:
        kept.append((weights, save({name: array.copy() for name, array in state.to_arrays().items()})))

    once = run(upload, on_round=keep, state=state)[0]
    assert same(run(upload)[0], once)
    for done in (1, 4):
        weights, arrays = kept[done - 1]
        resumed = FederationState()
        resumed.restore(load(arrays) if len(arrays) > 20 else {}, [])
        assert same(run(upload, weights, done=done, state=resumed)[0], once)
    assert {name: (a.shape, a.dtype) for name, a in once.items()} == {n: (a.shape, a.dtype) for n, a in START.items()}


@pytest.mark.parametrize(
    ("kind", "per_weight"), [("fp16", 2), ("int8", 1), ("int4", 0.5), ("top-k", 0.05 * 8), ("layers", 0.5)]
)
def test_the_ledger_has_the_bytes_that_are_left(kind: str, per_weight: float):
    whole, fewer = up(run(Upload())[1]), up(run(Upload(**KINDS[kind]))[1])
    weights = 64 * 50 + 50 * 8
    assert min(whole) > 4 * weights
    arrays = (400 * 4) if kind == "layers" else per_weight * weights
    assert arrays < max(fewer) < arrays + 1200  # names, types and shapes of Flower's arrays
    assert set(whole) == {update_bytes(START)}
    assert abs(update_bytes(START, Upload(**KINDS[kind])) - fewer[0]) <= 16  # metrics of other values


@pytest.mark.slow
def test_fp16_and_int8_end_near_and_top_k_gets_there_by_what_it_kept():
    plain = run(Upload())[0]
    for kind, error in (("fp16", 1e-3), ("int8", 0.05)):
        np.testing.assert_allclose(run(Upload(**KINDS[kind]))[0]["body.weight"], plain["body.weight"], atol=error)
    far = np.linalg.norm(MEAN["body.weight"])
    long = Schedule(rounds=250, steps=1, learning_rate=0.03, final_learning_rate=0.03, seed=1)

    def distance(error_feedback: bool) -> float:
        rules = Rules(upload=Upload(**KINDS["top-k"], error_feedback=error_feedback))
        account = Account(ledger(100.0), "edge", "walk", "wireless")
        found = federate(CLIENTS, START, long, account, rules=rules).weights["body.weight"]
        return float(np.linalg.norm(found - MEAN["body.weight"]) / far)

    kept = distance(True)
    assert kept < 0.15, kept
    assert kept < 0.3 * distance(False), distance(False)
    short = Schedule(rounds=30, steps=1, learning_rate=0.3, final_learning_rate=0.3, seed=1)
    ends = {
        feedback: federate(
            CLIENTS, START, short, rules=Rules(upload=Upload(compression="int4", error_feedback=feedback))
        ).weights["body.weight"]
        for feedback in (True, False)
    }
    near, far = (np.linalg.norm(ends[feedback] - MEAN["body.weight"]) for feedback in (True, False))
    assert near < 0.8 * far, (near, far)


@given(st.integers(0, 1000), st.floats(1e-3, 1e3))
@settings(max_examples=25, deadline=None)
def test_what_top_k_sends_and_keeps_is_all_there_was(seed: int, scale: float):
    rng = np.random.default_rng(seed)
    change = {"a": (scale * rng.normal(size=(7, 3))).astype(np.float32), "b": rng.normal(size=11).astype(np.float32)}
    residual = rng.normal(size=32).astype(np.float32)
    upload = Upload(compression="top-k", fraction=0.2)
    sent, kept = compress(upload, change, residual, seed)
    back = decompress(upload, sent, change)
    flat = np.concatenate([back["a"].ravel(), back["b"]])
    whole = np.concatenate([change["a"].ravel(), change["b"]]) + residual
    np.testing.assert_array_equal(flat + kept[VALUES], whole)
    assert np.count_nonzero(flat) == round(0.2 * 32)
    assert np.abs(flat[flat != 0]).min() >= np.abs(kept[VALUES]).max()
    assert compress(Upload(compression="top-k", error_feedback=False), change, None, seed)[1] == {}


def quantised(whole: Weights, levels: int) -> Weights:
    """Return what rounding to the nearest of `levels` on either side of 0 leaves, element by element."""
    back = {}
    for name, array in whole.items():
        step = max((abs(float(value)) for value in array.ravel()), default=0.0) / levels
        rounded = [round(float(value) / step) * step if step else 0.0 for value in array.ravel()]
        back[name] = np.reshape(rounded, array.shape)
    return back


@pytest.mark.parametrize(("compression", "levels"), [("int8", 127), ("int4", 7)])
def test_feedback_of_rounding_is_by_an_oracle_what_there_was_less_what_came(compression: Any, levels: int):
    rng = np.random.default_rng(levels)
    upload = Upload(compression=compression, error_feedback=True)
    residual: Any = None
    left = np.zeros(33)
    for _ in range(4):
        change = {"a": rng.normal(size=(7, 3)).astype(np.float32), "b": rng.normal(size=12).astype(np.float32) ** 3}
        sent, kept = compress(upload, change, residual, 1)
        whole = {"a": change["a"] + left[:21].reshape(7, 3), "b": change["b"] + left[21:]}
        told = quantised(whole, levels)
        back = decompress(upload, sent, change)
        for name in change:
            np.testing.assert_allclose(back[name], told[name], atol=1e-5)
        left = np.concatenate([np.ravel(whole[name] - told[name]) for name in change])
        residual = kept[VALUES]
        np.testing.assert_allclose(residual, left, atol=1e-5)
        assert np.linalg.norm(residual) < np.linalg.norm(np.concatenate([each.ravel() for each in whole.values()]))


@pytest.mark.parametrize("size", [1, 2, 5, 6])
def test_two_levels_of_int4_share_a_byte(size: int):
    change = {"a": np.linspace(-7, 7, size, dtype=np.float32)}
    sent, _ = compress(Upload(compression="int4"), change, None, 0)
    assert (sent["a"].dtype, sent["a"].nbytes) == (np.uint8, (size + 1) // 2)
    if size == 5:  # -7, -3.5, 0, 3.5, 7: to even levels, with 8 added
        assert [hex(each) for each in sent["a"]] == ["0x41", "0xc8", "0xf"]
    np.testing.assert_allclose(decompress(Upload(compression="int4"), sent, change)["a"], change["a"], atol=0.5)


@pytest.mark.parametrize(("compression", "levels"), [("int8", 127), ("int4", 7)])
def test_int8_and_int4_without_feedback_are_unbiased_and_within_a_step(compression: Any, levels: int):
    change = {"a": np.linspace(-1, 1, 41, dtype=np.float32) ** 3, "b": np.zeros(4, np.float32)}
    upload = Upload(compression=compression, error_feedback=False)
    back, step = [], 0.0
    for seed in range(4000):
        sent, kept = compress(upload, change, None, seed)
        step = float(sent[SCALES][0])
        assert {sent["a"].dtype, sent["b"].dtype} == {np.dtype(np.int8 if levels > 7 else np.uint8)}
        assert kept == {}
        back.append(decompress(upload, sent, change))
    assert step == pytest.approx(1 / levels)
    every = np.array([each["a"] for each in back])
    assert np.abs(every - change["a"]).max() <= step * 1.0001
    np.testing.assert_allclose(every.mean(axis=0), change["a"], atol=4 * step / 2 / np.sqrt(4000))
    assert not any(each["b"].any() for each in back)


def test_named_layers_alone_are_trained_and_sent():
    found = run(Upload(layers=("head.*",)))[0]
    for name in START:
        assert np.array_equal(found[name], START[name]) == (name != "head.weight")
    assert run(Upload(layers=("head.*", "norm.*")))[0]["norm.running_var"][0] == 3.0


def test_edge_servers_send_in_the_same_form():
    rules = Rules(upload=Upload(**KINDS["layers of int8"]))
    account = Account(ledger(10.0, 10.0), "cloud", "walk", "wireline")
    servers = {"grid": EdgeServer(CLIENTS, 2, account, START, rules=rules)}
    found = federate(servers, START, SCHEDULE, account, rules=Rules(upload=rules.upload)).weights
    assert np.array_equal(found["body.weight"], START["body.weight"])
    assert max(up(account)) < 400 + 1200


def test_messages_that_are_no_update_are_told():
    update = CLIENTS["cav0"].train(START, steps=1, learning_rate=0.1, seed=0)
    for kind, wrong in (
        ("top-k", {"#indices": np.array([9999], np.uint32)}),
        ("top-k", {"#values": np.zeros(3, np.float32)}),
        ("int8", {"head.weight": np.zeros((2, 2), np.int8)}),
        ("int8", {SCALES: np.zeros(1, np.float32)}),
        ("int4", {"head.weight": np.zeros(199, np.uint8)}),
        ("layers", {"body.weight": START["body.weight"]}),
    ):
        rules = Rules(upload=Upload(**KINDS[kind]))
        sent, expected = encode_update(update, START, rules, {}, 1)[0], Expected(rules, START)
        read_update(update_content(sent, {}), expected)
        with pytest.raises(ReplyRefused):
            read_update(update_content(replace(sent, weights={**sent.weights, **wrong}), {}), expected)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["fp16", "int8", "int8 with feedback", "int4", "top-k"])
@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_a_change_that_is_not_finite_is_refused_in_every_form(kind: str, value: float):
    weights = START | {"body.weight": START["body.weight"].copy()}
    weights["body.weight"][3, 4] = value
    rules = Rules(upload=Upload(**KINDS[kind]))
    sent, _ = encode_update(LocalUpdate(weights, 2, 1.0), START, rules, {}, 1)
    with pytest.raises(ReplyRefused, match=r"'body.weight' has values that are not finite"):
        read_update(update_content(sent, {}), Expected(rules, START))


def test_layers_of_another_network_are_one_sentence():
    with pytest.raises(InputError, match=r"layers: 'neck.*' matches none of 4 arrays, such as 'body.weight'"):
        run(Upload(layers=("neck.*",)))
    with pytest.raises(InputError, match=r"layers norm.*: match no array that is learned"):
        run(Upload(layers=("norm.*",)))

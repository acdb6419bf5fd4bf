"""Replies that are none: whatever one client sends, under every rule, it is named and the round goes on without it."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from flwr.app import Array, ArrayRecord, ConfigRecord, Message, MetricRecord, RecordDict
from pydantic import ValidationError

from flcav.federation.links import link as links
from flcav.federation.links.in_process import LinkGrid
from flcav.federation.links.metered import Account, MeteredGrid
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.secure.primitives import SHARE_BYTES
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.strategies.robust import Median
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.wire import ARRAYS, ASK, METRICS, NORM, SHARES, VECTOR, to_array_record
from flcav.network.ledger import Ledger, LinkMegabytes

START = {"w": np.zeros((4, 3), np.float32), "g": np.zeros((64, 1), np.float32), "count": np.array(2)}
SCHEDULE = Schedule(2, 1, 0.1, 0.1, 1)
RULES: Mapping[str, dict[str, Any]] = {
    "plain": {},
    "fp16": {"upload": {"compression": "fp16"}},
    "int8": {"upload": {"compression": "int8"}},
    "top-k": {"upload": {"compression": "top-k", "fraction": 0.2}},
    "local noise": {"privacy": {"where": "local", "clip": 1, "noise": 0.1, "seeded": True}},
    "importance": {"selection": {"rule": "importance", "clients": 5}},
    "unbiased": {"selection": {"rule": "uniform", "clients": 5, "unbiased": True}},
    "secure": {"secure": {}},
}
Damage = Callable[[RecordDict], None]  # of a reply


class Vehicle:
    def train(self, weights: Weights, **_: Any) -> LocalUpdate:
        moved = {name: (array + 1).astype(array.dtype) for name, array in weights.items()}
        return LocalUpdate(moved, 5, 0.1, {name: moved[name] for name in ("w", "g")})

    def count_samples(self, steps: int) -> int:
        return 5


class LyingGrid(LinkGrid):
    """The link of five clients, one of which lies."""

    def __init__(self, grid: Any, names: Mapping[int, str], liar: str, damage: Damage) -> None:
        self._grid, self.names, self._liar, self._damage = grid, names, liar, damage

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterator[Message]:
        for reply in self._grid.send_and_receive(messages, timeout=timeout):
            if self.names[reply.metadata.src_node_id] == self._liar and reply.has_content():
                self._damage(reply.content)
            yield reply


def run(
    monkeypatch: pytest.MonkeyPatch, rules: Rules, liar: str, damage: Damage, strategy: Strategy = FEDAVG
) -> tuple[Weights, FederationState]:
    def link(grid: Any, account: Account, names: Mapping[int, str]) -> MeteredGrid:
        return MeteredGrid(LyingGrid(grid, names, liar, damage), account, names)

    monkeypatch.setattr(links, "MeteredGrid", link)
    clients, state = {f"cav{i}": Vehicle() for i in range(5)}, FederationState()
    account = Account(Ledger(LinkMegabytes(999.0, 0.0)), "edge", "toy", "wireless")
    return federate(clients, START, SCHEDULE, account, rules=rules, state=state, strategy=strategy).weights, state


def check(weights: Weights, state: FederationState, liar: str, *, counts: bool = False) -> None:
    """Assert that the liar alone is named in each round, with a reason, and that the weights are finite."""
    others = {f"cav{i}" for i in range(5)} - {liar}
    for record in state.records:
        assert record.failed.keys() == {liar}, record.failed
        assert 0 < len(record.failed[liar]) < 300
        assert {*record.clients} - ({liar} if counts else set()) == others
    assert all(np.isfinite(array).all() for array in weights.values())
    assert np.abs(weights["w"]).max() < 5


def with_metrics(**given: Any) -> Damage:
    def damage(content: RecordDict) -> None:
        if METRICS in content:
            before = dict(content.metric_records[METRICS])
            content[METRICS] = MetricRecord(before | {n.replace("_", "-"): v for n, v in given.items()})

    return damage


def with_loss_or_norm(value: Any) -> Damage:
    return lambda content: with_metrics(**{NORM if is_report(content) else "loss": value})(content)


def is_report(content: RecordDict) -> bool:
    return METRICS in content and NORM in content.metric_records[METRICS]


def without(key: str) -> Damage:
    def damage(content: RecordDict) -> None:
        if key in content:
            del content[key]

    return damage


def with_records(**given: Any) -> Damage:
    def damage(content: RecordDict) -> None:
        for key, record in given.items():
            content[key] = record

    return damage


def with_array(change: Callable[[str, np.ndarray], Mapping[str, Any]], where: str | None = None) -> Damage:
    """Return damage of the first array of an update, or of one that is called `where`."""

    def damage(content: RecordDict) -> None:
        if ARRAYS in content:
            own = {name: array.numpy() for name, array in content.array_records[ARRAYS].items()}
            name = next(iter(own)) if where is None else where
            array = own.pop(name)
            content[ARRAYS] = to_array_record({**own, **change(name, array)})

    return damage


def with_header(text: str) -> Damage:
    def damage(content: RecordDict) -> None:
        if ARRAYS in content:
            first, *rest = content.array_records[ARRAYS].items()
            head = text.encode() + b"\n"
            data = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(48)
            odd = Array(dtype=first[1].dtype, shape=first[1].shape, stype=first[1].stype, data=data)
            content[ARRAYS] = ArrayRecord({first[0]: odd, **dict(rest)})

    return damage


def declared(text: str) -> str:
    return f"{{'descr': {text}, 'fortran_order': False, 'shape': (4, 3), }}"


NPY = "{'descr': '<f4', 'fortran_order': %s, 'shape': (%d,), }"
ANYWHERE: Mapping[str, Damage] = {
    **{f"samples {value}": with_metrics(num_examples=value) for value in (np.inf, np.nan, -3, 0, 2**62, [1, 2], 5.5)},
    **{f"loss or norm {value}": with_loss_or_norm(value) for value in (np.nan, np.inf, 1e308, -1e308, [0.1])},
    "header in Fortran's order of 2^42": with_header(NPY % (True, 2**42)),
    "header of 2^42": with_header(NPY % (False, 2**42)),
    "header of a negative shape": with_header(NPY % (False, -1)),
    "deep header": with_header("-" * 5000 + "1"),
    "deep brackets": with_header("(" * 3000),
    **{f"header of {text}": with_header(declared(text)) for text in ("'|O'", "[('a', '<f4')]", "'|V0'", "'>f4'")},
    "unknown record": with_records(extra=to_array_record({"x": np.zeros(1, np.float32)})),
    "no metrics": without(METRICS),
    "no arrays": without(ARRAYS),
    "other metrics": with_metrics(more=1),
    "metrics as arrays": with_records(metrics=to_array_record(START)),
    "arrays as settings": with_records(arrays=ConfigRecord({"w": 1})),
    "other shape": with_array(lambda name, array: {name: np.zeros((3, 4, 2), array.dtype)}),
    "other type": with_array(lambda name, array: {name: array.astype(np.complex128)}),
    "text": with_array(lambda name, array: {name: np.full(array.shape, "1.5")}),
    "missing array": with_array(lambda name, array: {}),
    "unknown array": with_array(lambda name, array: {name: array, "z": np.zeros(3, np.float32)}),
    "long name": with_array(lambda name, array: {name: array, "z" * 10**6: np.zeros(3, np.float32)}),
}
OPEN: Mapping[str, Damage] = {  # values that masks would hide, by rules
    "plain, not finite": with_array(lambda name, array: {name: np.full_like(array, np.nan)}),
    "plain, 3e38": with_array(lambda name, array: {name: np.full_like(array, 3e38)}),
    "fp16, not finite": with_array(lambda name, array: {name: np.full_like(array, np.inf)}),
    "int8, scale inf": with_array(lambda name, array: {name: np.full(2, np.inf, np.float32)}, "#scales"),
    "int8, scales of megabytes": with_array(lambda name, array: {name: np.ones((2, 200_000), np.float32)}, "#scales"),
    "int8, one scale": with_array(lambda name, array: {name: array[:1]}, "#scales"),
    "int8, scale without dimension": with_array(lambda name, array: {name: np.float32(1)}, "#scales"),
    "int8, scale 3e38": with_array(lambda name, array: {name: np.full(2, 3e38, np.float32)}, "#scales"),
    "top-k, coordinate beyond": with_array(lambda name, array: {name: array + np.uint32(10**6)}, "#indices"),
    "top-k, negative": with_array(lambda name, array: {name: -array.astype(np.int32)}, "#indices"),
    "top-k, coordinates twice": with_array(lambda name, array: {name: np.zeros_like(array)}, "#indices"),
    "top-k, falling coordinates": with_array(lambda name, array: {name: array[::-1]}, "#indices"),
    "top-k, value inf": with_array(lambda name, array: {name: np.full_like(array, np.inf)}, "#values"),
    "top-k, few values": with_array(lambda name, array: {name: array[:3]}, "#values"),
    "local noise, samples": with_metrics(num_examples=2),
    "secure, masked values": with_array(lambda name, array: {name: array.astype(np.int32)}, VECTOR),
    "secure, fewer values": with_array(lambda name, array: {name: array[:-1]}, VECTOR),
    "importance, a larger change than it told": lambda content: (
        with_metrics(norm=0.1)(content) if is_report(content) else None
    ),
    "importance, negative norm": lambda content: with_metrics(norm=-1.0)(content) if is_report(content) else None,
}


@pytest.mark.parametrize(("rules", "liar"), [*((rules, "cav0") for rules in RULES), ("plain", "cav4")])
@pytest.mark.parametrize("name", ANYWHERE)
def test_a_malformed_reply_costs_its_client_the_round(
    monkeypatch: pytest.MonkeyPatch, name: str, rules: str, liar: str
):
    check(*run(monkeypatch, Rules.model_validate(RULES[rules]), liar, ANYWHERE[name]), liar)


@pytest.mark.parametrize("case", OPEN)
def test_values_that_the_rules_do_not_allow_cost_their_client_the_round(monkeypatch: pytest.MonkeyPatch, case: str):
    rules = Rules.model_validate(RULES[case.partition(",")[0]])
    check(*run(monkeypatch, rules, "cav0", OPEN[case]), "cav0")


def with_answer(step: str, **given: Any) -> Damage:
    """Return damage of entries of the answers of secure aggregation at one step, by functions of what they were."""

    def damage(content: RecordDict) -> None:
        if ASK not in content:
            return
        record = dict(content.config_records[ASK])
        size = len(record[SHARES][0]) if SHARES in record else 0  # type: ignore[index,arg-type]
        if step == ("keys" if not size else "reveal" if size == SHARE_BYTES else "share"):
            content[ASK] = ConfigRecord(record | {name: change(record[name]) for name, change in given.items()})

    return damage


SECURE: Mapping[str, Damage] = {
    "no keys": without(ASK),
    "keys of no order": with_answer("keys", ciphers=lambda _: bytes(32)),
    "masks of no order": with_answer("keys", masks=lambda _: bytes(32)),
    "short keys": with_answer("keys", masks=lambda _: b"x"),
    "keys in words": with_answer("keys", ciphers=lambda _: "abc"),
    "shares for fewer": with_answer("share", shares=lambda given: given[:-1], names=lambda given: given[:-1]),
    "shares without names": with_answer("share", names=lambda given: given[:-1]),
    "shares for one twice": with_answer("share", names=lambda given: [given[0], *given[:-1]]),
    "shares for strangers": with_answer("share", names=lambda given: ["x", *given[1:]]),
    "short shares": with_answer("share", shares=lambda given: [each[:-1] for each in given]),
    "shares as numbers": with_answer("share", shares=lambda given: [1] * len(given)),
    "garbage for all": with_answer("share", shares=lambda given: [b"\x01" * len(each) for each in given]),
    "garbage for two": with_answer("share", shares=lambda given: [bytes(len(each)) for each in given[:2]] + given[2:]),
    "complaint about nobody": with_records(ask=ConfigRecord({"names": []})),
}


@pytest.mark.parametrize("liar", ["cav0", "cav3"])
@pytest.mark.parametrize("case", SECURE)
def test_a_client_that_breaks_secure_aggregation_is_found(monkeypatch: pytest.MonkeyPatch, case: str, liar: str):
    check(*run(monkeypatch, Rules.model_validate({"secure": {}}), liar, SECURE[case]), liar)


REVEALED: Mapping[str, Damage] = {
    "wrong": with_answer("reveal", shares=lambda given: [b"\x01" + b"\x07" * (SHARE_BYTES - 1)] * len(given)),
    "wrong of one": with_answer("reveal", shares=lambda given: [bytes(SHARE_BYTES), *given[1:]]),
    "swapped": with_answer("reveal", shares=lambda given: given[::-1]),
    "fewer": with_answer("reveal", shares=lambda given: given[:-1], names=lambda given: given[:-1]),
    "short": with_answer("reveal", shares=lambda given: [each[:-1] for each in given]),
}


@pytest.mark.parametrize("case", REVEALED)
def test_a_client_that_reveals_wrong_shares_is_named_and_the_sum_comes_out(monkeypatch: pytest.MonkeyPatch, case: str):
    weights, state = run(monkeypatch, Rules.model_validate({"secure": {}}), "cav1", REVEALED[case])
    check(weights, state, "cav1", counts=True)  # its masked update is in the sum, which cannot be made without it
    np.testing.assert_allclose(weights["w"], 2.0, atol=1e-5)


def test_a_sum_that_cannot_be_unmasked_costs_the_round_and_not_the_federation(monkeypatch: pytest.MonkeyPatch):
    rules = Rules.model_validate({"secure": {"threshold": 5}})  # all shares are needed: none is left to compare with
    weights, state = run(monkeypatch, rules, "cav1", REVEALED["wrong"])
    assert not weights["w"].any()
    assert [record.clients for record in state.records] == [(), ()]
    assert all("no 5 of 5 shares make a secret" in why for record in state.records for why in record.failed.values())


@pytest.mark.parametrize("liar", ["cav0", "cav4"])
def test_arrays_beside_updates_are_judged_by_the_server_s_weights_and_not_by_the_first_client(
    monkeypatch: pytest.MonkeyPatch, liar: str
):
    for odd in ({"w": np.ones(2)}, {"odd": np.ones((4, 3), np.float32)}, {"w": START["w"]}):
        check(*run(monkeypatch, Rules(), liar, with_records(extra=to_array_record(odd)), Scaffold()), liar)
    check(*run(monkeypatch, Rules(), liar, without("extra"), Scaffold()), liar)
    check(*run(monkeypatch, Rules(), liar, with_records(extra=to_array_record({"x": np.ones(1)})), Median()), liar)


def test_limits_of_samples_norm_and_loss_are_those_of_the_rules(monkeypatch: pytest.MonkeyPatch):
    for limits, damage in (
        ({"samples": 6}, with_metrics(num_examples=7)),
        ({"norm": 100.0}, with_array(lambda name, array: {name: array + np.float32(100)})),
        ({"loss": 1.0}, with_metrics(loss=-1.5)),
    ):
        rules = Rules.model_validate({"limits": limits})
        check(*run(monkeypatch, rules, "cav2", damage), "cav2")
        assert all(not record.failed for record in run(monkeypatch, rules, "cav2", lambda _: None)[1].records)
    assert rules.of_servers().limits.samples == 10**12
    for wrong in ({"samples": 0}, {"norm": -1}, {"train_s": 0}, {"loss": 1e13}):
        with pytest.raises(ValidationError):
            Rules.model_validate({"limits": wrong})

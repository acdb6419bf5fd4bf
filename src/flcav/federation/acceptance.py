"""Validation of replies against the server's request, before anything is computed from them.

Updates are read here, keys and shares of masks in `secure.messages`. A valid reply has exactly the requested records,
arrays with the names, shapes and dtypes of the server's weights, and numbers within the limits of the rules; all others
are refused.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from flwr.app import ArrayRecord, ConfigRecord, MetricRecord, RecordDict
from numpy.typing import NDArray

from flcav.config import shorten
from flcav.federation import wire
from flcav.federation.privacy import change_norm
from flcav.federation.rules import Rules
from flcav.federation.strategies.fedavg import BLOCK
from flcav.federation.strategies.strategy import Exchanges, Strategy
from flcav.federation.trainable import Arrays, Forms, LocalUpdate, Weights, forms_of, learned_names
from flcav.federation.upload import find_change

SAME = 1e-6  # relative; above the difference of two machines in the norm of one change


class ReplyRefused(ValueError):
    """A reply that does not match its request, or exceeds the limits of the rules."""


class NotFinite(ReplyRefused):
    """A reply whose arrays are not finite: the client's training diverged, or its data are damaged."""


class NoSamples(ReplyRefused):
    """A valid reply of a client without samples."""


@dataclass(frozen=True)
class Expected:
    """The expected form of a round's updates: rules, initial weights, and further arrays."""

    rules: Rules
    start: Weights  # at the start of the round
    extra: Forms = field(default_factory=dict)  # of the strategy's further arrays


def extra_forms(strategy: Strategy, rules: Rules, start: Weights, sent: Weights) -> Forms:
    """Return shape and dtype of the strategy's further arrays in an update, as it reports them for `start`.

    sent: further arrays that the server sends.
    """
    if not isinstance(strategy, Exchanges):
        return {}
    exchanged = {*rules.upload.exchanged(start)}
    gradient = {name: np.zeros_like(start[name]) for name in learned_names(start) if name in exchanged}
    return forms_of(strategy.report(LocalUpdate(start, 1, 0.0, gradient), sent, {})[0])


def read_update(content: RecordDict, expected: Expected, told: float | None = None) -> LocalUpdate:
    """Return the decoded update in a reply; raises `ReplyRefused`.

    told: norm of the change of learned arrays that the client has reported, and that its selection was based on.
    """
    rules, start, extra = expected.rules, expected.start, expected.extra
    if wire.METRICS in content:  # a client without samples may omit the rest
        _read_numbers(content, wire.LOSS, rules)
    _check_records(content, [wire.ARRAYS, wire.METRICS, wire.EXTRA] if extra else [wire.ARRAYS, wire.METRICS])
    samples, loss = _read_numbers(content, wire.LOSS, rules)
    sent = _read_arrays(content, wire.ARRAYS, wire.sent_forms(start, rules))
    update = LocalUpdate({}, samples, loss, extra=_read_arrays(content, wire.EXTRA, extra) if extra else {})
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # such values are refused by the norm below
            update = replace(update, weights=wire.decode_update(sent, start, rules))
    except ValueError as error:
        raise ReplyRefused(str(error)) from None
    _check_change({name: update.weights[name] for name in rules.upload.exchanged(start)}, start, rules)
    _check_change(update.extra, {}, rules)
    if told is not None and not wire.is_changed(rules):  # compression may increase the norm
        exchanged = rules.upload.exchanged(start)
        names = [name for name in learned_names(start) if name in exchanged]
        if (norm := change_norm(find_change(update.weights, start, names))) > told * (1 + SAME):
            raise ReplyRefused(f"a change of the norm {norm:.3g}, where the client told {told:.3g}")
    return update


def is_usable(content: RecordDict, expected: Expected) -> bool:
    """Return whether the server accepts the update in a reply."""
    try:
        read_update(content, expected)
    except ReplyRefused:
        return False
    return True


def read_masked(content: RecordDict, expected: Expected, peers: Sequence[str]) -> LocalUpdate | Sequence[str]:
    """Return a masked update or, as a complaint, the names of the `peers` whose sealed shares do not open.

    Masked values are uniformly random, so that none can be refused. Raises `ReplyRefused`.
    """
    if wire.ASK in content:
        accused = read_entry(content, wire.NAMES)
        if not isinstance(accused, list) or not accused or not set(accused) <= set(peers):
            raise ReplyRefused(f"shares of {shorten(accused)} that do not open")
        return [name for name in peers if name in accused]
    _check_records(content, [wire.ARRAYS, wire.METRICS])
    samples, loss = _read_numbers(content, wire.LOSS, expected.rules)
    size = wire.count_coordinates(expected.start, expected.rules)
    return LocalUpdate(_read_arrays(content, wire.ARRAYS, {wire.VECTOR: ((size,), np.dtype(np.uint32))}), samples, loss)


def read_norm(content: RecordDict, rules: Rules) -> tuple[float, int]:
    """Return the norm and the number of samples that a client reports; raises `ReplyRefused`."""
    _check_records(content, [wire.METRICS])
    samples, norm = _read_numbers(content, wire.NORM, rules)
    return norm, samples


def read_entry(content: RecordDict, key: str) -> Any:
    """Return an entry of a reply's single record, None where it has none; raises `ReplyRefused` for other records."""
    _check_records(content, [wire.ASK])
    record = content[wire.ASK]
    return record.get(key) if isinstance(record, ConfigRecord) else None


def _check_records(content: RecordDict, wanted: Sequence[str]) -> None:
    if odd := sorted(set(content) ^ set(wanted)):
        kind = "lacks" if odd[0] in wanted else "has an unknown"
        raise ReplyRefused(f"a reply that {kind} '{odd[0]}'")


def _read_numbers(content: RecordDict, key: str, rules: Rules) -> tuple[int, float]:
    """Return the number of samples and the loss or norm in a reply's metrics."""
    metrics = content[wire.METRICS]
    limits = rules.limits
    if not isinstance(metrics, MetricRecord) or set(metrics) != {wire.SAMPLES, key}:
        raise ReplyRefused(f"metrics that are not {wire.SAMPLES} and {key}")
    samples, number = metrics[wire.SAMPLES], metrics[key]
    if not isinstance(samples, int) or not isinstance(number, int | float):
        raise ReplyRefused(f"{shorten(samples)} samples and a {key} of {shorten(number)}")
    least, most = (0.0, limits.norm) if key == wire.NORM else (-limits.loss, limits.loss)
    if wire.is_local(rules) and samples != 1:
        raise ReplyRefused(f"{samples} samples, where all clients count the same")
    if samples == 0:  # and the loss has no meaning
        raise NoSamples("0 samples to train on: at least 1 is wanted")
    if not (1 <= samples <= limits.samples and least <= number <= most):  # also true of NaN
        taken = f"1 to {limits.samples} samples are taken, and a {key} from {least:g} to {most:g}"
        raise ReplyRefused(f"{samples} samples and a {key} of {number}: {taken}")
    return samples, float(number)


def _read_arrays(content: RecordDict, key: str, wanted: Forms) -> Arrays:
    """Return the arrays of a record, whose declared and actual shapes and dtypes are those of `wanted`."""
    record = content[key]
    if not isinstance(record, ArrayRecord):
        raise ReplyRefused(f"'{key}' holds no arrays")
    if odd := sorted(set(record) ^ set(wanted)):
        raise ReplyRefused(f"an array {shorten(odd[0])} that is missing or unknown")
    found = {}
    for name, (shape, dtype) in wanted.items():
        array = record[name]
        if (tuple(array.shape), array.dtype) != (shape, wire.type_name(dtype)):
            raise ReplyRefused(
                f"'{name}' is {array.dtype[:20]} {shorten(tuple(array.shape))} instead of {dtype} {shape}"
            )
        try:
            found[name] = wire.to_numpy(array)
        except (TypeError, ValueError) as error:
            raise ReplyRefused(f"'{name}': {error}") from None
    return found


def _check_change(weights: Weights, start: Weights, rules: Rules) -> None:
    """Raise `ReplyRefused` where the L2 norm of the change of all floating arrays exceeds the limit or is infinite."""
    # comparisons are negated so that NaN is refused, too
    total = 0.0
    most = rules.limits.norm
    with np.errstate(over="ignore", invalid="ignore"):
        for name, array in weights.items():
            if array.dtype.kind == "f":
                total += _squared_norm(array.reshape(-1), start[name].reshape(-1) if start else None)
                if not total < math.inf and not np.isfinite(array).all():
                    raise NotFinite(f"'{name}' has values that are not finite")
    if not total <= most**2:
        raise ReplyRefused(f"a change of the norm {total**0.5:.3g}, where {most:g} is the largest")


def _squared_norm(values: NDArray[np.number], start: NDArray[np.number] | None) -> float:
    """Return the squared L2 norm of values or of their change, in blocks that fit in the cache."""
    change = np.empty(min(BLOCK, values.size), np.promote_types(values.dtype, np.float32))
    total = 0.0
    for first in range(0, values.size, BLOCK):
        part = values[first : first + BLOCK]
        moved = np.subtract(part, 0 if start is None else start[first : first + BLOCK], out=change[: part.size])
        total += float(np.dot(moved, moved))
    return total

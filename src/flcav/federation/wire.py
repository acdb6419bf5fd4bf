"""The wire format: records of Flower's messages, encoded updates, and the order of replies.

Weights and updates (NumPy) become the array records of a message and back. An update is sent whole or in the form of
`Upload`, clipped and with noise where clients add it. `list_events` orders the replies to requests.
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from itertools import chain

import numpy as np
from flwr.app import Array, ArrayRecord, ConfigRecord, Error, Message, MetricRecord, RecordDict
from flwr.common.constant import SType
from flwr.common.serde import recorddict_from_proto, recorddict_to_proto
from flwr.proto.recorddict_pb2 import RecordDict as ProtoRecordDict
from numpy.typing import NDArray

from flcav.config import shorten
from flcav.federation.privacy import add_noise, clip_change
from flcav.federation.rules import Rules
from flcav.federation.trainable import Arrays, Forms, LocalUpdate, Update, Weights, forms_of, learned_names
from flcav.federation.upload import VALUES, apply_change, compress, compressed_forms, decompress, find_change
from flcav.statistics.streams import derive_seed

ARRAYS, CONFIG, METRICS = "arrays", "config", "metrics"  # records of a message, by key
EXTRA = "extra"  # arrays that a strategy exchanges in addition to the weights
CENTRE = "centre"  # centre of the proximal term, where it is not the round's initial model
ASK = "ask"  # record and its entry: the kind of the request, where it is not the update after training
VECTOR = "#masked"  # the one array of an update under secure aggregation
NORM, SEND = "norm", "send"  # requests for the norm of the update after training, and for that update
COUNT = "count"  # request for the number of samples before training
LOST = "lost"  # record of a request whose answer will not arrive
GRANT, GRANTED = "grant", "bytes"  # record of a request and its entry: most bytes of the answer
OVER_BUDGET = 101  # error code in place of an answer beyond the grant
CLIENT_APP_RAISED = 2  # Flower's error code of an exception in a client app
LOST_BY_NETWORK = 100  # error code in place of an answer that does not arrive; Flower's codes are below 100
KEYS, SHARES, MASKED, UNMASK = "keys", "shares", "masked", "unmask"  # requests of secure aggregation, in this order
NAMES, CIPHERS, MASKS = "names", "ciphers", "masks"  # entries of its messages; that of shares is `SHARES`
CERTIFICATES, SIGNATURES = "certificates", "signatures"  # entries next to the keys, of certified clients
SAMPLES, LOSS = "num-examples", "loss"  # entries of the metrics
ANSWER_S = 3600.0  # timeout of answers from remote nodes [s]

NUMBERS = {  # types of arrays in messages, by name
    str(np.dtype(code)): np.dtype(code) for code in (*np.typecodes["AllInteger"], *np.typecodes["AllFloat"], "?")
}


class NoCount(ValueError):
    """A number of samples that does not fit in a message."""


@dataclass(frozen=True)
class LocalWork:
    """The local training of every client in one round."""

    round: int  # 1-based within its federation
    steps: int  # local optimiser steps
    learning_rate: float
    seed: int  # of the round; every client derives its seed from this and its name

    def record(self) -> ConfigRecord:
        """Return the work as the config record of a Flower message."""
        return ConfigRecord(dict(vars(self)))

    @classmethod
    def from_record(cls, config: ConfigRecord) -> "LocalWork":
        """Return the work in a config record: the inverse of `record`. Raises KeyError where a field is missing."""
        return cls(**{name: config[name] for name in cls.__dataclass_fields__})  # type: ignore[arg-type]


def to_array_record(weights: Weights) -> ArrayRecord:
    """Return weights as a Flower array record, in the same order."""
    record = ArrayRecord()
    for name, value in weights.items():
        record[name] = _to_array(np.asarray(value, order="C"))
    return record


def to_weights(arrays: ArrayRecord) -> dict[str, np.ndarray]:
    """Return the arrays of a Flower record as weights, in the same order; raises as `to_numpy`."""
    return {name: to_numpy(array) for name, array in arrays.items()}


def _to_array(value: NDArray[np.number]) -> Array:
    """Return a C-ordered array as a Flower array in NumPy's file format, copied once where Flower copies twice."""
    data = b"".join((_header(value.shape, value.dtype, fortran_order=False), value.data))
    return Array(dtype=type_name(value.dtype), shape=value.shape, stype=SType.NUMPY, data=data)


@lru_cache(maxsize=256)
def type_name(dtype: np.dtype) -> str:
    """Return the name of a dtype in messages."""
    return str(dtype)


@lru_cache(maxsize=4096)
def _header(shape: tuple[int, ...], dtype: np.dtype, fortran_order: bool) -> bytes:
    """Return the header of an array in version 1.0 of NumPy's file format."""
    head = BytesIO()
    descr = np.lib.format.dtype_to_descr(dtype)
    about = {"shape": shape, "fortran_order": fortran_order, "descr": descr}
    np.lib.format.write_array_header_1_0(head, about)
    return head.getvalue()


def to_numpy(array: Array) -> np.ndarray:
    """Return the numbers of a Flower array from any sender: what `array.numpy()` does, for arrays of numbers.

    The header of NumPy's file format is not parsed but compared with that of the declared shape and dtype, whose size
    must be that of the data: a sender cannot make the receiver allocate more than it sent. Raises TypeError for another
    format, ValueError where header, declaration and data disagree.
    """
    if array.stype != SType.NUMPY:
        raise TypeError(f"'{array.stype}' is no format of arrays")
    shape = tuple(array.shape)
    dtype = NUMBERS.get(array.dtype)
    data = array.data
    if dtype is None:
        raise ValueError(f"{shorten(array.dtype)} is no type of numbers")
    start = 10 + int.from_bytes(data[8:10], "little")  # of the numbers
    for fortran_order in (False, True):
        known = _header(shape, dtype, fortran_order)
        if data[:8] == known[:8] and data[10:start].rstrip() == known[10:].rstrip():  # any padding by spaces
            break
    else:
        raise ValueError(f"its header is not that of {dtype} {shape}")
    if len(data) - start != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"it has {len(data) - start} bytes instead of those of {dtype} {shape}")
    return np.frombuffer(data, dtype, offset=start).reshape(shape, order="F" if fortran_order else "C").copy()


def read_arrays(content: RecordDict, key: str) -> dict[str, np.ndarray]:
    """Return the weights in a record of a message or a state.

    Raises KeyError where the record is missing, TypeError where it holds no arrays, and as `to_numpy`. The property
    `content.array_records` would leave a reference cycle, which keeps the arrays in memory until garbage collection.
    """
    record = content[key]
    if not isinstance(record, ArrayRecord):
        raise TypeError(f"'{key}' holds no arrays")
    return to_weights(record)


def reply(message: Message, update: Update, extra: Weights) -> Message:
    """Return the reply to a training message: the weights, a strategy's `extra` arrays, samples and loss.

    Without extra arrays there is no record of them. Raises as `to_metrics`.
    """
    return Message(update_content(update, extra), reply_to=message)


def update_content(update: Update, extra: Weights) -> RecordDict:
    """Return the records of `reply`."""
    records = {ARRAYS: to_array_record(update.weights)} | ({EXTRA: to_array_record(extra)} if extra else {})
    return RecordDict({**records, METRICS: to_metrics(update)})


def to_metrics(update: Update) -> MetricRecord:
    """Return samples and loss of an update as metrics; raises `NoCount` for a number that does not fit in a message."""
    return MetricRecord({SAMPLES: _count(update.samples), LOSS: float(update.loss)})


def reply_norm(message: Message, norm: float, samples: int) -> Message:
    """Return the reply to a request for an update's norm: the norm and the number of samples, as metrics.

    Before training, where only the number is asked for, the norm is 0. Raises as `to_metrics`.
    """
    metrics = MetricRecord({NORM: float(norm), SAMPLES: _count(samples)})
    return Message(RecordDict({METRICS: metrics}), reply_to=message)


def _count(samples: float) -> int:
    """Return a number of samples as a plain integer."""
    try:
        whole = int(samples)
    except (TypeError, ValueError, OverflowError):  # no number, or none that is finite
        whole = -1
    if whole != samples or abs(whole) >= 2**63:
        raise NoCount(f"{shorten(samples)} samples, and a whole number below 2^63 is wanted")
    return whole


def refuse_request(message: Message, reason: str) -> Message:
    """Return a client's error reply, with the reason."""
    return Message(Error(CLIENT_APP_RAISED, reason), reply_to=message)


def is_changed(rules: Rules) -> bool:
    """Return whether messages carry changes of weights rather than weights."""
    return rules.upload.compression != "none" or is_local(rules)


def encode_update(
    update: Update, start: Weights, rules: Rules, residual: Weights, seed: int, key: bytes | None = None
) -> tuple[LocalUpdate, Arrays]:
    """Return an encoded update, and the residual that the client keeps for the next round.

    start: weights at the start of the round. residual: kept in the last round. seed: of stochastic rounding. seed or
    key: of local noise, see `add_noise`. Under local privacy the number of samples, the loss and all arrays that are
    not learned stay with the client.
    """
    upload = rules.upload
    weights = update.weights
    names, learned = upload.exchanged(start), set(learned_names(start))
    if not is_changed(rules):
        return LocalUpdate({name: weights[name] for name in names}, update.samples, update.loss), {}
    change = _protect(find_change(weights, start, [name for name in names if name in learned]), rules, seed, key)
    sent, kept = compress(upload, change, residual.get(VALUES), derive_seed(seed, "rounding"))
    if is_local(rules):
        return LocalUpdate(sent, 1, 0.0), kept
    rest = {name: weights[name] for name in names if name not in learned}
    return LocalUpdate({**sent, **rest}, update.samples, update.loss), kept


def sent_forms(start: Weights, rules: Rules) -> Forms:
    """Return shape and dtype of every array that `encode_update` sends."""
    names, learned = rules.upload.exchanged(start), set(learned_names(start))
    whole = forms_of({name: start[name] for name in names})
    if not is_changed(rules):
        return whole
    change = compressed_forms(rules.upload, {name: start[name] for name in names if name in learned})
    return {**change, **({} if is_local(rules) else {name: whole[name] for name in names if name not in learned})}


def decode_update(sent: Weights, start: Weights, rules: Rules) -> Weights:
    """Return a client's weights after its local training; arrays that it did not send are those of `start`.

    `sent` has the forms of `sent_forms`. Raises ValueError where it is no output of `encode_update`.
    """
    names, learned = rules.upload.exchanged(start), set(learned_names(start))
    if not is_changed(rules):
        return {name: sent.get(name, array) for name, array in start.items()}
    like = {name: start[name] for name in names if name in learned}
    weights = apply_change(start, decompress(rules.upload, sent, like))
    rest = () if is_local(rules) else [name for name in names if name not in learned]
    return weights | {name: sent[name] for name in rest}


def flatten_change(
    update: Update, start: Weights, rules: Rules, seed: int, key: bytes | None = None
) -> NDArray[np.float64]:
    """Return the change of all floating arrays that are sent, concatenated (coordinates,).

    Under local privacy these are the learned ones, clipped and with noise; `seed` and `key` are as in `encode_update`.
    """
    change = _protect(find_change(update.weights, start, _floating(start, rules)), rules, seed, key)
    return np.concatenate([np.ravel(array).astype(np.float64) for array in change.values()])


def count_coordinates(start: Weights, rules: Rules) -> int:
    """Return the length of the vector of `flatten_change`."""
    return sum(start[name].size for name in _floating(start, rules))


def unflatten(change: NDArray[np.float64], start: Weights, rules: Rules) -> Weights:
    """Return `start` plus a change (coordinates,) of its floating arrays: the inverse of `flatten_change`."""
    names = _floating(start, rules)
    parts = np.split(change, np.cumsum([start[name].size for name in names])[:-1])
    return apply_change(start, {name: part.reshape(start[name].shape) for name, part in zip(names, parts, strict=True)})


def _floating(start: Weights, rules: Rules) -> list[str]:
    names = rules.upload.exchanged(start)
    if is_local(rules):
        learned = {*learned_names(start)}
        return [name for name in names if name in learned]
    return [name for name in names if np.issubdtype(start[name].dtype, np.floating)]


def _protect(change: Arrays, rules: Rules, seed: int, key: bytes | None) -> Arrays:
    """Return a change of learned arrays, clipped and with noise under local privacy."""
    privacy = rules.privacy
    if privacy is None or not is_local(rules):
        return change
    noisy = add_noise(clip_change(change, privacy.clip), privacy, seed, key)
    return {name: array.astype(change[name].dtype) for name, array in noisy.items()}


def is_local(rules: Rules) -> bool:
    """Return whether clients add the noise; arrays that are not learned then stay with them."""
    return rules.privacy is not None and rules.privacy.local


@dataclass(frozen=True)
class Arrived:
    """A client's reply."""

    client: str
    content: RecordDict


@dataclass(frozen=True)
class Lost:
    """A client that failed, or was lost by the network."""

    client: str
    reason: str
    by_network: bool


@dataclass(frozen=True)
class TimedOut:
    """A client without an answer in time."""

    client: str


Event = Arrived | Lost | TimedOut


def list_events(awaited: Iterable[str], replies: Iterable[Message], names: Mapping[int, str]) -> Iterator[Event]:
    """Yield the outcome for every awaited client in the given order, so that results do not depend on who is faster.

    A reply whose turn it is is yielded at once and not kept. `names` are the clients' names by node.
    """
    nodes = {name: node for node, name in names.items()}
    left = deque(nodes[name] for name in awaited)
    early = dict[int, Message]()
    # the final None stands for the end of replies: whoever is still awaited has timed out
    for message in chain(replies, [None]):
        if message is not None:
            early[message.metadata.src_node_id] = message
        while left and (message is None or left[0] in early):
            node = left.popleft()
            found = early.pop(node, None)
            client = names[node]
            if found is None:
                yield TimedOut(client)
            elif found.has_error():
                yield Lost(client, str(found.error.reason), found.error.code == LOST_BY_NETWORK)
            else:
                yield Arrived(client, found.content)


def pack_records(content: RecordDict) -> bytes:
    """Return a message's records as Flower serialises them."""
    return recorddict_to_proto(content).SerializeToString(deterministic=True)


def unpack_records(data: bytes) -> RecordDict:
    """Return the records that `pack_records` serialised."""
    return recorddict_from_proto(ProtoRecordDict.FromString(data))

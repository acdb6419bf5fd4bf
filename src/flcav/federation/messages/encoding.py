"""A client's update as the arrays of its message, and back: named layers, clipping, local noise, compression."""

import numpy as np
from numpy.typing import NDArray

from flcav.federation.privacy import add_noise, clip_change
from flcav.federation.rules import Rules
from flcav.federation.trainable import Forms, LocalUpdate, Update, Weights, forms_of, learned_names
from flcav.federation.upload import VALUES, Arrays, add, compress, compressed_forms, decompress, subtract
from flcav.statistics.streams import derive_seed


def is_changed(rules: Rules) -> bool:
    """Return whether the arrays of a message are changes of weights; otherwise they are weights."""
    return rules.upload.compression != "none" or is_local(rules)


def encode(
    update: Update, start: Weights, rules: Rules, residual: Weights, seed: int, key: bytes | None = None
) -> tuple[LocalUpdate, Arrays]:
    """Return an update as it is sent, and what the client keeps for the next round.

    `start` are the weights that the round began with, `residual` is what was kept in the last one, `seed` that of
    rounding, and `seed` or `key` that of local noise, see `add_noise`. Under local privacy the number of samples, the
    loss and all that is not learned stay with the client.
    """
    upload, weights = rules.upload, update.weights
    names, learned = upload.exchanged(start), set(learned_names(start))
    if not is_changed(rules):
        return LocalUpdate({name: weights[name] for name in names}, update.samples, update.loss), {}
    change = _protect(subtract(weights, start, [name for name in names if name in learned]), rules, seed, key)
    sent, kept = compress(upload, change, residual.get(VALUES), derive_seed(seed, "rounding"))
    if is_local(rules):
        return LocalUpdate(sent, 1, 0.0), kept
    rest = {name: weights[name] for name in names if name not in learned}
    return LocalUpdate({**sent, **rest}, update.samples, update.loss), kept


def sent_forms(start: Weights, rules: Rules) -> Forms:
    """Return shape and type of each array of the message that `encode` makes."""
    names, learned = rules.upload.exchanged(start), set(learned_names(start))
    whole = forms_of({name: start[name] for name in names})
    if not is_changed(rules):
        return whole
    change = compressed_forms(rules.upload, {name: start[name] for name in names if name in learned})
    return {**change, **({} if is_local(rules) else {name: whole[name] for name in names if name not in learned})}


def decode(sent: Weights, start: Weights, rules: Rules) -> Weights:
    """Return the weights of a client after its local training, as far as its message tells; otherwise those of `start`.

    The arrays have the forms of `sent_forms`. Raises ValueError where they are not those of `encode`.
    """
    names, learned = rules.upload.exchanged(start), set(learned_names(start))
    if not is_changed(rules):
        return {name: sent.get(name, array) for name, array in start.items()}
    like = {name: start[name] for name in names if name in learned}
    weights = add(start, decompress(rules.upload, sent, like))
    rest = () if is_local(rules) else [name for name in names if name not in learned]
    return weights | {name: sent[name] for name in rest}


def flatten(update: Update, start: Weights, rules: Rules, seed: int, key: bytes | None = None) -> NDArray[np.float64]:
    """Return the change of all floating arrays that are sent, one after another (coordinates,).

    Under local privacy these are the learned ones, clipped and with noise; `seed` and `key` are as in `encode`.
    """
    change = _protect(subtract(update.weights, start, _floating(start, rules)), rules, seed, key)
    return np.concatenate([np.ravel(array).astype(np.float64) for array in change.values()])


def count_coordinates(start: Weights, rules: Rules) -> int:
    """Return the number of values of which `flatten` makes a vector."""
    return sum(start[name].size for name in _floating(start, rules))


def unflatten(change: NDArray[np.float64], start: Weights, rules: Rules) -> Weights:
    """Return the weights `start` with a change of their floating arrays added: the inverse of `flatten`."""
    names = _floating(start, rules)
    parts = np.split(change, np.cumsum([start[name].size for name in names])[:-1])
    return add(start, {name: part.reshape(start[name].shape) for name, part in zip(names, parts, strict=True)})


def _floating(start: Weights, rules: Rules) -> list[str]:
    names = rules.upload.exchanged(start)
    if is_local(rules):
        learned = {*learned_names(start)}
        return [name for name in names if name in learned]
    return [name for name in names if np.issubdtype(start[name].dtype, np.floating)]


def _protect(change: Arrays, rules: Rules, seed: int, key: bytes | None) -> Arrays:
    """Return a change of learned arrays clipped and with noise, where noise is the clients'; else as it is."""
    privacy = rules.privacy
    if privacy is None or not is_local(rules):
        return change
    noisy = add_noise(clip_change(change, privacy.clip), privacy, seed, key)
    return {name: array.astype(change[name].dtype) for name, array in noisy.items()}


def is_local(rules: Rules) -> bool:
    """Return whether each client adds noise to its own update; all that is not learned then stays with it."""
    return rules.privacy is not None and rules.privacy.local

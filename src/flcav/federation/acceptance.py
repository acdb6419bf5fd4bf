"""Acceptance of an update: what the server refuses, which a client finds in the same way before it sends."""

from dataclasses import replace

import numpy as np

from flcav.federation.encoding import decode
from flcav.federation.rules import Rules
from flcav.federation.trainable import LocalUpdate, Weights


class UpdateRefused(ValueError):
    """An update that is no update of the round, or whose values are not finite."""


def read_update(sent: LocalUpdate, start: Weights, rules: Rules, extra: Weights) -> LocalUpdate:
    """Return an update as it was sent with the client's weights for its arrays.

    `start` are the weights that the round began with, `extra` has the names, shapes and types of the arrays beside the
    update. Raises `UpdateRefused` where the update cannot be used.
    """
    try:
        update = replace(sent, weights=decode(sent.weights, start, rules))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise UpdateRefused(f"a message that is no update ({error})") from None
    if (fault := find_fault(update, start, extra)) is not None:
        raise UpdateRefused(fault)
    return update


def is_usable(sent: LocalUpdate, start: Weights, rules: Rules) -> bool:
    """Return whether the server accepts an update that it gets; arguments as those of `read_update`."""
    try:
        read_update(sent, start, rules, sent.extra)
    except UpdateRefused:
        return False
    return True


def find_fault(update: LocalUpdate, start: Weights, extra: Weights) -> str | None:
    """Return what makes an update unusable, None for a usable one.

    `start` has the names, shapes and types that the weights must have, `extra` those of the arrays beside them.
    """
    for arrays, like in ((update.weights, start), (update.extra, extra)):
        if set(arrays) != set(like):
            odd = sorted(set(arrays) ^ set(like))
            return f"an array '{odd[0]}' that is missing or unknown"
        for name, array in arrays.items():
            if (array.shape, array.dtype) != (like[name].shape, like[name].dtype):
                return f"'{name}' is {array.dtype} {array.shape} instead of {like[name].dtype} {like[name].shape}"
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                return f"'{name}' has values that are not finite"
    return find_fault_of_numbers(update)


def find_fault_of_numbers(update: LocalUpdate) -> str | None:
    """Return what makes an update unusable whatever its arrays are: no samples, or a loss that is not finite."""
    if update.samples < 1 or not np.isfinite(update.loss):
        return f"{update.samples} samples and a loss of {update.loss}"
    return None

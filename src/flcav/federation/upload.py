"""Compression of a client's update: a choice of layers, and their changes quantised or sparsified.

An update consists of arrays only, so that its bytes in the ledger are those of its serialised message.
"""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flcav.config import Config, InputError
from flcav.federation.trainable import Arrays, Forms, Weights, forms_of, learned_names

INDICES, VALUES, SCALES = "#indices", "#values", "#scales"  # arrays of a compressed change, unlike any parameter
LEVELS = 127  # levels of int8 on either side of 0


Patterns = tuple[Annotated[str, Field(min_length=1)], ...]  # shell patterns of names of arrays


def name_like(weights: Weights, patterns: Patterns) -> list[str]:
    """Return the names that match one of the patterns."""
    return [name for name in weights if any(fnmatchcase(name, pattern) for pattern in patterns)]


class Upload(Config):
    """Form of an update: `layers` named by patterns alone, and a `compression` of their change in the round.

    fp16: half precision. int8: a scale per array and stochastic rounding to 8 bits (Alistarh et al., NeurIPS 2017,
    with the largest magnitude for the norm). top-k: the `fraction` of the coordinates that changed most; what is left
    out is added to the change of the next round (Stich et al., NeurIPS 2018; Karimireddy et al., ICML 2019). Statistics
    of batch normalisation and integers are sent as they are.
    """

    layers: Patterns = ()  # as in `head.*`; default: all
    compression: Literal["none", "fp16", "int8", "top-k"] = "none"
    fraction: float = Field(default=0.01, gt=0, le=1)  # of top-k
    error_feedback: bool = True  # of top-k: what was left out is kept for the next round
    kept: Patterns = ()  # arrays that are not sent, whatever `layers` are; set by `Rules.of_servers`

    @model_validator(mode="after")
    def _fields_of_the_compression(self) -> Self:
        for name in ("fraction", "error_feedback"):
            if self.compression != "top-k" and getattr(self, name) != Upload.model_fields[name].default:
                raise ValueError(f"the compression {self.compression} takes no '{name}'")
        return self

    def check_layers(self, weights: Weights) -> None:
        """Raise `InputError` where a pattern matches no array, or all of them together no learned array."""
        for layer in self.layers:
            if not any(fnmatchcase(name, layer) for name in weights):
                raise InputError(
                    f"layers: '{layer}' matches none of {len(weights)} arrays, such as '{next(iter(weights))}'"
                )
        if not {*learned_names(weights)} & {*self.exchanged(weights)}:
            subject = f"layers {', '.join(self.layers)}: match" if self.layers else "a federation of weights with"
            raise InputError(f"{subject} no array that is learned")

    def exchanged(self, weights: Weights) -> list[str]:
        """Return the names of the arrays that are sent."""
        kept = set(name_like(weights, self.kept))
        return [name for name in (name_like(weights, self.layers) if self.layers else weights) if name not in kept]


def compress(upload: Upload, change: Weights, residual: NDArray[np.number] | None, seed: int) -> tuple[Arrays, Arrays]:
    """Return a compressed change of floating arrays, and the residual for the next round, under `VALUES`.

    residual: (coordinates,) left out so far by error feedback, None at first. seed: of stochastic rounding. The
    returned residual is empty unless top-k keeps one.
    """
    match upload.compression:
        case "fp16":
            limit = float(np.finfo(np.float16).max)
            sent = {
                name: np.where(np.isinf(array), array, np.clip(array, -limit, limit))  # infinite ones are to be refused
                for name, array in change.items()
            }
            return {name: array.astype(np.float16) for name, array in sent.items()}, {}
        case "int8":
            rng = np.random.default_rng(seed)
            sent = {}
            scales = []
            for name, array in change.items():
                scale = np.float32(np.abs(array).max(initial=0.0) / LEVELS)
                # floor(x + u) with u uniform in [0, 1) rounds stochastically, without bias
                with np.errstate(invalid="ignore"):  # a scale that is not finite is refused by the server
                    levels = array / (scale or 1.0) + rng.random(array.shape)
                    sent[name] = np.clip(np.floor(levels), -LEVELS, LEVELS).astype(np.int8)
                scales.append(scale)
            return {**sent, SCALES: np.array(scales, np.float32)}, {}
        case "top-k":
            flat = np.concatenate([np.ravel(array).astype(np.float32) for array in change.values()])
            if residual is not None:
                flat = flat + residual
            kept = _kept_coordinates(upload, flat.size)
            size = np.where(np.isnan(flat), np.inf, np.abs(flat))  # NaN is sent, so that the server refuses it
            # stable, so that equal magnitudes give the same choice on every machine
            indices = np.sort(np.argsort(-size, kind="stable")[:kept])
            sent = {INDICES: indices.astype(np.uint32), VALUES: flat[indices]}
            flat[indices] = 0.0
            return sent, {VALUES: flat} if upload.error_feedback else {}
        case _:
            return dict(change), {}


def _kept_coordinates(upload: Upload, size: int) -> int:
    return max(1, round(upload.fraction * size))


def compressed_forms(upload: Upload, like: Weights) -> Forms:
    """Return shape and dtype of every array that `compress` returns for a change of arrays `like` these."""
    match upload.compression:
        case "fp16":
            return {name: (array.shape, np.dtype(np.float16)) for name, array in like.items()}
        case "int8":
            levels = {name: (array.shape, np.dtype(np.int8)) for name, array in like.items()}
            return {**levels, SCALES: ((len(like),), np.dtype(np.float32))}
        case "top-k":
            kept = (_kept_coordinates(upload, sum(array.size for array in like.values())),)
            return {INDICES: (kept, np.dtype(np.uint32)), VALUES: (kept, np.dtype(np.float32))}
        case _:
            return forms_of(like)


def decompress(upload: Upload, sent: Weights, like: Weights) -> Arrays:
    """Return the change of floating arrays that `compress` encoded; `like` has their names, shapes and dtypes.

    `sent` has the forms of `compressed_forms`. Raises ValueError for coordinates of top-k that do not increase, or are
    out of range.
    """
    match upload.compression:
        case "int8":
            scales = dict(zip(like, sent[SCALES], strict=True))
            with np.errstate(invalid="ignore"):
                return {name: (sent[name] * scales[name]).astype(array.dtype) for name, array in like.items()}
        case "top-k":
            flat = np.zeros(sum(array.size for array in like.values()), np.float32)
            places = np.asarray(sent[INDICES], np.int64)
            if not (places[:-1] < places[1:]).all() or places[-1] >= flat.size:
                raise ValueError(f"coordinates that are not rising places below {flat.size}")
            flat[places] = sent[VALUES]
            ends = np.cumsum([array.size for array in like.values()])[:-1]
            parts = np.split(flat, ends)
            return {
                name: part.reshape(array.shape).astype(array.dtype)
                for part, (name, array) in zip(parts, like.items(), strict=True)
            }
        case _:
            return {name: sent[name].astype(array.dtype) for name, array in like.items()}


def find_change(weights: Weights, start: Weights, names: Sequence[str]) -> Arrays:
    """Return the change of the arrays `names` in a round, in the dtypes of `start`."""
    return {name: (weights[name].astype(np.float64) - start[name]).astype(start[name].dtype) for name in names}


def apply_change(start: Weights, change: Mapping[str, NDArray[np.number]]) -> Arrays:
    """Return the weights `start` plus a `change` of some of their arrays."""
    return {
        name: (array.astype(np.float64) + change[name]).astype(array.dtype) if name in change else np.asarray(array)
        for name, array in start.items()
    }

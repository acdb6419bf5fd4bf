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
LEVELS = {"int8": 127, "int4": 7}  # levels of a quantised change on either side of 0


Patterns = tuple[Annotated[str, Field(min_length=1)], ...]  # shell patterns of names of arrays


def name_like(weights: Weights, patterns: Patterns) -> list[str]:
    """Return the names that match one of the patterns."""
    return [name for name in weights if any(fnmatchcase(name, pattern) for pattern in patterns)]


class Upload(Config):
    """Form of an update: `layers` named by patterns alone, and a `compression` of their change in the round.

    fp16: half precision. int8, int4: a scale per array, and rounding to 8 or 4 bits (Alistarh et al., NeurIPS 2017,
    with the largest magnitude for the norm). top-k: the `fraction` of the coordinates that changed most. With
    `error_feedback` what is lost is added to the change of the next round (Stich et al., NeurIPS 2018; Karimireddy et
    al., ICML 2019), and rounding is to the nearest level, which loses no more than there is; without it, rounding is
    stochastic, and so without bias. Statistics of batch normalisation and integers are sent as they are.
    """

    layers: Patterns = ()  # as in `head.*`; default: all
    compression: Literal["none", "fp16", "int8", "int4", "top-k"] = "none"
    fraction: float = Field(default=0.01, gt=0, le=1)  # of top-k
    error_feedback: bool | None = None  # what was lost is kept for the next round; default: of top-k and int4
    kept: Patterns = ()  # arrays that are not sent, whatever `layers` are; set by `Rules.of_servers`

    @model_validator(mode="after")
    def _fields_of_the_compression(self) -> Self:
        if self.compression != "top-k" and self.fraction != Upload.model_fields["fraction"].default:
            raise ValueError(f"the compression {self.compression} takes no 'fraction'")
        if self.compression in ("none", "fp16") and self.error_feedback is False:
            raise ValueError(f"the compression {self.compression} takes no 'error_feedback'")
        return self

    @property
    def feeds_back(self) -> bool:
        """Return whether a client keeps what its update lost for the next round."""
        if self.error_feedback is None:
            return self.compression in ("int4", "top-k")
        return self.error_feedback and self.compression in ("int8", "int4", "top-k")

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
    returned residual is empty without error feedback.
    """
    match upload.compression:
        case "fp16":
            limit = float(np.finfo(np.float16).max)
            sent = {
                name: np.where(np.isinf(array), array, np.clip(array, -limit, limit))  # infinite ones are to be refused
                for name, array in change.items()
            }
            return {name: array.astype(np.float16) for name, array in sent.items()}, {}
        case "int8" | "int4":
            most = LEVELS[upload.compression]
            if residual is not None:
                change = _split(_flatten(change) + residual, change)
            rng = np.random.default_rng(seed)
            sent = {}
            scales = []
            for name, array in change.items():
                scale = np.float32(np.abs(array).max(initial=0.0) / most)
                with np.errstate(invalid="ignore"):  # a scale that is not finite is refused by the server
                    levels = array / (scale or 1.0)
                    # floor(x + u) with u uniform in [0, 1) rounds stochastically, without bias
                    rounded = np.rint(levels) if upload.feeds_back else np.floor(levels + rng.random(array.shape))
                    sent[name] = np.clip(rounded, -most, most).astype(np.int8)
                scales.append(scale)
            if upload.compression == "int4":
                sent = {name: _pack(levels) for name, levels in sent.items()}
            sent[SCALES] = np.array(scales, np.float32)
            if not upload.feeds_back:
                return sent, {}
            return sent, {VALUES: _flatten(change) - _flatten(decompress(upload, sent, change))}
        case "top-k":
            flat = _flatten(change)
            if residual is not None:
                flat = flat + residual
            kept = _kept_coordinates(upload, flat.size)
            size = np.where(np.isnan(flat), np.inf, np.abs(flat))  # NaN is sent, so that the server refuses it
            # stable, so that equal magnitudes give the same choice on every machine
            indices = np.sort(np.argsort(-size, kind="stable")[:kept])
            sent = {INDICES: indices.astype(np.uint32), VALUES: flat[indices]}
            flat[indices] = 0.0
            return sent, {VALUES: flat} if upload.feeds_back else {}
        case _:
            return dict(change), {}


def _flatten(change: Weights) -> NDArray[np.float32]:
    """Return the coordinates of all arrays of a change, in order."""
    return np.concatenate([np.ravel(array).astype(np.float32) for array in change.values()])


def _split(flat: NDArray[np.number], like: Weights) -> Arrays:
    """Return coordinates as arrays with the names, shapes and dtypes of `like`: the inverse of `_flatten`."""
    parts = np.split(flat, np.cumsum([array.size for array in like.values()])[:-1])
    return {
        name: part.reshape(array.shape).astype(array.dtype)
        for part, (name, array) in zip(parts, like.items(), strict=True)
    }


def _pack(levels: NDArray[np.number]) -> NDArray[np.number]:
    """Return levels from -7 to 7, in order, two in a byte: the first in its lower half."""
    halves = np.zeros(levels.size + levels.size % 2, np.uint8)
    halves[: levels.size] = (levels.ravel() + 8).astype(np.uint8)
    return halves[0::2] | halves[1::2] << 4


def _unpack(packed: NDArray[np.number], shape: tuple[int, ...]) -> NDArray[np.number]:
    """Return the levels that `_pack` packed."""
    both = packed.astype(np.uint8)
    halves = np.stack((both & 15, both >> 4), axis=1).ravel()
    return (halves[: int(np.prod(shape))].astype(np.int8) - np.int8(8)).reshape(shape)


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
        case "int4":
            halves = {name: (((array.size + 1) // 2,), np.dtype(np.uint8)) for name, array in like.items()}
            return {**halves, SCALES: ((len(like),), np.dtype(np.float32))}
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
        case "int8" | "int4":
            scales = dict(zip(like, sent[SCALES], strict=True))
            levels = {name: sent[name] for name in like}
            if upload.compression == "int4":
                levels = {name: _unpack(sent[name], array.shape) for name, array in like.items()}
            with np.errstate(invalid="ignore"):
                return {name: (levels[name] * scales[name]).astype(array.dtype) for name, array in like.items()}
        case "top-k":
            flat = np.zeros(sum(array.size for array in like.values()), np.float32)
            places = np.asarray(sent[INDICES], np.int64)
            if not (places[:-1] < places[1:]).all() or places[-1] >= flat.size:
                raise ValueError(f"coordinates that are not rising places below {flat.size}")
            flat[places] = sent[VALUES]
            return _split(flat, like)
        case _:
            return {name: sent[name].astype(array.dtype) for name, array in like.items()}


def encode_model(weights: Weights) -> Arrays:
    """Return a model in 8 bits: learned arrays of single precision, rounded to the nearest level, and their scales.

    `SCALES` has an entry for each array, NaN for those that are as they were.
    """
    single = {name: weights[name] for name in learned_names(weights) if weights[name].dtype == np.float32}
    if not single:
        return dict(weights)
    sent, _ = compress(Upload(compression="int8", error_feedback=True), single, None, 0)
    scale_of = dict(zip(single, sent[SCALES], strict=True))
    scales = np.array([scale_of.get(name, np.nan) for name in weights], np.float32)
    return {**{name: sent.get(name, array) for name, array in weights.items()}, SCALES: scales}


def decode_model(sent: Weights) -> Arrays:
    """Return the model that `encode_model` encoded, in single precision; one that is sent whole as it is."""
    if SCALES not in sent:
        return dict(sent)
    arrays = {name: array for name, array in sent.items() if name != SCALES}
    return {
        name: array if np.isnan(scale) else array * scale
        for (name, array), scale in zip(arrays.items(), sent[SCALES], strict=True)
    }


def restore_model(weights: Weights, start: Weights, whole: Weights) -> Arrays:
    """Return `whole` plus the change from `start`, which clients got in place of it, to `weights`."""
    lost = [name for name in whole if not np.array_equal(start[name], whole[name])]
    return {**weights, **apply_change({name: whole[name] for name in lost}, find_change(weights, start, lost))}


def find_change(weights: Weights, start: Weights, names: Sequence[str]) -> Arrays:
    """Return the change of the arrays `names` in a round, in the dtypes of `start`."""
    return {name: (weights[name].astype(np.float64) - start[name]).astype(start[name].dtype) for name in names}


def apply_change(start: Weights, change: Mapping[str, NDArray[np.number]]) -> Arrays:
    """Return the weights `start` plus a `change` of some of their arrays."""
    return {
        name: (array.astype(np.float64) + change[name]).astype(array.dtype) if name in change else np.asarray(array)
        for name, array in start.items()
    }

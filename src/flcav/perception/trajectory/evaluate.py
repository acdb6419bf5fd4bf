"""How near predictions come to where road users went, beside keeping heading and speed."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.perception.trajectory.predict import single
from flcav.perception.trajectory.tracks import constant_velocity

Array = NDArray[np.float64]

MISS_M = 2.0  # a last position farther off than this is a miss
RATIOS = ("1", "K", "single")  # of final errors to constant velocity's
TURN = np.radians(20.0)  # between heading at present and from the last second's displacement


def metrics(paths: Array, probabilities: Array, columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the numbers of all samples, of those at junctions, and of those that turn there.

    `paths` (N, K, FUTURE, 2) and `probabilities` (N, K) belong to the samples whose `columns` are given. A slice
    without samples is None.
    """
    future, past = columns["future"].astype(np.float64), columns["past"]
    at_junction = columns["at_junction"].astype(np.bool_)
    slices = {
        "all": np.ones(len(future), np.bool_),
        "at junctions": at_junction,
        "turning at junctions": at_junction & turning(future),
    }
    errors = errors_of(paths, probabilities, future, constant_velocity(past))
    return {
        "modes": paths.shape[1],
        "miss_m": MISS_M,
        "scenes": len(np.unique(columns["scene"])),
        "slices": {name: _numbers({key: e[rows] for key, e in errors.items()}) for name, rows in slices.items()},
    }


def turning(future: Array) -> NDArray[np.bool_]:
    """Return (N,) whether the displacement of the last second points more than 20 degrees away from x."""
    last = future[:, -1] - future[:, -5]
    return (np.abs(np.arctan2(last[:, 1], last[:, 0])) > TURN) & (np.linalg.norm(last, axis=1) > 1.0)


def errors_of(paths: Array, probabilities: Array, future: Array, baseline: Array) -> dict[str, Array]:
    """Return (N,) errors [m] by name: average and final, of the likeliest and the best mode, `single`, the baseline."""
    off = np.linalg.norm(paths - future[:, None], axis=3)  # (N, K, FUTURE)
    everyone = np.arange(len(off))
    likeliest, only = off[everyone, probabilities.argmax(axis=1)], off[everyone, single(paths, probabilities)]
    plain = np.linalg.norm(baseline - future, axis=2)
    return {
        "minADE_1": likeliest.mean(axis=1),
        "minFDE_1": likeliest[:, -1],
        "minADE_K": off.mean(axis=2).min(axis=1),
        "minFDE_K": off[..., -1].min(axis=1),
        "single_ADE": only.mean(axis=1),
        "single_FDE": only[:, -1],
        "constant_velocity_ADE": plain.mean(axis=1),
        "constant_velocity_FDE": plain[:, -1],
    }


def _numbers(errors: Mapping[str, Array]) -> dict[str, Any] | None:
    count = len(errors["minFDE_1"])
    if not count:
        return None
    means = {name: float(error.mean()) for name, error in errors.items()}
    finals = {"1": "minFDE_1", "K": "minFDE_K", "single": "single_FDE", "constant_velocity": "constant_velocity_FDE"}
    misses = {f"miss_rate_{key}": float((errors[name] > MISS_M).mean()) for key, name in finals.items()}
    plain = means["constant_velocity_FDE"]
    return {
        "samples": count,
        **means,
        **misses,
        **{f"ratio_{key}": means[name] / plain if plain else None for key, name in finals.items() if key in RATIOS},
    }

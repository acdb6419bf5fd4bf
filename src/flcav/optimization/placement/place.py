"""Placement of roadside sensors by VRCSP: a number of sensors, a budget, or a share of the errors to cover."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from flcav.config import InputError, shorten
from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.instance import find_covered
from flcav.optimization.placement.solve import Method, Placement, find_candidates, place_budget, place_count
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.line_of_sight import find_visible_pairs
from flcav.world.map.town import Town, load_town
from flcav.world.sites import MOUNT_M
from flcav.world.trace import Trace

FAR = 10  # times the size of a town: errors beyond are on no map of it


def place(
    errors: ArrayLike,
    poles: ArrayLike,
    range_m: float | Sequence[float],
    count: int | None = None,
    *,
    budget: float | None = None,
    cover: float | None = None,
    sensor_cost: ArrayLike | None = None,
    pole_cost: ArrayLike | None = None,
    town: Town | str | None = None,
    traces: Sequence[Trace] = (),
    weight: ArrayLike | None = None,
    method: Method = "exact",
) -> Placement:
    """Return the sensors on poles (P, 3), at most one per pole, that cover most of the errors' (E, 3) weight (E,).

    Exactly one limit is given: `count`, `budget` or `cover`. With `count`, ties go to earlier poles. Raises
    `InputError` where positions, weights, ranges, costs or the method are invalid, or not exactly one limit is given.

    Args:
        errors: (E, 3) positions of errors [m, world], or (E, 2) on the ground of `town`.
        poles: (P, 3) positions where a sensor may stand [m, world], or (P, 2) for mounts
            `MOUNT_M` above the ground of `town`.
        range_m: range of the sensors, or of each of the S kinds of sensors [m].
        count: number of sensors.
        budget: largest cost of the sensors and their poles.
        cover: share of the weight, 0 to 1, that is covered for the least cost.
        sensor_cost: (S,) cost of a sensor of each kind; None: 0.
        pole_cost: (P,) cost of using a pole; None: 0.
        town: town, or its name, whose buildings hide errors from poles; None: nothing occludes.
        traces: traffic of the town that occludes, too.
        weight: (E,) weight of each error; None: 1.
        method: "exact", a mixed-integer program, or "greedy".

    >>> from flcav import place
    >>> placed = place([[0, 0, 1], [5, 0, 1], [90, 0, 1]], poles=[[0, 9, 3], [90, 9, 3]], range_m=40, count=1)
    >>> placed.chosen, placed.covered, placed.optimal
    ((0,), 2, True)
    >>> kinds = place([[0, 0, 1], [90, 0, 1]], [[0, 9, 3]], range_m=[40, 120], sensor_cost=[1, 5], budget=5)
    >>> kinds.sensors, kinds.covered, kinds.cost  # the kind on each chosen pole
    ((1,), 2, 5.0)
    """
    limits = {"count": count, "budget": budget, "cover": cover}
    given = [name for name, value in limits.items() if value is not None]
    if len(given) != 1:
        raise InputError(f"one of count, budget and cover is wanted, not {' and '.join(given) or 'none'}")
    if budget is not None and sensor_cost is None and pole_cost is None:
        raise InputError("budget: nothing has a cost; give sensor_cost or pole_cost")
    if traces and town is None:
        raise InputError("traces: traffic is in the way where the town is given alone")
    if count is not None and not isinstance(count, int | np.integer):
        raise InputError(f"count = {shorten(count)}: must be a whole number")
    try:
        ranges = np.atleast_1d(np.asarray(range_m, dtype=np.float64))
        sensor_cost = None if sensor_cost is None else np.atleast_1d(np.asarray(sensor_cost, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"range_m, sensor_cost: numbers are wanted, or lists of them ({error})") from None
    stands = load_town(town) if isinstance(town, str) else town
    if stands is not None:
        errors, poles = _lift(errors, stands, 0.0), _lift(poles, stands, MOUNT_M)
    list_candidates = partial(
        find_candidates, errors, poles, ranges, weight=weight, pole_cost=pole_cost, sensor_cost=sensor_cost
    )
    candidates = list_candidates()
    if stands is not None:
        places, sites = np.asarray(errors, dtype=np.float64), np.asarray(poles, dtype=np.float64)
        check_inside(stands, places, sites)
        candidates = list_candidates(visible=find_seen(places, sites, float(ranges.max()), stands, traces))
    if count is not None:
        return place_count(candidates, count, method=method)
    if budget is not None:
        return place_budget(candidates, budget, method=method)
    assert cover is not None
    return cover_share(candidates, cover, method=method)[0]


def _lift(points: ArrayLike, town: Town, above_m: float) -> ArrayLike:
    """Return points (N, 2) with their heights, `above_m` above the ground of a town; others as they are."""
    try:
        flat = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError):
        return points
    if flat.ndim != 2 or flat.shape[1] != 2:
        return points
    return np.column_stack((flat, town.grounds(flat[:, 0], flat[:, 1]) + above_m))


def check_inside(
    town: Town,
    errors: NDArray[np.float64],
    poles: NDArray[np.float64],
    names: tuple[Path | str, Path | str] = ("errors", "poles"),
    degrees: tuple[NDArray[np.float64] | None, NDArray[np.float64] | None] = (None, None),
) -> None:
    """Raise `InputError` for a pole (P, 3) outside the town, or an error (E, 3) far beyond its map [m, world frame].

    `names` are those of the two tables, for the message; `degrees` (P, 2) or (E, 2) their latitudes and longitudes, by
    which the message names the places where they are given.
    """
    low, high = np.array(town.bounds).reshape(2, 2)
    reach_m = FAR * float((high - low).max())
    far = np.flatnonzero((np.abs(errors[:, :2] - (low + high) / 2) > reach_m).any(axis=1))
    out = np.flatnonzero(((poles[:, :2] < low) | (poles[:, :2] > high)).any(axis=1))
    tables = zip(names, (far, out), (errors, poles), ("far from", "outside"), degrees, strict=True)
    for name, rows, places, where, geodetic in tables:
        if not len(rows):
            continue
        span, digits, first, second = np.stack((low, high)), 1, "x", "y"
        if geodetic is not None:
            span = convert_to_geodetic(town.geo, np.column_stack((span, (0.0, 0.0))))
            digits, first, second = 5, "latitude", "longitude"
        (a, c), (b, d) = np.sort(span[:, :2], axis=0).round(digits).tolist()
        one, other = (places if geodetic is None else geodetic)[rows[0], :2].round(digits).tolist()
        names = ("", "") if geodetic is None else (f"{first} ", f"{second} ")
        told = f"lies at {names[0]}{one:.10g}, {names[1]}{other:.10g}"
        told += f", {where} {town.name} ({first} {a:.10g} to {b:.10g}, {second} {c:.10g} to {d:.10g})"
        if geodetic is not None and a <= other <= b and c <= one <= d:
            told += "; are latitude and longitude in each other's columns?"
        elif len(rows) > 1:
            told += f"; so do {len(rows)} of {len(places)} rows"
        raise InputError(f"{name}: row {rows[0] + 1} {told}")


def find_seen(
    errors: NDArray[np.float64], poles: NDArray[np.float64], range_m: float, town: Town, traces: Sequence[Trace]
) -> csr_array:
    """Return (P, E) 1.0 where a pole sees an error within `range_m` [m], past buildings and traffic (world frame)."""
    visible = find_covered(errors, poles, [range_m])
    pole = np.repeat(np.arange(len(poles)), np.diff(visible.indptr))
    error = visible.indices.astype(np.int64)
    seen = find_visible_pairs(town, traces, poles, errors, (pole, error))
    return csr_array((seen.astype(np.float64), visible.indices, visible.indptr), shape=visible.shape)

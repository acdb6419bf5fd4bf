"""A town with errors in it, and what sensors at any of its places see, cover and cost.

Coverage is that of `flcav place --line-of-sight`: within the range in three dimensions, and past what the town and its
recorded traffic have in the way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from contourpy import contour_generator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array, vstack

from flcav.arrays import Array
from flcav.config import InputError, Json
from flcav.geometry import Boxes
from flcav.optimization.placement.cheapest import cover_share
from flcav.optimization.placement.instance import find_covered
from flcav.optimization.placement.place import find_seen
from flcav.optimization.placement.solve import Candidates, Placement, find_candidates, place_budget, place_count
from flcav.planner.inputs import Given, Sites
from flcav.world.line_of_sight import find_viewshed
from flcav.world.map.town import Town
from flcav.world.sites import MOUNT_M, Located, draw_sites, list_street_names, locate_sites
from flcav.world.trace import Trace

SMOOTH = 1.0  # standard deviation of the smoothing of a viewshed's outline, in its cells
WAYS = 12  # most steps of a curve of coverage
NEW_EVERY_M = 20.0  # distance between the places at which a new pole is tried
NEW_SHOWN = 3  # of them that are told
CELL_M, MOST_CELLS = 5.0, 120  # of the grid of a relief's heights, and most of them in a row


@dataclass(frozen=True, eq=False)
class Workspace:
    """A town with its traffic, candidate sites, and errors, if there are any."""

    town: Town
    traces: tuple[Trace, ...]
    sites: Sites
    given: Given | None = None
    name: str = ""  # of the table of errors
    typed: str = ""  # arguments with which `flcav place` reads the same

    @property
    def errors(self) -> Array:
        """Return (E, 3) the errors [m, world]."""
        return np.zeros((0, 3)) if self.given is None else self.given.errors


@dataclass(frozen=True)
class Kinds:
    """The S kinds of sensors that may be mounted."""

    names: tuple[str, ...]
    ranges_m: tuple[float, ...]
    costs: tuple[float, ...]


@dataclass(frozen=True)
class Question:
    """The question that a placement answers: kinds of sensors, own sites beside the poles, the errors that count."""

    kinds: Kinds
    own: tuple[tuple[float, float], ...] = ()  # x, y [m] of sites of one's own, after the poles
    line_of_sight: bool = True
    without: frozenset[str] = frozenset()  # classes and kinds of errors that are left out


def look(
    space: Workspace, at: tuple[float, float, float], range_m: float, line_of_sight: bool
) -> tuple[str, list[int]]:
    """Return what a sensor sees: its visible area as an SVG path [m], and the rows of the errors that it covers.

    `at` is the mount [m, world]. Without `line_of_sight` the area is empty: it is the range's circle.
    """
    site = np.array([at])
    if not line_of_sight:
        return "", find_covered(space.errors, site, [range_m]).indices.tolist() if len(space.errors) else []
    seen = find_viewshed(space.town, space.traces, site[0], range_m)
    smooth = gaussian_filter(seen.seen.astype(np.float64), SMOOTH)
    lines = contour_generator(seen.x, seen.y, smooth).lines(0.5)
    area = "".join(_as_path(np.asarray(line)) for line in lines)
    if not len(space.errors):
        return area, []
    row = find_seen(space.errors, site, range_m, space.town, space.traces)
    return area, np.sort(row.indices[row.data > 0]).tolist()


def _as_path(line: Array) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line.tolist()) + "Z"


def mount(space: Workspace, own: Sequence[tuple[float, float]]) -> Array:
    """Return the mounts (N, 3) [m, world] of own sites x, y: `MOUNT_M` above the ground."""
    flat = np.array(own, dtype=np.float64).reshape(-1, 2)
    return np.column_stack((flat, space.town.grounds(flat[:, 0], flat[:, 1]) + MOUNT_M))


def select_errors(given: Given, without: frozenset[str]) -> NDArray[np.bool_]:
    """Return the mask (E,) of the errors whose class and kind are not left out."""
    out = np.isin(given.kind, [*without])
    labels = given.column("class")
    return ~(out | np.isin(np.array(labels, dtype=np.str_), [*without])) if labels else ~out


def collect_candidates(space: Workspace, question: Question) -> tuple[Candidates, Given]:
    """Return the candidates of a question, and the errors, poles and kinds that it is about.

    Raises `InputError` where there are no errors, or none that counts.
    """
    if space.given is None:
        raise InputError("there are no errors: give a table of them, by --errors or by dropping it on the page")
    kept = select_errors(space.given, question.without)
    if not kept.any():
        raise InputError("every error is left out by the filters")
    kinds, sites = question.kinds, mount(space, question.own)
    given = replace(
        space.given,
        errors=space.given.errors[kept],
        weight=space.given.weight[kept],
        kind=space.given.kind[kept],
        ids=(*space.sites.ids, *(f"own {number}" for number in range(1, len(sites) + 1))),
        poles=np.concatenate((space.sites.xyz, sites)),
        pole_cost=np.concatenate((_pole_cost(space), np.zeros(len(sites)))),
        names=kinds.names,
        ranges_m=np.array(kinds.ranges_m),
        sensor_cost=np.array(kinds.costs),
        priced=bool(any(kinds.costs) or _pole_cost(space).any()),
    )
    seen = _see(space, question, kept, max(kinds.ranges_m)) if question.line_of_sight else None
    candidates = find_candidates(
        *(given.errors, given.poles, given.ranges_m),
        **{"weight": given.weight, "pole_cost": given.pole_cost, "sensor_cost": given.sensor_cost, "visible": seen},
    )
    return candidates, given


def _see(space: Workspace, question: Question, kept: NDArray[np.bool_], range_m: float) -> csr_array:
    poles = _see_from_poles(space, range_m)[:, np.flatnonzero(kept)]
    if not question.own:
        return csr_array(poles)
    own = find_seen(space.errors[kept], mount(space, question.own), range_m, space.town, space.traces)
    return csr_array(vstack((poles, own)))


@lru_cache(maxsize=16)
def _see_from_poles(space: Workspace, range_m: float) -> csr_array:
    return find_seen(space.errors, space.sites.xyz, range_m, space.town, space.traces)


def _pole_cost(space: Workspace) -> Array:
    return np.zeros(len(space.sites.ids)) if space.sites.cost is None else space.sites.cost


@dataclass(frozen=True)
class Best:
    """The best placement of a number of sensors, or within a cost."""

    placed: Placement
    pairs: tuple[tuple[int, int], ...]  # site, with own ones after the poles, and kind
    beyond: int  # errors that no site reaches
    errors: int  # that count

    def as_json(self) -> dict[str, Json]:
        """Return the placement for the page."""
        placed = self.placed
        return {
            "pairs": [list(pair) for pair in self.pairs],
            "covered": placed.covered,
            "weight": placed.covered_weight,
            "bound": placed.upper_bound,
            "optimal": placed.optimal,
            "cost": placed.cost,
            "gain": list(placed.marginal_gain),
            "beyond": self.beyond,
            "errors": self.errors,
        }


def find_best(space: Workspace, question: Question, *, count: int | None = None, budget: float | None = None) -> Best:
    """Return the placement of `count` sensors, or within `budget`, that covers the most weight, with its bound.

    Raises `InputError` as `flcav place` does.
    """
    candidates, given = collect_candidates(space, question)
    priced = candidates if given.priced and count is None else candidates.at_unit_cost()
    placed = place_count(priced, count) if count is not None else place_budget(priced, budget or 0.0)
    reached = int((np.bincount(candidates.covers.indices, minlength=len(given.errors)) > 0).sum())
    cost = given.cost_of(placed)
    placed = replace(placed, cost=0.0 if cost is None else cost)
    pairs = tuple(zip(placed.chosen, placed.sensors, strict=True))
    return Best(placed, pairs, len(given.errors) - reached, len(given.errors))


def trace_curve(space: Workspace, question: Question) -> list[Best]:
    """Return the best placements by number of sensors or, with prices, by cost, up to the least that reaches all.

    All errors are meant that any site reaches. There are `WAYS` steps at most.
    """
    candidates, given = collect_candidates(space, question)
    if not candidates.covers.nnz:
        return []
    if not given.priced:
        steps: list[Best] = []
        for count in range(1, min(len(given.ids), WAYS) + 1):
            steps.append(find_best(space, question, count=count))
            if steps[-1].placed.covered == len(given.errors) - steps[-1].beyond:
                break
        return steps
    reached = np.bincount(candidates.covers.indices, minlength=len(given.errors)) > 0
    share = float(given.weight[reached].sum() / given.weight.sum())
    everything = cover_share(candidates, min(share * (1 - 1e-12), 1.0))[0].cost
    least = float(candidates.cost.min())
    budgets = dict.fromkeys(np.round(np.linspace(least, max(everything, least), WAYS), 6).tolist())
    return [find_best(space, question, budget=max(budget, least)) for budget in budgets]


@dataclass(frozen=True)
class NewPole:
    """A place beside a street where a new pole would cover more."""

    site: Located
    gain: float  # weight of the errors that it covers, and no sensor yet
    errors: int  # their number


def find_new_poles(space: Workspace, question: Question, kind: int, uncovered: Sequence[int]) -> list[NewPole]:
    """Return places beside streets where a sensor of a `kind` covers most of the `uncovered` rows of the errors.

    Places are tried every `NEW_EVERY_M` along all streets. The second covers most of what is left after the first, and
    so on.
    """
    if space.given is None or not len(uncovered):
        return []
    kept = np.zeros(len(space.errors), np.bool_)
    kept[list(uncovered)] = True
    kept &= select_errors(space.given, question.without)
    sites, range_m = draw_sites(space.town, NEW_EVERY_M), question.kinds.ranges_m[kind]
    if not kept.any() or not len(sites):
        return []
    errors, left = space.errors[kept], space.given.weight[kept].copy()
    if question.line_of_sight:
        sees = find_seen(errors, sites, range_m, space.town, space.traces)
    else:
        sees = find_covered(errors, sites, [range_m])
    found: list[tuple[int, float, int]] = []
    while len(found) < NEW_SHOWN and (gain := sees @ left).max() > 0:
        place = int(np.argmax(gain))
        new = (sees[[place]].toarray()[0] > 0) & (left > 0)
        found.append((place, float(gain[place]), int(new.sum())))
        left[new] = 0.0
    located = locate_sites(space.town, sites[[place for place, _, _ in found]])
    return [NewPole(site, gain, number) for site, (_, gain, number) in zip(located, found, strict=True)]


def describe_town(town: Town) -> dict[str, Json]:
    """Return the map of a town for the page: outlines [m, world], heights of buildings, names of streets."""
    x, y, yaw, length, width, height = town.buildings.T
    houses = Boxes.from_array(np.c_[x, y, height / 2, length, width, height, yaw], "building").corners()[:, :4, :2]
    streets = [
        {"name": name, "line": _rounded(max(lines, key=lambda line: float(np.hypot(*np.diff(line, axis=0).T).sum())))}
        for name, lines in list_street_names(town).items()
    ]
    return {
        "name": town.name,
        "said": town.parameters.description,
        "bounds": [round(float(value), 2) for value in town.bounds],
        "roads": [_rounded(road) for road in town.roads],
        "sidewalks": [_rounded(walk) for walk in town.sidewalks],
        "houses": [_rounded(house) for house in houses],
        "heights": height.round(1).tolist(),
        "trees": town.trees[:, (0, 1, 3, 2)].round(1).tolist(),
        "relief": None if town.relief is None else _sample_relief(town),
        "streets": streets,
    }


def _sample_relief(town: Town) -> dict[str, Json]:
    """Return heights of the ground [m] on a grid over the bounds, row by row from the south-west."""
    x_low, y_low, x_high, y_high = town.bounds
    columns, rows = (max(2, min(MOST_CELLS, round(side / CELL_M))) for side in (x_high - x_low, y_high - y_low))
    x, y = np.meshgrid(np.linspace(x_low, x_high, columns), np.linspace(y_low, y_high, rows))
    return {"columns": columns, "rows": rows, "z": town.grounds(x, y).round(1).ravel().tolist()}


def _rounded(points: Array) -> list[list[float]]:
    return np.asarray(points)[:, :2].round(1).tolist()


def describe_workspace(space: Workspace) -> dict[str, Json]:
    """Return the errors and sites of a workspace for the page."""
    given, sites = space.given, space.sites
    cost = _pole_cost(space)
    located = locate_sites(space.town, sites.xyz)
    poles = [
        {"id": str(name), "at": [round(float(value), 3) for value in xyz], "cost": float(price), "street": where.street}
        for name, xyz, price, where in zip(sites.ids, sites.xyz, cost, located, strict=True)
    ]
    errors: list[Json] = []
    if given is not None:
        columns = {
            name: given.column(name) for name in ("class", "returns", "occlusion", "distance_m", "scene", "track")
        }
        for row, (xyz, weight, kind) in enumerate(
            zip(given.errors.tolist(), given.weight.tolist(), given.kind.tolist())
        ):
            told = {name: values[row] for name, values in columns.items() if values and values[row] == values[row]}
            at = [round(value, 2) for value in xyz]
            errors.append({"at": at, "weight": weight, "kind": kind, **told})
    return {
        "poles": poles,
        "errors": errors,
        "noun": "error" if given is None else given.noun,
        "table": space.name,
        "notes": [] if given is None else list(given.notes),
        "traffic": len(space.traces),
    }

"""Line of sight from poles through a town and its traffic, by rays.

A ray starts START_M from the pole's mount, outside its own mast, and ends before the surface of what it looks for.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array, Array32, Ints, Mask
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.trace import Trace, empty_trace

START_M = 0.6  # from the mount to the start of a ray
END_M = 2.5  # from an error's position to the end of a ray: half of a long car may lie between
INSTANTS = 20  # at which traffic is looked at, over all traces
FINE = 60  # points of a viewshed from its site to the range
EYE_M = 1.0  # height above the ground of a viewshed's points: middle of a car


@dataclass(frozen=True)
class Viewshed:
    """Points of a square grid around a site, and which of them the site sees within its range."""

    x: Array  # (N,) world [m], ascending
    y: Array  # (N,)
    seen: Mask  # (N, N): rows by y, columns by x


def find_visible_pairs(
    town: Town, traces: Sequence[Trace], sites: Array, places: Array, pairs: tuple[Ints, Ints]
) -> Mask:
    """Return (M,) whether each pair's site (P, 3) sees its place (E, 3), at half of the instants or more.

    `pairs` are the M rows of `sites` and of `places`, world frame [m]. Without `traces` only the town is in the way.
    """
    origins, directions, lengths = _rays(sites[pairs[0]], places[pairs[1]])
    far = np.maximum(lengths - START_M - END_M, 0.0).astype(np.float32)
    seen, instants = np.zeros(len(far), np.int64), 0
    for scene in look_at_instants(town, traces or [empty_trace(town.name)]):
        seen += ~scene.find_occluded(origins, directions, far)
        instants += 1
    return 2 * seen >= instants


def find_viewshed(town: Town, traces: Sequence[Trace], site: Array, range_m: float) -> Viewshed:
    """Return the viewshed of a site (3,): points EYE_M above the ground that it sees within `range_m`.

    `site` (3,) is in the world frame [m]; a point counts as seen as in `find_visible_pairs`.
    """
    x, y = site[:2, None] + np.linspace(-range_m, range_m, 2 * FINE + 1)
    across, along = (each.ravel() for each in np.meshgrid(x, y))
    places = np.c_[across, along, town.grounds(across, along) + EYE_M]
    near = np.flatnonzero(np.linalg.norm(places - site, axis=1) <= range_m)
    seen = np.zeros(len(places), np.bool_)
    seen[near] = find_visible_pairs(town, traces, site[None], places, (np.zeros_like(near), near))
    return Viewshed(x, y, seen.reshape(len(y), len(x)))


def count_visible_actors(town: Town, traces: Sequence[Trace], sites: Array, ranges_m: Sequence[float]) -> Array:
    """Return (P, S): the mean number of actors within each of `ranges_m` of each site (P, 3) that it sees.

    An actor is seen where the ray to the centre of its box is free up to half of its length before it.
    """
    total, instants = np.zeros((len(sites), len(ranges_m))), 0
    for scene in look_at_instants(town, traces):
        size = scene.trace.size
        here = np.flatnonzero(scene.trace.present[scene.index])
        centre = scene.poses()[here, :3] + np.array([0.0, 0.0, 0.5]) * size[here, 2:]
        site, actor = (each.ravel() for each in np.indices((len(sites), len(here))))
        origins, directions, lengths = _rays(sites[site], centre[actor])
        near = lengths <= max(ranges_m)
        body = np.hypot(*size[here[actor], :2].T) / 2
        far = np.where(near, np.maximum(lengths - START_M - body, 0.0), 0.0).astype(np.float32)
        seen = near & ~scene.find_occluded(origins, directions, far)
        for kind, range_m in enumerate(ranges_m):
            total[:, kind] += np.bincount(site[seen & (lengths <= range_m)], minlength=len(sites))
        instants += 1
    return total / max(instants, 1)


def _rays(starts: Array, ends: Array) -> tuple[Array32, Array32, Array]:
    """Return origins (M, 3), unit directions (M, 3) and whole lengths (M,) [m] of rays from `starts` to `ends`."""
    along = ends - starts
    lengths = np.linalg.norm(along, axis=1)
    directions = along / np.maximum(lengths, 1e-9)[:, None]
    return (starts + START_M * directions).astype(np.float32), directions.astype(np.float32), lengths


def look_at_instants(town: Town, traces: Sequence[Trace], count: int = INSTANTS) -> Iterator[Scene]:
    """Yield the scenes of about `count` instants, evenly spread over each trace; each is the same object moved on."""
    each = max(count // max(len(traces), 1), 1)
    for trace in traces:
        scene = Scene(town, trace)
        for index in np.unique(np.linspace(0, len(trace.time_s) - 1, each).round().astype(np.int64)).tolist():
            scene.move_to(index)
            yield scene

"""Line of sight from poles through a town and its traffic, by ray casting.

A ray starts START_M from the pole's mount, outside the pole's mast, and ends in front of the target's surface.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array, Array32, Ints, Mask
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.trace import Trace, empty_trace

START_M = 0.6  # distance from the mount to the start of a ray
END_M = 2.5  # distance from the end of a ray to the target: half of a long car may be between
INSTANTS = 20  # number of sampled instants of traffic, over all traces
FINE = 60  # points of a viewshed between its site and the range
EYE_M = 1.0  # height of a viewshed's points above the ground: centre of a car


@dataclass(frozen=True)
class Viewshed:
    """The viewshed of a site: the points of a square grid around it that are visible from it within its range."""

    x: Array  # (N,) ascending, world frame [m]
    y: Array  # (N,) ascending, world frame [m]
    seen: Mask  # (N, N) visible points: rows by y, columns by x


def find_visible_pairs(
    town: Town, traces: Sequence[Trace], sites: Array, places: Array, pairs: tuple[Ints, Ints]
) -> Mask:
    """Return (M,) whether the place of a pair is visible from its site at half of the instants or more.

    `pairs` are M rows of `sites` (P, 3) and M rows of `places` (E, 3), world frame [m]. Without `traces` only the town
    occludes.
    """
    origins, directions, lengths = _rays(sites[pairs[0]], places[pairs[1]])
    far = np.maximum(lengths - START_M - END_M, 0.0).astype(np.float32)
    seen, instants = np.zeros(len(far), np.int64), 0
    for scene in look_at_instants(town, traces or [empty_trace(town.name)]):
        seen += ~scene.find_occluded(origins, directions, far)
        instants += 1
    return 2 * seen >= instants


def find_viewshed(town: Town, traces: Sequence[Trace], site: Array, range_m: float) -> Viewshed:
    """Return the viewshed of a site: the visible points EYE_M above the ground within `range_m` [m].

    `site` (3,) is in the world frame [m]; visibility is that of `find_visible_pairs`.
    """
    x, y = site[:2, None] + np.linspace(-range_m, range_m, 2 * FINE + 1)
    across, along = (axis.ravel() for axis in np.meshgrid(x, y))
    places = np.c_[across, along, town.grounds(across, along) + EYE_M]
    near = np.flatnonzero(np.linalg.norm(places - site, axis=1) <= range_m)
    seen = np.zeros(len(places), np.bool_)
    seen[near] = find_visible_pairs(town, traces, site[None], places, (np.zeros_like(near), near))
    return Viewshed(x, y, seen.reshape(len(y), len(x)))


def count_visible_actors(town: Town, traces: Sequence[Trace], sites: Array, ranges_m: Sequence[float]) -> Array:
    """Return (P, S) the mean number of visible actors by site and range.

    `sites` (P, 3) are in the world frame [m], `ranges_m` (S,) in [m]. An actor is visible if the ray to the centre of
    its box is free up to half of its length in front of it.
    """
    total, instants = np.zeros((len(sites), len(ranges_m))), 0
    for scene in look_at_instants(town, traces):
        size = scene.trace.size
        here = np.flatnonzero(scene.trace.present[scene.index])
        centre = scene.poses()[here, :3] + np.array([0.0, 0.0, 0.5]) * size[here, 2:]
        site, actor = (indices.ravel() for indices in np.indices((len(sites), len(here))))
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
    """Return origins (M, 3) [m], unit directions (M, 3) and total lengths (M,) [m] of rays from `starts` to `ends`."""
    along = ends - starts
    lengths = np.linalg.norm(along, axis=1)
    directions = along / np.maximum(lengths, 1e-9)[:, None]
    return (starts + START_M * directions).astype(np.float32), directions.astype(np.float32), lengths


def look_at_instants(town: Town, traces: Sequence[Trace], count: int = INSTANTS) -> Iterator[Scene]:
    """Yield a scene at about `count` instants in total, evenly spaced in every trace.

    It is one moving object per trace.
    """
    per_trace = max(count // max(len(traces), 1), 1)
    for trace in traces:
        scene = Scene(town, trace)
        for index in np.unique(np.linspace(0, len(trace.time_s) - 1, per_trace).round().astype(np.int64)).tolist():
            scene.move_to(index)
            yield scene

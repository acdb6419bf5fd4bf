"""Bird's-eye rasters around road users: the map, where their lane leads, lights, and everybody else's tracks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.perception.trajectory.config import PAST, STEP_S, Patch
from flcav.perception.trajectory.roads import STATIC, RoadMap
from flcav.perception.trajectory.tracks import Tracks, into_frame, out_of_frame
from flcav.world.trace import Trace

Array = NDArray[np.float64]

AGO = (0, 4, 8)  # steps before the present at which others are shown: 0, 1 and 2 s
LAYERS = (
    *STATIC,
    "way",  # the lanes that one gets to from where the road user is
    "red",  # bars across the lanes that a light closes, amber too
    "green",
    "self",
    *(f"others {steps * STEP_S:g} s ago" for steps in AGO),
    "pedestrian",
)
OPEN = ("G", "g")  # SUMO's letters of a green light
_LONG, _WIDE = np.meshgrid(np.linspace(-0.5, 0.5, 17), np.linspace(-0.5, 0.5, 5), indexing="ij")
BODY = np.stack((_LONG, _WIDE), axis=-1).reshape(-1, 2)  # points of a box, as shares of its length and width


def rasters(
    trace: Trace, tracks: Tracks, lit: NDArray[np.str_], predicted: NDArray[np.int64], roads: RoadMap, patch: Patch
) -> NDArray[np.bool_]:
    """Return (N, len(LAYERS), cells, cells) views of the surroundings of the `predicted` (N,) actors of `trace`.

    `tracks` hold the past, the present at `PAST`; `lit` (L,) are the letters of the lights at present. Row 0 is
    farthest ahead and column 0 farthest left, as in `flcav.world.raster`.
    """
    position, yaw = tracks.position[PAST, predicted], tracks.yaw[PAST, predicted]
    frame = np.concatenate((position, yaw[:, None]), axis=1)
    count, cells = len(predicted), patch.cells
    out = np.zeros((count, len(LAYERS), cells * cells), np.bool_)
    if not count:
        return out.reshape(count, len(LAYERS), cells, cells)
    grid = np.broadcast_to(centres(patch), (count, cells * cells, 2))
    out[:, : len(STATIC)] = roads.static(out_of_frame(grid, frame)).transpose(0, 2, 1)

    def mark(layer: str, rows: NDArray[np.int64], world: Array) -> None:
        """Set the cells of the points (R, D, 2) or (R, 2) in the pictures `rows` (R,)."""
        at, inside = cell_of(into_frame(world, frame[rows]), patch)
        number = np.broadcast_to(rows.reshape(-1, *(1,) * (at.ndim - 1)), at.shape)
        out[number[inside], LAYERS.index(layer), at[inside]] = True

    ways, _ = roads.lanes_at(position, yaw)
    for row, lanes in enumerate(ways):
        if lanes:
            mark("way", np.array([row]), np.concatenate([roads.reach[lane] for lane in lanes])[None])
    everyone = np.arange(count)
    for layer, wanted in (("green", True), ("red", False)):
        bars = _bars(roads, trace.light, lit, wanted)
        if len(bars):
            mark(layer, everyone, np.broadcast_to(bars, (count, *bars.shape)))
    on_foot = trace.category == "pedestrian"
    mark("self", everyone, _bodies(trace, tracks, PAST, predicted))
    reach = patch.side_m
    for layer, ago, kind in [(f"others {steps * STEP_S:g} s ago", steps, ~on_foot) for steps in AGO] + [
        ("pedestrian", 0, on_foot)
    ]:
        then = PAST - ago
        apart = tracks.position[then][None] - position[:, None]
        near = (np.abs(apart) < reach).all(axis=2) & kind  # NaN is not near
        near[everyone, predicted] = False
        row, other = np.nonzero(near)
        mark(layer, row, _bodies(trace, tracks, then, other))
    return out.reshape(count, len(LAYERS), cells, cells)


def centres(patch: Patch) -> Array:
    """Return (cells * cells, 2) the middle of each cell in the road user's frame, row by row."""
    low = patch.middle_x_m - patch.side_m / 2
    steps = (np.arange(patch.cells, dtype=np.float64) + 0.5) * patch.cell_m
    along, across = low + steps[::-1], patch.side_m / 2 - steps
    return np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)


def cell_of(points: Array, patch: Patch) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the cell that each point (..., 2) of the road user's frame lies in, and whether it lies in any."""
    ahead, left = patch.middle_x_m + patch.side_m / 2, patch.side_m / 2
    row = np.floor((ahead - points[..., 0]) / patch.cell_m).astype(np.int64)
    column = np.floor((left - points[..., 1]) / patch.cell_m).astype(np.int64)
    inside = (row >= 0) & (row < patch.cells) & (column >= 0) & (column < patch.cells)
    return row * patch.cells + column, inside


def _bars(roads: RoadMap, lights: NDArray[np.str_], lit: NDArray[np.str_], wanted: bool) -> Array:
    found: Sequence[Array] = [
        roads.lights[name]
        for name, letter in zip(lights.tolist(), lit.tolist())
        if name in roads.lights and (letter in OPEN) == wanted
    ]
    return np.concatenate(found) if found else np.zeros((0, 2))


def _bodies(trace: Trace, tracks: Tracks, instant: int, actors: NDArray[np.int64]) -> Array:
    """Return (N, len(BODY), 2) points of the actors' boxes in the world."""
    pose = np.concatenate((tracks.position[instant, actors], tracks.yaw[instant, actors, None]), axis=1)
    return out_of_frame(BODY * trace.size[actors, None, :2], pose)

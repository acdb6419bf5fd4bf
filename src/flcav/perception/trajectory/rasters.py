"""Bird's-eye rasters around road users: the map, reachable lanes, traffic lights, and other road users' tracks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.perception.trajectory.config import PAST, STEP_S, Patch
from flcav.perception.trajectory.roads import STATIC, RoadMap
from flcav.perception.trajectory.tracks import Tracks, into_frame, out_of_frame
from flcav.world.trace import Trace

Array = NDArray[np.float64]

AGO = (0, 4, 8)  # steps before the present at which other road users are drawn: 0, 1 and 2 s
OTHERS = {steps: f"others {steps * STEP_S:g} s ago" for steps in AGO}
LAYERS = (
    *STATIC,
    "way",  # lanes that are reachable from the road user's lanes
    "red",  # bars across the lanes whose light is not green
    "green",
    "self",
    *OTHERS.values(),
    "pedestrian",
)
OPEN = ("G", "g")  # SUMO's letters of a green light
_LONG, _WIDE = np.meshgrid(np.linspace(-0.5, 0.5, 17), np.linspace(-0.5, 0.5, 5), indexing="ij")
BODY = np.stack((_LONG, _WIDE), axis=-1).reshape(-1, 2)  # points inside a box, as shares of its length and width


def draw_rasters(
    trace: Trace, tracks: Tracks, lit: NDArray[np.str_], predicted: NDArray[np.int64], roads: RoadMap, patch: Patch
) -> NDArray[np.bool_]:
    """Return the rasters (N, len(LAYERS), cells, cells) around the actors `predicted` (N,), as indices into `trace`.

    `tracks` have the present at index `PAST`; `lit` (L,) are SUMO's letters of the lights at the present. Row 0 is
    farthest ahead and column 0 farthest left, as in `flcav.world.map.lanes`.
    """
    frame = np.concatenate((tracks.position[PAST, predicted], tracks.yaw[PAST, predicted, None]), axis=1)
    sheets = RasterCanvas(frame, patch)
    if len(predicted):
        _mark_map(sheets, roads)
        _mark_lights(sheets, roads, trace, lit)
        sheets.mark("self", np.arange(len(predicted)), _bodies(trace, tracks, PAST, predicted))
        on_foot = trace.category == "pedestrian"
        for steps in AGO:
            _mark_others(sheets, OTHERS[steps], trace, tracks, predicted, PAST - steps, ~on_foot)
        _mark_others(sheets, "pedestrian", trace, tracks, predicted, PAST, on_foot)
    return sheets.cells.reshape(len(predicted), len(LAYERS), patch.cells, patch.cells)


class RasterCanvas:
    """The rasters of N road users while they are drawn; `cells` (N, len(LAYERS), cells * cells) is changed in place."""

    def __init__(self, frame: Array, patch: Patch) -> None:
        """Create empty rasters; `frame` (N, 3) are the road users' poses x, y, yaw in the world."""
        self.frame, self.patch = frame, patch
        self.cells = np.zeros((len(frame), len(LAYERS), patch.cells**2), np.bool_)

    def mark(self, layer: str, rows: NDArray[np.int64], world: Array) -> None:
        """Set the cells of world points (R, D, 2) [m] in a layer of the rasters `rows` (R,)."""
        at, inside = cell_of(into_frame(world, self.frame[rows]), self.patch)
        sheet = np.broadcast_to(rows[:, None], at.shape)
        self.cells[sheet[inside], LAYERS.index(layer), at[inside]] = True


def _mark_map(sheets: RasterCanvas, roads: RoadMap) -> None:
    frame = sheets.frame
    grid = np.broadcast_to(centres(sheets.patch), (len(frame), sheets.patch.cells**2, 2))
    sheets.cells[:, : len(STATIC)] = roads.static(out_of_frame(grid, frame)).transpose(0, 2, 1)
    ways, _ = roads.lanes_at(frame[:, :2], frame[:, 2])
    for row, lanes in enumerate(ways):
        if lanes:
            sheets.mark("way", np.array([row]), np.concatenate([roads.reach[lane] for lane in lanes])[None])


def _mark_lights(sheets: RasterCanvas, roads: RoadMap, trace: Trace, lit: NDArray[np.str_]) -> None:
    everyone = np.arange(len(sheets.frame))
    for layer, wanted in (("green", True), ("red", False)):
        bars = _bars(roads, trace.light, lit, wanted)
        sheets.mark(layer, everyone, np.broadcast_to(bars, (len(everyone), *bars.shape)))


def _mark_others(
    sheets: RasterCanvas,
    layer: str,
    trace: Trace,
    tracks: Tracks,
    predicted: NDArray[np.int64],
    instant: int,
    kind: NDArray[np.bool_],
) -> None:
    """Draw the bodies of the near actors of a `kind` (A,) at an instant, without the predicted road user itself."""
    apart = tracks.position[instant][None] - sheets.frame[:, None, :2]
    near = (np.abs(apart) < sheets.patch.side_m).all(axis=2) & kind  # False for NaN, the absent ones
    near[np.arange(len(predicted)), predicted] = False
    row, other = np.nonzero(near)
    sheets.mark(layer, row, _bodies(trace, tracks, instant, other))


def centres(patch: Patch) -> Array:
    """Return the centres (cells * cells, 2) of a patch's cells in the road user's frame [m], row by row."""
    low = patch.middle_x_m - patch.side_m / 2
    steps = (np.arange(patch.cells, dtype=np.float64) + 0.5) * patch.cell_m
    along, across = low + steps[::-1], patch.side_m / 2 - steps
    return np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)


def cell_of(points: Array, patch: Patch) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the cell index (...) of points (..., 2) in the road user's frame [m], and whether each is in the patch."""
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
    """Return points (N, len(BODY), 2) inside the actors' boxes, in the world [m]."""
    pose = np.concatenate((tracks.position[instant, actors], tracks.yaw[instant, actors, None]), axis=1)
    return out_of_frame(BODY * trace.size[actors, None, :2], pose)

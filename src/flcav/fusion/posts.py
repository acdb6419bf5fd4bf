"""Posts beside the road as landmarks: segmented from a LiDAR sweep, and listed from a town's map.

A post is a thin upright column of returns with nothing beside it: a lamp, the mast of a sensor or a signal, the post of
a sign.
"""

import numpy as np
from scipy.ndimage import label

from flcav.arrays import Array, Array32
from flcav.world.map.town import Town

CELL_M = 0.2  # edge of a cell of the bird's-eye grid
BAND_M = (0.5, 2.2)  # heights above the road in which posts are looked for: above kerbs, below the plates of signs
LEAST_M = 0.9  # least height of a column of returns
WIDEST_M = 0.45  # largest extent of a post along x and along y
REACH_M = 40.0  # farther posts have too few returns
LEAST_RETURNS = 4


def find_posts(points: Array32, height_m: float) -> Array:
    """Return the feet (L, 2) x, y [m] of the posts in a sweep (N, >= 3), in the frame of the points.

    height_m: of the frame's origin above the road. Columns touch where their cells do, also at corners.
    """
    z = points[:, 2] + height_m
    near = (z > BAND_M[0]) & (z < BAND_M[1]) & (np.abs(points[:, :2]) < REACH_M).all(axis=1)
    xy, z = points[near, :2].astype(np.float64), z[near].astype(np.float64)
    cells = round(2 * REACH_M / CELL_M)
    at = np.minimum(((xy + REACH_M) / CELL_M).astype(np.int64), cells - 1)
    grid = np.zeros((cells, cells), dtype=bool)
    grid[at[:, 0], at[:, 1]] = True
    columns = np.zeros(grid.shape, dtype=np.int64)
    count = int(label(grid, np.ones((3, 3)), output=columns))  # pyright: ignore[reportArgumentType]
    number = columns[at[:, 0], at[:, 1]] - 1
    returns = np.bincount(number, minlength=count)

    def extent(values: Array) -> tuple[Array, Array]:
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, number, values)
        np.maximum.at(high, number, values)
        return low, high

    (low_x, high_x), (low_y, high_y), (low_z, high_z) = (extent(values) for values in (xy[:, 0], xy[:, 1], z))
    thin = (high_x - low_x <= WIDEST_M) & (high_y - low_y <= WIDEST_M)
    posts = (returns >= LEAST_RETURNS) & thin & (high_z - low_z >= LEAST_M)
    return np.column_stack(((low_x + high_x) / 2, (low_y + high_y) / 2))[posts]


def posts_of(town: Town) -> Array:
    """Return the feet (P, 2) x, y [m] of the posts on a town's map: lamps, masts of sensors and signals, sign posts."""
    parts = (town.lamps[:, :2], town.poles.position[:, :2], town.signs.position[:, :2], town.signals.foot)
    feet = np.concatenate([part.reshape(-1, 2) for part in parts])
    return np.unique(feet, axis=0)

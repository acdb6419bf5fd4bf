"""A town's static content as one mesh."""

import numpy as np

from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, box, join, moved, sheet
from flcav.world.town import Town


def town_mesh(town: Town) -> Mesh:
    """Return everything of `town` that stands still, world frame."""
    x0, y0, x1, y1 = town.bounds
    grid = np.stack(
        np.meshgrid(np.linspace(x0 - 100, x1 + 100, 20), np.linspace(y0 - 100, y1 + 100, 20), [0.0], indexing="ij"), -1
    )
    parts = [sheet(grid[:, :, 0], Material.ROAD)]
    for x, y, yaw, length, width, height in town.buildings:
        parts.append(moved(box((0, 0, height / 2), (length, width, height), Material.WALL), x, y, 0, yaw))
    return join(parts)

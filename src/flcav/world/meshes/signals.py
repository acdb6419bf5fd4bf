"""Traffic light heads and their masts."""

import numpy as np

from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, box, join, sheet, tube

HEAD_M = (0.20, 0.36, 1.04)  # depth, width, height of the housing
LENS_RADIUS_M = 0.125
LENS_PITCH_M = 0.32
VISOR_M = 0.20
MAST_BEHIND_M = 0.22  # the mast stands behind the head's centre
LENSES = (Material.LENS_RED, Material.LENS_AMBER, Material.LENS_GREEN)  # from above


def signal_head(height: float) -> Mesh:
    """Return a head of three lenses under visors, its centre `height` above the origin, facing +x."""
    front = HEAD_M[0] / 2
    parts = [box((0, 0, height), HEAD_M, Material.TRIM)]
    for place, material in zip((1, 0, -1), LENSES):
        middle = np.array((front + 0.005, 0.0, height + place * LENS_PITCH_M))
        parts += [_lens(middle, material), _visor(middle)]
    return join(parts)


def signal_mast(height: float, reach: float = 0.0) -> Mesh:
    """Return the mast of a head `height` above the origin; with a `reach` to its left, it hangs from an arm there."""
    foot = np.array((-MAST_BEHIND_M, 0.0, 0.0))
    top = np.array((-MAST_BEHIND_M, 0.0, height + 0.25))
    mast = tube(foot, top, 0.075, Material.METAL, sides=8)
    bracket = box((-MAST_BEHIND_M / 2 - 0.04, reach, height), (MAST_BEHIND_M, 0.08, 0.08), Material.METAL)
    if not reach:
        return join((mast, bracket))
    arm = tube(
        (-MAST_BEHIND_M, 0, height), (-MAST_BEHIND_M, reach, height), 0.06, Material.METAL, end_radius=0.04, sides=6
    )
    return join((mast, arm, bracket))


def _lens(middle: np.ndarray, material: Material) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 13)
    rim = np.stack((0 * angle, np.cos(angle), np.sin(angle)), axis=1) * LENS_RADIUS_M + middle
    return sheet(np.stack((rim, rim * 0 + middle)), material)


def _visor(middle: np.ndarray) -> Mesh:
    angle = np.linspace(-0.15 * np.pi, 1.15 * np.pi, 9)
    rim = np.stack((0 * angle, np.cos(angle), np.sin(angle)), axis=1) * (LENS_RADIUS_M + 0.015) + middle
    return sheet(np.stack((rim, rim + np.array((VISOR_M, 0, 0)))), Material.TRIM)

"""What stands along a street: masts, lamps, signs and clutter, each about its foot."""

from collections.abc import Callable

import numpy as np

from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, box, ellipsoid, join, tube

SIGN_RADIUS_M = 0.36
MAST_BEHIND_M = 0.40  # a roadside sensor stands this far in front of its mast


def clutter(kind: str, length: float, width: float, height: float) -> Mesh:
    """Return a piece of street clutter of that size, `length` along x; of an unknown kind, a box."""
    return CLUTTER.get(kind, _box)(length, width, height)


def lamp(height: float) -> Mesh:
    """Return a street lamp; the underside of its head is what shines."""
    post = tube((0, 0, 0), (0, 0, height), 0.08, Material.METAL, end_radius=0.05, sides=6)
    head = box((0, 0, height), (0.9, 0.9, 0.12), Material.METAL)
    head.material[head.vertices[head.faces, 2].max(axis=1) < height] = Material.LAMP
    return join((post, head))


def sensor_mast(height: float) -> Mesh:
    """Return the mast of a sensor that is `height` above the origin and looks along +x."""
    mast = tube((-MAST_BEHIND_M, 0, 0), (-MAST_BEHIND_M, 0, height + 0.1), 0.09, Material.METAL, sides=8)
    arm = box((-MAST_BEHIND_M / 2 - 0.06, 0, height - 0.12), (MAST_BEHIND_M - 0.12, 0.06, 0.06), Material.METAL)
    return join((mast, arm))


def sign(kind: str, height: float) -> Mesh:
    """Return a sign and its post; the plate, `height` above the origin, faces +x."""
    return join((sign_plate(kind, height), sign_post(height)))


def sign_plate(kind: str, height: float) -> Mesh:
    """Return the plate of a sign, front and back: stop 8 corners, yield 3, others round."""
    corners, start = {"stop": (8, np.pi / 8), "yield": (3, -np.pi / 2)}.get(kind, (16, 0.0))
    angle = start + np.arange(corners + 1) * 2 * np.pi / corners
    rim = np.stack((0 * angle, np.cos(angle), np.sin(angle)), axis=1) * SIGN_RADIUS_M
    plates = []
    for x, material in ((0.0, Material.SIGN), (-0.01, Material.METAL)):
        vertices = np.concatenate((rim[:-1], np.zeros((1, 3)))) + np.array((x, 0.0, height))
        index = np.arange(corners)
        faces = np.stack((index, (index + 1) % corners, np.full(corners, corners)), axis=1)
        plates.append(Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.full(corners, material, np.uint8)))
    return join(plates)


def sign_post(height: float) -> Mesh:
    """Return the post behind the plate of a sign."""
    return tube((-0.05, 0, 0), (-0.05, 0, height + 0.2), 0.035, Material.METAL, sides=6)


def _box(length: float, width: float, height: float) -> Mesh:
    return box((0, 0, height / 2), (length, width, height), Material.METAL)


def _hedge(length: float, width: float, height: float) -> Mesh:
    return box((0, 0, height / 2), (length, width, height), Material.LEAF)


def _bins(length: float, width: float, height: float) -> Mesh:
    count = max(1, round(length / 0.8))
    step = length / count
    parts = []
    for x in (np.arange(count) - (count - 1) / 2) * step:
        parts.append(box((x, 0, 0.46 * height), (step * 0.85, width * 0.85, 0.92 * height), Material.TRIM))
        parts.append(box((x, 0, 0.95 * height), (step * 0.9, width, 0.10 * height), Material.METAL))
    return join(parts)


def _planter(length: float, width: float, height: float) -> Mesh:
    tub = box((0, 0, 0.25 * height), (length, width, 0.5 * height), Material.WALL)
    bush = ellipsoid((0, 0, 0.55 * height), (0.46 * length, 0.45 * width, 0.45 * height), Material.LEAF)
    return join((tub, bush))


def _kiosk(length: float, width: float, height: float) -> Mesh:
    body = box((0, 0, 0.45 * height), (0.88 * length, 0.85 * width, 0.9 * height), Material.WALL)
    roof = box((0, 0, 0.95 * height), (length, width, 0.1 * height), Material.ROOF)
    counter = box((0, 0.45 * width, 0.45 * height), (0.6 * length, 0.1 * width, 0.05 * height), Material.METAL)
    return join((body, roof, counter))


def _shelter(length: float, width: float, height: float) -> Mesh:
    parts = [box((0, 0, height - 0.06), (length, width, 0.12), Material.ROOF)]
    parts.append(box((0, -width / 2 + 0.03, 0.55 * height), (0.96 * length, 0.02, 0.75 * height), Material.GLASS))
    parts.append(box((-length / 2 + 0.03, 0, 0.55 * height), (0.02, 0.8 * width, 0.75 * height), Material.GLASS))
    parts.append(box((0, -width / 4, 0.45), (0.7 * length, 0.4, 0.06), Material.METAL))
    for x in (-length / 2 + 0.05, length / 2 - 0.05):
        for y in (-width / 2 + 0.05, width / 2 - 0.05):
            parts.append(box((x, y, height / 2 - 0.06), (0.08, 0.08, height - 0.12), Material.METAL))
    return join(parts)


def _container(length: float, width: float, height: float) -> Mesh:
    body = box((0, 0, 0.44 * height), (0.94 * length, 0.94 * width, 0.8 * height), Material.METAL)
    lid = box((0, 0, 0.92 * height), (length, width, 0.16 * height), Material.TRIM)
    return join((body, lid))


CLUTTER: dict[str, Callable[[float, float, float], Mesh]] = {
    "hedge": _hedge,
    "bins": _bins,
    "planter": _planter,
    "kiosk": _kiosk,
    "shelter": _shelter,
    "container": _container,
    "cabinet": _box,
}

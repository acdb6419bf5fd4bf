"""Meshes of cars, vans, trucks and buses: side-view profiles, cargo bodies and attachments."""

from collections.abc import Callable

import numpy as np

from flcav.world.materials import Material
from flcav.world.meshes.bodywork import Profile, roof_sign, vehicle_body, wheel
from flcav.world.meshes.mesh import Mesh, add_mirror_image, box, join_meshes, transform_mesh
from flcav.world.shapes import Shape

TAXI_SIGN_M = 0.18  # height of a taxi's roof sign

_SEDAN = Profile(
    belt=((-0.5, 0.50), (-0.475, 0.63), (-0.32, 0.66), (0.18, 0.63), (0.23, 0.61), (0.46, 0.49), (0.5, 0.36)),
    roof=((-0.40, 0.66), (-0.22, 0.96), (-0.05, 1.0), (0.07, 0.97), (0.24, 0.61)),
)
PROFILES: dict[str, Profile] = {
    "city": Profile(
        belt=((-0.5, 0.42), (-0.485, 0.60), (0.24, 0.62), (0.32, 0.60), (0.46, 0.52), (0.5, 0.38)),
        roof=((-0.490, 0.60), (-0.43, 0.95), (-0.20, 1.0), (0.05, 0.98), (0.34, 0.61)),
        axles=(-0.33, 0.33),
        wheel_radius=0.28,
        clearance=0.16,
        pillars=(0.48,),
    ),
    "hatchback": Profile(
        belt=((-0.5, 0.42), (-0.485, 0.62), (0.20, 0.63), (0.27, 0.60), (0.46, 0.51), (0.5, 0.37)),
        roof=((-0.490, 0.62), (-0.40, 0.93), (-0.20, 1.0), (0.03, 0.97), (0.28, 0.61)),
        axles=(-0.31, 0.31),
        wheel_radius=0.30,
    ),
    "compact": Profile(
        belt=((-0.5, 0.44), (-0.485, 0.63), (0.19, 0.63), (0.25, 0.60), (0.46, 0.50), (0.5, 0.36)),
        roof=((-0.485, 0.63), (-0.36, 0.92), (-0.16, 1.0), (0.04, 0.97), (0.26, 0.61)),
        axles=(-0.305, 0.31),
    ),
    "sedan": _SEDAN,
    "wagon": Profile(
        belt=((-0.5, 0.42), (-0.485, 0.61), (0.18, 0.62), (0.23, 0.60), (0.46, 0.48), (0.5, 0.36)),
        roof=((-0.488, 0.61), (-0.42, 0.93), (-0.30, 0.98), (-0.02, 1.0), (0.07, 0.97), (0.24, 0.61)),
        pillars=(0.30, 0.62),
    ),
    "coupe": Profile(
        belt=((-0.5, 0.52), (-0.48, 0.66), (-0.35, 0.69), (0.14, 0.64), (0.20, 0.62), (0.46, 0.48), (0.5, 0.36)),
        roof=((-0.43, 0.68), (-0.18, 0.96), (-0.06, 1.0), (0.04, 0.97), (0.21, 0.62)),
        clearance=0.14,
        pillars=(0.45,),
        roof_width=0.76,
    ),
    "suv": Profile(
        belt=((-0.5, 0.44), (-0.485, 0.62), (0.20, 0.62), (0.25, 0.61), (0.46, 0.54), (0.5, 0.38)),
        roof=((-0.488, 0.62), (-0.44, 0.93), (-0.28, 1.0), (0.02, 1.0), (0.10, 0.97), (0.27, 0.61)),
        wheel_radius=0.36,
        clearance=0.22,
        roof_width=0.84,
    ),
    "minivan": Profile(
        belt=((-0.5, 0.40), (-0.49, 0.56), (0.25, 0.56), (0.33, 0.53), (0.47, 0.44), (0.5, 0.34)),
        roof=((-0.493, 0.56), (-0.46, 0.94), (-0.30, 1.0), (0.05, 1.0), (0.14, 0.96), (0.38, 0.54)),
        axles=(-0.31, 0.32),
        wheel_radius=0.33,
        roof_width=0.85,
    ),
    "pickup": Profile(
        belt=((-0.5, 0.54), (-0.11, 0.55), (-0.105, 0.60), (0.18, 0.60), (0.22, 0.59), (0.47, 0.53), (0.5, 0.38)),
        roof=((-0.115, 0.60), (-0.095, 0.96), (-0.02, 1.0), (0.08, 1.0), (0.12, 0.97), (0.24, 0.59)),
        axles=(-0.28, 0.32),
        wheel_radius=0.38,
        clearance=0.25,
        windows=(0.10, 0.93),
        pillars=(0.46,),
        roof_width=0.84,
        rounding=0.08,
        bed=(-0.485, -0.12, 0.34),
    ),
    "taxi": _SEDAN,
    "panel_van": Profile(
        belt=((-0.5, 0.44), (0.28, 0.45), (0.40, 0.42), (0.47, 0.36), (0.5, 0.28)),
        roof=((-0.497, 0.44), (-0.488, 0.97), (-0.42, 1.0), (0.14, 1.0), (0.22, 0.95), (0.40, 0.44)),
        axles=(-0.30, 0.31),
        wheel_radius=0.34,
        clearance=0.22,
        windows=(0.72, 0.95),
        pillars=(),
        roof_width=0.91,
        rounding=0.07,
    ),
    "high_van": Profile(
        belt=((-0.5, 0.38), (0.30, 0.39), (0.41, 0.36), (0.47, 0.31), (0.5, 0.24)),
        roof=((-0.497, 0.38), (-0.490, 0.97), (-0.43, 1.0), (0.16, 1.0), (0.25, 0.92), (0.41, 0.38)),
        axles=(-0.30, 0.32),
        wheel_radius=0.35,
        clearance=0.24,
        windows=(0.74, 0.95),
        pillars=(),
        roof_width=0.91,
        rounding=0.07,
    ),
    "caddy": Profile(
        belt=((-0.5, 0.44), (0.20, 0.52), (0.28, 0.51), (0.46, 0.45), (0.5, 0.34)),
        roof=((-0.497, 0.46), (-0.485, 0.96), (-0.40, 1.0), (0.05, 1.0), (0.12, 0.96), (0.33, 0.51)),
        axles=(-0.30, 0.32),
        wheel_radius=0.31,
        windows=(0.60, 0.94),
        pillars=(),
        roof_width=0.88,
        rounding=0.10,
    ),
}
CAB_M = 2.2  # length of a truck's cab
WHEEL_M = 0.48  # radius of the wheels of trucks and buses
_CAB = Profile(
    belt=((-0.5, 0.44), (0.40, 0.44), (0.48, 0.40), (0.5, 0.30)),
    roof=((-0.49, 0.44), (-0.47, 0.98), (-0.30, 1.0), (0.20, 1.0), (0.32, 0.94), (0.46, 0.44)),
    axles=(0.02, 0.02),
    wheel_radius=WHEEL_M,
    clearance=0.38,
    windows=(0.40, 0.95),
    pillars=(),
    roof_width=0.93,
    rounding=0.06,
    stations=9,
)
_BUS = Profile(
    belt=((-0.5, 0.36), (0.5, 0.36)),
    roof=((-0.499, 0.36), (-0.494, 0.96), (-0.47, 1.0), (0.47, 1.0), (0.488, 0.95), (0.499, 0.36)),
    axles=(-0.26, 0.28),
    wheel_radius=WHEEL_M,
    clearance=0.30,
    windows=(0.02, 0.985),
    pillars=(0.14, 0.28, 0.42, 0.56, 0.70, 0.84),
    roof_width=0.95,
    rounding=0.05,
    stations=31,
)


def make_car(shape: Shape) -> Mesh:
    """Return the mesh of a car or van in its body frame; a taxi has a roof sign."""
    if shape.name in _MAKERS:
        return _MAKERS[shape.name](shape)
    if shape.name == "taxi":
        top = shape.height - TAXI_SIGN_M
        return join_meshes((vehicle_body(PROFILES["taxi"], shape.length, shape.width, top), roof_sign(-0.2, top)))
    return vehicle_body(PROFILES[shape.name], shape.length, shape.width, shape.height)


def make_truck(shape: Shape) -> Mesh:
    """Return the mesh of a truck in its body frame: a cab, and behind it a closed box or an open tipper."""
    length, width, height = shape[1:]
    cab_height = min(2.75, height - 0.15)
    parts = [transform_mesh(vehicle_body(_CAB, CAB_M, width, cab_height), length / 2 - CAB_M / 2, 0)]
    rear = -length / 2
    bed = length - CAB_M - 0.25
    middle = rear + bed / 2
    parts.append(box((rear + length * 0.45, 0, 0.82), (length * 0.88, 0.9, 0.26), Material.TRIM))
    parts.append(
        _tipper_body(middle, bed, width, height) if shape.name == "tipper" else _cargo(middle, bed, width, height)
    )
    parts.append(_rear_lights(rear, width))
    parts.append(box((rear + 0.05, 0, 0.50), (0.10, width * 0.92, 0.12), Material.METAL))
    parts.append(
        add_mirror_image(box((middle + bed * 0.12, width / 2 - 0.12, 0.68), (bed * 0.40, 0.05, 0.40), Material.METAL))
    )
    for x in (rear + 1.15, rear + 2.25):
        parts.append(add_mirror_image(transform_mesh(wheel(WHEEL_M, 0.50), x, width / 2 - 0.30)))
    return join_meshes(parts)


def make_bus(shape: Shape) -> Mesh:
    """Return the mesh of a bus in its body frame, with rows of seats behind its windows."""
    length, width, height = shape[1:]
    parts = [vehicle_body(_BUS, length, width, height)]
    row = -length / 2 + 1.2
    while row < length / 2 - 2.2:
        parts.append(add_mirror_image(box((row, width * 0.27, height * 0.42), (0.12, 0.90, 0.70), Material.INTERIOR)))
        row += 0.95
    return join_meshes(parts)


def _trailer_car(shape: Shape) -> Mesh:
    """Return a hatchback with a single-axle box trailer 0.5 m behind it."""
    length, width, height = shape[1:]
    front, rear, bed = 4.05, -length / 2, 2.55
    middle = rear + bed / 2
    wall = width / 2 - 0.20
    parts = [transform_mesh(vehicle_body(PROFILES["hatchback"], front, width, height), length / 2 - front / 2, 0)]
    parts.append(box((middle, 0, 0.52), (bed, 2 * wall, 0.08), Material.TRIM))
    parts.append(add_mirror_image(box((middle, wall, 0.78), (bed, 0.04, 0.45), Material.METAL)))
    parts += [box((x, 0, 0.78), (0.04, 2 * wall, 0.45), Material.METAL) for x in (rear + 0.02, rear + bed - 0.02)]
    parts.append(box((middle, 0, 0.95), (bed * 0.8, wall * 1.6, 0.30), Material.CLOTH))  # its load
    parts.append(box((rear + bed + 0.42, 0, 0.45), (0.9, 0.08, 0.08), Material.METAL))  # drawbar
    parts.append(add_mirror_image(transform_mesh(wheel(0.29, 0.16), middle, width / 2 - 0.10)))
    parts.append(_rear_lights(rear, width * 0.8))
    return join_meshes(parts)


def _overturned(shape: Shape) -> Mesh:
    """Return an overturned hatchback, lying on its right side."""
    upright = vehicle_body(PROFILES["hatchback"], shape.length, shape.height, shape.width)
    x, y, z = upright.vertices.T
    low = float(y.min())
    return Mesh(np.stack((x, shape.width / 2 - z, y - low), axis=1).astype(np.float32), upright.faces, upright.material)


def _ladder_van(shape: Shape) -> Mesh:
    """Return a panel van with two ladders on its roof."""
    length, width, top = shape.length, shape.width, shape.height - 0.30
    parts = [vehicle_body(PROFILES["panel_van"], length, width, top)]
    for x in (-0.38 * length, 0.05 * length):
        parts.append(box((x, 0, top + 0.08), (0.06, 0.80 * width, 0.16), Material.METAL))
    for y, z in ((0.25, 0.20), (-0.30, 0.20), (-0.30, 0.27)):
        rails = [
            box((-0.15 * length, y + d, top + z), (0.68 * length, 0.04, 0.06), Material.METAL) for d in (-0.2, 0.2)
        ]
        rungs = [
            box((x, y, top + z), (0.04, 0.40, 0.04), Material.METAL)
            for x in np.linspace(-0.47 * length, 0.17 * length, 12)
        ]
        parts += [*rails, *rungs]
    return join_meshes(parts)


_MAKERS: dict[str, Callable[[Shape], Mesh]] = {
    "trailer_car": _trailer_car,
    "overturned": _overturned,
    "ladder_van": _ladder_van,
    "box_van": lambda shape: make_truck(shape),
}


def _cargo(middle: float, bed: float, width: float, height: float) -> Mesh:
    return box((middle, 0, (height + 1.0) / 2), (bed, width - 0.06, height - 1.0), Material.PAINT)


def _tipper_body(middle: float, bed: float, width: float, height: float) -> Mesh:
    floor, rim, thick = 1.05, height - 0.55, 0.06
    wall = (rim + floor) / 2, rim - floor
    inner = width - 0.06
    parts = [box((middle, 0, floor), (bed, inner, 0.10), Material.METAL)]
    parts.append(add_mirror_image(box((middle, inner / 2 - thick / 2, wall[0]), (bed, thick, wall[1]), Material.PAINT)))
    parts.append(box((middle - bed / 2 + thick / 2, 0, wall[0]), (thick, inner, wall[1]), Material.PAINT))
    front = middle + bed / 2 - thick / 2
    parts.append(box((front, 0, (height + floor) / 2), (thick, inner, height - floor), Material.PAINT))
    parts.append(box((middle, 0, floor + 0.45), (bed * 0.9, inner * 0.9, 0.8), Material.GROUND))
    return join_meshes(parts)


def _rear_lights(rear: float, width: float) -> Mesh:
    lamp = add_mirror_image(box((rear + 0.01, width * 0.40, 0.86), (0.04, 0.26, 0.16), Material.TAILLAMP))
    return join_meshes((lamp, box((rear + 0.01, 0, 0.66), (0.03, 0.50, 0.12), Material.PLATE)))

"""Trucks and buses."""

from flcav.world.materials import Material
from flcav.world.meshes.bodywork import Profile, vehicle_body, wheel
from flcav.world.meshes.mesh import Mesh, box, join, mirrored, moved
from flcav.world.shapes import Shape

CAB_M = 2.2
WHEEL_M = 0.48

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


def truck(shape: Shape) -> Mesh:
    """Return the truck `shape`: a cab, and a closed box or an open tipper behind it."""
    length, width, height = shape[1:]
    cab_height = min(2.75, height - 0.15)
    parts = [moved(vehicle_body(_CAB, CAB_M, width, cab_height), length / 2 - CAB_M / 2, 0)]
    rear = -length / 2
    bed = length - CAB_M - 0.25
    middle = rear + bed / 2
    parts.append(box((rear + length * 0.45, 0, 0.82), (length * 0.88, 0.9, 0.26), Material.TRIM))
    parts.append(
        _tipper_body(middle, bed, width, height) if shape.name == "tipper" else _cargo(middle, bed, width, height)
    )
    parts.append(_rear_lights(rear, width))
    parts.append(box((rear + 0.05, 0, 0.50), (0.10, width * 0.92, 0.12), Material.METAL))
    parts.append(mirrored(box((middle + bed * 0.12, width / 2 - 0.12, 0.68), (bed * 0.40, 0.05, 0.40), Material.METAL)))
    for x in (rear + 1.15, rear + 2.25):
        parts.append(mirrored(moved(wheel(WHEEL_M, 0.50), x, width / 2 - 0.30)))
    return join(parts)


def bus(shape: Shape) -> Mesh:
    """Return the bus `shape`, with rows of seats behind its windows."""
    length, width, height = shape[1:]
    parts = [vehicle_body(_BUS, length, width, height)]
    row = -length / 2 + 1.2
    while row < length / 2 - 2.2:
        parts.append(mirrored(box((row, width * 0.27, height * 0.42), (0.12, 0.90, 0.70), Material.INTERIOR)))
        row += 0.95
    return join(parts)


def _cargo(middle: float, bed: float, width: float, height: float) -> Mesh:
    return box((middle, 0, (height + 1.0) / 2), (bed, width - 0.06, height - 1.0), Material.PAINT)


def _tipper_body(middle: float, bed: float, width: float, height: float) -> Mesh:
    floor, rim, thick = 1.05, height - 0.55, 0.06
    wall = (rim + floor) / 2, rim - floor
    inner = width - 0.06
    parts = [box((middle, 0, floor), (bed, inner, 0.10), Material.METAL)]
    parts.append(mirrored(box((middle, inner / 2 - thick / 2, wall[0]), (bed, thick, wall[1]), Material.PAINT)))
    parts.append(box((middle - bed / 2 + thick / 2, 0, wall[0]), (thick, inner, wall[1]), Material.PAINT))
    front = middle + bed / 2 - thick / 2
    parts.append(box((front, 0, (height + floor) / 2), (thick, inner, height - floor), Material.PAINT))
    parts.append(box((middle, 0, floor + 0.45), (bed * 0.9, inner * 0.9, 0.8), Material.GROUND))
    return join(parts)


def _rear_lights(rear: float, width: float) -> Mesh:
    lamp = mirrored(box((rear + 0.01, width * 0.40, 0.86), (0.04, 0.26, 0.16), Material.TAILLAMP))
    return join((lamp, box((rear + 0.01, 0, 0.66), (0.03, 0.50, 0.12), Material.PLATE)))

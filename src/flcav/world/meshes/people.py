"""Meshes of pedestrians, cyclists and motorcyclists: figures posed by the positions of their joints."""

from typing import NamedTuple

import numpy as np

from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, box, ellipsoid, join_meshes, sheet, transform_mesh, tube
from flcav.world.shapes import Shape

Point = tuple[float, float, float]


class Side(NamedTuple):
    """The joints of one leg and one arm of a figure: x, y, z [m]."""

    hip: Point
    knee: Point
    foot: Point
    shoulder: Point
    elbow: Point
    hand: Point


def make_figure(waist: Point, neck: Point, sides: tuple[Side, Side], *, helmet: bool = False) -> Mesh:
    """Return the mesh of a person facing +x with the given joints [m]; `helmet` is for riders."""
    low, high = np.array(waist), np.array(neck)
    head = high + np.array((0.05, 0.0, 0.19))
    parts = [
        tube(low, low + 0.55 * (high - low), 0.135, Material.CLOTH, end_radius=0.155),
        tube(low + 0.55 * (high - low), high, 0.155, Material.CLOTH, end_radius=0.075),
        tube(sides[0].shoulder, sides[1].shoulder, 0.07, Material.CLOTH, sides=6),
        ellipsoid(head, (0.10, 0.085, 0.13), Material.SKIN),
    ]
    if helmet:
        parts.append(ellipsoid(head + np.array((-0.01, 0.0, 0.035)), (0.13, 0.12, 0.125), Material.PAINT))
    for side in sides:
        parts.append(tube(side.hip, side.knee, 0.088, Material.TROUSERS, end_radius=0.060, sides=6))
        parts.append(tube(side.knee, side.foot, 0.060, Material.TROUSERS, end_radius=0.045, sides=6))
        x, y, z = side.foot
        parts.append(box((x + 0.06, y, z - 0.02), (0.26, 0.095, 0.09), Material.TRIM))
        parts.append(tube(side.shoulder, side.elbow, 0.052, Material.CLOTH, end_radius=0.042, sides=6))
        parts.append(tube(side.elbow, side.hand, 0.042, Material.SKIN, end_radius=0.035, sides=6))
    return join_meshes(parts)


def pedestrian(shape: Shape) -> Mesh:
    """Return the mesh of a pedestrian in mid-stride, of the same size for every `shape`: `actor_mesh` scales it."""
    sides = tuple(
        Side(
            hip=(0.0, 0.09 * left, 0.92),
            knee=(0.14 * step, 0.10 * left, 0.50),
            foot=(0.19 * step - 0.05, 0.10 * left, 0.08 + (0.03 if step < 0 else 0.0)),
            shoulder=(0.0, 0.20 * left, 1.42),
            elbow=(-0.09 * step - 0.02, 0.25 * left, 1.16),
            hand=(-0.11 * step + 0.08, 0.24 * left, 0.94),
        )
        for left, step in ((1, 1), (-1, -1))
    )
    return make_figure((0.0, 0.0, 0.88), (0.0, 0.0, 1.50), (sides[0], sides[1]))


def bicycle(shape: Shape, *, ridden: bool = True) -> Mesh:
    """Return the mesh of a bicycle, if `ridden` with its rider, who leans further forward on a sport bike."""
    lean = 0.42 if shape.name == "sport_bike" else 0.22
    wheel_x = 0.53
    hub = 0.34
    parts = [_spoked_wheel(x, hub, 0.022) for x in (-wheel_x, wheel_x)]
    saddle, crank, head = (-0.20, 0.0, 0.93), (-0.08, 0.0, 0.30), (0.38, 0.0, 0.86)
    bars = (
        ((-wheel_x, 0.0, hub), crank),
        (crank, saddle),
        (crank, head),
        ((-0.17, 0.0, 0.80), head),
        ((0.36, 0.0, 0.98), (wheel_x, 0.0, hub)),
        ((-wheel_x, 0.0, hub), (-0.16, 0.0, 0.76)),
        ((0.38, -0.26, 1.0), (0.38, 0.26, 1.0)),
    )
    parts += [tube(start, end, 0.018, Material.METAL, sides=5) for start, end in bars]
    parts.append(box((-0.22, 0, 0.94), (0.26, 0.15, 0.06), Material.TRIM))
    parts.append(box((-0.60, 0, 0.68), (0.03, 0.07, 0.07), Material.TAILLAMP))
    if ridden:
        neck = (-0.18 + lean, 0.0, 0.97 + np.sqrt(0.55**2 - lean**2))
        parts.append(_rider(saddle, neck, knee_x=0.18, feet=((0.02, 0.18), (-0.14, 0.42)), hand=(0.38, 0.25, 1.02)))
    if shape.name == "cargo_bike":  # the front wheel is ahead of a box for children or goods
        parts = [transform_mesh(join_meshes(parts), -0.40, 0.0)]
        parts.append(box((0.62, 0.0, 0.52), (0.85, 0.62, 0.55), Material.PAINT))
        parts += [_spoked_wheel(1.06, 0.25, 0.03), box((0.75, 0.0, 0.20), (0.9, 0.06, 0.06), Material.METAL)]
    return join_meshes(parts)


def motorcycle(shape: Shape, *, ridden: bool = True) -> Mesh:
    """Return the mesh of a motorcycle, if `ridden` with its rider; a scooter has a leg shield and a flat floor."""
    scooter = shape.name == "scooter"
    radius, wheel_x = (0.26, 0.62) if scooter else (0.31, 0.72)
    parts = []
    for x in (-wheel_x, wheel_x):
        parts.append(_ring(x, radius, 0.06))
        parts.append(ellipsoid((x, 0, radius), (radius * 0.7, 0.05, radius * 0.7), Material.RIM))
    if scooter:
        parts.append(box((0.02, 0, 0.30), (0.60, 0.34, 0.10), Material.PAINT))
        parts.append(box((0.36, 0, 0.62), (0.08, 0.42, 0.62), Material.PAINT))
        parts.append(box((-0.40, 0, 0.55), (0.62, 0.32, 0.42), Material.PAINT))
    else:
        parts.append(box((0.0, 0, 0.48), (0.60, 0.30, 0.36), Material.METAL))
        parts.append(ellipsoid((0.20, 0, 0.84), (0.32, 0.17, 0.16), Material.PAINT, 10))
    parts.append(box((-0.38, 0, 0.78), (0.70, 0.26, 0.12), Material.TRIM))
    parts.append(tube((0.42, 0, 1.0), (wheel_x, 0, radius), 0.05, Material.METAL, end_radius=0.04, sides=6))
    parts.append(tube((0.42, -0.36, 1.02), (0.42, 0.36, 1.02), 0.02, Material.METAL, sides=5))
    parts.append(ellipsoid((0.54, 0, 0.90), (0.10, 0.10, 0.10), Material.HEADLAMP, 6))
    parts.append(box((-0.76, 0, 0.74), (0.06, 0.16, 0.09), Material.TAILLAMP))
    parts.append(box((-0.82, 0, 0.56), (0.02, 0.20, 0.15), Material.PLATE))
    if ridden:
        feet = ((0.10, 0.40), (0.10, 0.40))
        parts.append(_rider((-0.25, 0, 0.86), (-0.08, 0, 1.38), knee_x=0.16, feet=feet, hand=(0.40, 0.32, 1.04)))
    return join_meshes(parts)


def _rider(
    saddle: Point, neck: Point, *, knee_x: float, feet: tuple[tuple[float, float], tuple[float, float]], hand: Point
) -> Mesh:
    """Return a seated figure with a helmet; `feet` are x, z of the left and right foot, `hand` is the left hand [m]."""
    sides = []
    for left, (x, z) in zip((1, -1), feet):
        shoulder = (neck[0] + 0.01, 0.20 * left, neck[2] - 0.09)
        elbow = ((shoulder[0] + hand[0]) / 2 - 0.02, 0.26 * left, (shoulder[2] + hand[2]) / 2 - 0.06)
        knee = (saddle[0] + knee_x + 0.22, 0.13 * left, (saddle[2] + z) / 2 + 0.16)
        sides.append(
            Side(
                hip=(saddle[0], 0.10 * left, saddle[2] + 0.06),
                knee=knee,
                foot=(x, 0.12 * left, z),
                shoulder=shoulder,
                elbow=elbow,
                hand=(hand[0], hand[1] * left, hand[2]),
            )
        )
    return make_figure((saddle[0], 0.0, saddle[2] + 0.02), neck, (sides[0], sides[1]), helmet=True)


def _ring(x: float, radius: float, thickness: float) -> Mesh:
    """Return a torus-shaped tyre in the x-z plane that stands on z = 0 [m]."""
    around = np.linspace(0, 2 * np.pi, 15)
    rows = []
    for angle in np.linspace(0, 2 * np.pi, 5):
        reach = radius - thickness + thickness * np.cos(angle)
        y = np.full_like(around, thickness * np.sin(angle))
        rows.append(np.stack((x + reach * np.cos(around), y, radius + reach * np.sin(around)), axis=1))
    return sheet(np.stack(rows), Material.TYRE)


def _spoked_wheel(x: float, radius: float, thickness: float) -> Mesh:
    parts = [_ring(x, radius, thickness)]
    for angle in np.linspace(0, np.pi, 5)[:-1]:
        reach = np.array((np.cos(angle), 0.0, np.sin(angle))) * (radius - thickness)
        hub = np.array((x, 0.0, radius))
        parts.append(tube(hub - reach, hub + reach, 0.004, Material.METAL, sides=3, capped=False))
    return join_meshes(parts)

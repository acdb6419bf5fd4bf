"""Lofted bodies of road vehicles from side-view profiles, with wheel arches, wheels, glass and an interior."""

from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array
from flcav.world.materials import Material
from flcav.world.meshes.mesh import Mesh, add_mirror_image, box, ellipsoid, join_meshes, sheet, transform_mesh

Outline = tuple[tuple[float, float], ...]

MIRROR_M = 0.05  # width of a wing mirror
FRONT_SEAT_M = 1.05  # from the foot of the windscreen back to the front seats
REAR_SEAT_M = 1.95  # and to the rear seats
ARCH = 1.16  # radius of a wheel arch over that of its wheel


@dataclass(frozen=True)
class Profile:
    """Side-view profile of a vehicle: x in lengths, from -0.5 (rear) to 0.5, and z in heights, from 0 to 1."""

    belt: Outline  # x, z of the upper edge of the lower body: boot, waist, bonnet
    roof: Outline  # x, z of the cabin above it, from its rear foot to the foot of the windscreen
    axles: tuple[float, float] = (-0.295, 0.305)  # x of the rear and the front axle
    wheel_radius: float = 0.31  # of the wheels [m]
    clearance: float = 0.17  # of the floor above the ground [m]
    windows: tuple[float, float] = (0.08, 0.93)  # start and end of the side windows, shares of the cabin's length
    pillars: tuple[float, ...] = (0.36, 0.66)  # between windows, shares of the cabin's length
    roof_width: float = 0.80  # over the cabin's width at the waist
    rounding: float = 0.16  # share by which the ends are narrower
    bed: tuple[float, float, float] | None = None  # of a pickup: rear x, front x, z of the floor
    stations: int = 23  # evenly spaced cross sections along x


def vehicle_body(profile: Profile, length: float, width: float, height: float) -> Mesh:
    """Return the mesh of a vehicle, mirrors included, of about these outer dimensions [m], in its body frame."""
    half_width = width / 2 - MIRROR_M
    lower = _Lower.of(profile, length, half_width, height)
    parts = [add_mirror_image(_flank(lower)), _floor(lower), _end(lower, front=False), _end(lower, front=True)]
    parts += [
        add_mirror_image(_cabin_side(profile, lower, length, height)),
        add_mirror_image(_interior(profile, lower, length, height)),
    ]
    parts += [_driver(profile, lower, length, height)]
    for axle in profile.axles:
        parts += [add_mirror_image(_arch(axle * length, profile, half_width))]
        parts += [add_mirror_image(transform_mesh(wheel(profile.wheel_radius, 0.22), axle * length, half_width - 0.13))]
    foot = profile.roof[-1][0] * length - 0.35
    mirror = (foot, half_width + MIRROR_M / 2 - 0.03, np.interp(foot, lower.x, lower.belt) + 0.07)
    parts.append(add_mirror_image(box(mirror, (0.11, MIRROR_M + 0.06, 0.12), Material.PAINT)))
    return join_meshes(parts)


def wheel(radius: float, width: float, sides: int = 12) -> Mesh:
    """Return the mesh of a wheel of `radius` and `width` [m] that stands on z = 0, with its outer side towards +y."""
    hub, face = np.array((0.0, 0.0, radius)), width / 2
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    circle = np.stack((np.cos(angle), 0 * angle, np.sin(angle)), axis=1) * radius
    out = np.array((0.0, face, 0.0))
    tread = [hub - out + 0 * circle, hub - out + circle, hub + out + circle, hub + out + circle * 0.68]
    disc = [hub + out + circle * 0.68, hub + out * 0.7 + circle * 0.6, hub + out * 0.8 + circle * 0]
    return join_meshes((sheet(np.stack(tread), Material.TYRE), sheet(np.stack(disc), Material.RIM)))


@dataclass(frozen=True)
class _Lower:
    """The lower body: its cross sections at S stations along x."""

    x: Array  # (S,) [m]
    half: Array  # (S,) half width [m]
    sill: Array  # (S,) z of the lower edge of the flank, around the wheel arches [m]
    belt: Array  # (S,) z of the upper edge of the flank [m]
    deck: Array  # (S,) z of the bonnet, boot or bed between the flanks [m]
    clearance: float  # [m]

    @classmethod
    def of(cls, profile: Profile, length: float, half_width: float, height: float) -> "_Lower":
        """Return the cross sections of a profile at these dimensions [m], denser around the wheel arches."""
        radius = profile.wheel_radius * ARCH
        arches = [axle * length + np.linspace(-1.02, 1.02, 9) * radius for axle in profile.axles]
        edges = [] if profile.bed is None else [profile.bed[0], profile.bed[0] + 0.004]
        edges += [] if profile.bed is None else [profile.bed[1], profile.bed[1] + 0.004]
        even = np.linspace(-0.5, 0.5, profile.stations) * length
        x = np.unique(np.clip(np.concatenate([even, *arches, np.array(edges) * length]), -length / 2, length / 2))
        u, z = np.transpose(profile.belt)
        belt = np.interp(x / length, u, z) * height
        taper = np.clip((np.abs(x) / (length / 2) - 0.80) / 0.20, 0, 1) ** 2.2
        sill = np.full_like(x, profile.clearance)
        for axle in profile.axles:
            away = x - axle * length
            over = profile.wheel_radius + np.sqrt(np.maximum(radius**2 - away**2, 0))
            sill = np.where(np.abs(away) < radius, np.maximum(sill, over), sill)
        deck = belt + 0.02
        if profile.bed is not None:
            start, stop, floor = profile.bed
            deck = np.where((x / length > start) & (x / length <= stop), floor * height, deck)
        half = half_width * (1 - profile.rounding * taper)
        return cls(x, half, np.minimum(sill, belt - 0.05), belt, deck, profile.clearance)


def _flank(lower: _Lower) -> Mesh:
    x = lower.x
    half = lower.half
    rows = (
        (0.955 * half, lower.sill),
        (half, lower.sill + 0.55 * (lower.belt - lower.sill)),
        (0.985 * half, lower.belt - 0.06),
        (0.92 * half, lower.belt),
        (0.86 * half, lower.deck),
        (0 * half, lower.deck),
    )
    return sheet(np.stack([np.stack((x, y, z), axis=1) for y, z in rows], axis=1), Material.PAINT)


def _floor(lower: _Lower) -> Mesh:
    z = np.full_like(lower.x, lower.clearance)
    edges = [np.stack((lower.x, side * 0.95 * lower.half, z), axis=1) for side in (-1, 1)]
    return sheet(np.stack(edges, axis=1), Material.TRIM)


def _end(lower: _Lower, *, front: bool) -> Mesh:
    """Return the front or the rear, with bumper, licence plate, lamps and grille."""
    at = -1 if front else 0
    height = lower.belt[at] - lower.clearance
    y = np.linspace(-1, 1, 9) * lower.half[at]
    z = lower.clearance + np.array((0.0, 0.36, 0.72, 1.0)) * height
    material = np.full((8, 3), Material.PAINT, np.uint8)
    material[[2, 5], 0] = Material.TRIM
    material[3:5, 0] = Material.PLATE
    material[[0, 1, 6, 7], 1] = Material.HEADLAMP if front else Material.TAILLAMP
    if front:
        material[2:6, 1] = Material.TRIM  # grille
    points = np.stack(np.broadcast_arrays(lower.x[at], y[:, None], z[None]), axis=-1)
    return sheet(points, material)


def _arch(x: float, profile: Profile, half_width: float) -> Mesh:
    """Return the liner of the left wheel arch at `x`, which keeps rays from passing behind the wheel."""
    radius, hub = profile.wheel_radius * ARCH, profile.wheel_radius
    angle = np.linspace(0, np.pi, 7)
    circle = np.stack((np.cos(angle), 0 * angle, np.sin(angle)), axis=1) * radius
    feet = np.array([[radius, 0, profile.clearance - hub], [-radius, 0, profile.clearance - hub]])
    rim = np.concatenate((feet[:1], circle, feet[1:]))
    outer, inner = (np.array((x, y, hub)) for y in (half_width * 0.95, half_width - 0.38))
    closed = np.concatenate((rim, rim[:1]))
    liner = sheet(np.stack((outer + rim, inner + rim)), Material.TRIM)
    return join_meshes((liner, sheet(np.stack((inner + closed, inner + 0 * closed)), Material.TRIM)))


def _cabin_side(profile: Profile, lower: _Lower, length: float, height: float) -> Mesh:
    """Return the left half of the cabin: side windows between pillars, roof, windscreen and rear window."""
    u, z = np.transpose(profile.roof)
    span = u[-1] - u[0]
    edges = [u[0] + span * (pillar + side * 0.025) for pillar in profile.pillars for side in (-1, 1)]
    ends = [u[0] + span * end for end in profile.windows]
    x = np.unique(np.concatenate([np.linspace(u[0], u[-1], 11), u, edges, ends]).round(6)) * length
    belt = np.interp(x, lower.x, lower.belt)
    top = np.maximum(np.interp(x / length, u, z) * height, belt + 0.001)
    waist = 0.92 * np.interp(x, lower.x, lower.half)
    rise = np.clip((top - belt) / (0.9 * (top - belt).max()), 0, 1)
    shoulder = waist * (1 - (1 - profile.roof_width) * rise)

    along = ((x[:-1] + x[1:]) / 2 / length - u[0]) / span
    glazed = (along > profile.windows[0]) & (along < profile.windows[1])
    for pillar in profile.pillars:
        glazed &= np.abs(along - pillar) > 0.024
    steep = np.abs(np.diff(top) / np.diff(x)) > 0.25
    upright = steep & (along > 0.5) | steep & (profile.windows[0] < 0.2)  # a van's rear has doors, no window

    share = np.array((0.0, 0.10, 0.86, 1.0))
    side = np.stack(
        [np.stack((x, waist + (shoulder - waist) * part, belt + (top - belt) * part), axis=1) for part in share], axis=1
    )
    side_material = np.full((len(x) - 1, 3), Material.PAINT, np.uint8)
    side_material[glazed, 1] = Material.GLASS
    roof = [np.stack((x, shoulder * part, top + 0.02 * (1 - part)), axis=1) for part in (1.0, 0.85, 0.0)]
    roof_material = np.full((len(x) - 1, 2), Material.PAINT, np.uint8)
    roof_material[upright, 1] = Material.GLASS
    return join_meshes((sheet(side, side_material), sheet(np.stack(roof, axis=1), roof_material)))


def _cabin_frame(profile: Profile, lower: _Lower, length: float) -> tuple[float, float, float]:
    """Return x of the rear and the front end of the cabin, and z of its waist [m]."""
    start, end = profile.roof[0][0] * length, profile.roof[-1][0] * length
    return start, end, float(np.interp((start + end) / 2, lower.x, lower.belt))


def _headroom(profile: Profile, length: float, height: float, x: float, waist: float) -> float:
    """Return the height of the roof above the waist at `x` [m]."""
    u, z = np.transpose(profile.roof)
    return float(np.interp(x / length, u, z) * height - waist)


def _interior(profile: Profile, lower: _Lower, length: float, height: float) -> Mesh:
    """Return the left half of the dashboard and of the seats; rows without headroom are left out."""
    start, end, waist = _cabin_frame(profile, lower, length)
    side = float(lower.half.max()) * 0.45
    parts = [box((end - 0.45, side, waist - 0.05), (0.30, 2 * side * 0.85, 0.12), Material.INTERIOR)]
    for row in (end - FRONT_SEAT_M, end - REAR_SEAT_M):
        room = _headroom(profile, length, height, row, waist)
        if row < start + 0.25 or room < 0.32:
            continue
        top = min(0.44, 0.82 * room)  # of the headrest, above the waist
        parts.append(box((row, side, waist - 0.23 + top / 2), (0.14, 0.48, top + 0.12), Material.INTERIOR))
        parts.append(box((row, side, waist + top - 0.07), (0.09, 0.24, 0.14), Material.INTERIOR))
    return join_meshes(parts)


def _driver(profile: Profile, lower: _Lower, length: float, height: float) -> Mesh:
    """Return the head and torso of the driver, on the left front seat."""
    _, end, waist = _cabin_frame(profile, lower, length)
    x = end - FRONT_SEAT_M + 0.16
    side = float(lower.half.max()) * 0.45
    chin = min(0.22, 0.85 * _headroom(profile, length, height, x, waist) - 0.24)
    torso = box((x, side, waist + chin - 0.22), (0.20, 0.40, 0.44), Material.CLOTH)
    return join_meshes((torso, ellipsoid((x + 0.02, side, waist + chin + 0.11), (0.10, 0.08, 0.12), Material.SKIN, 6)))


def roof_sign(x: float, z: float) -> Mesh:
    """Return the mesh of a taxi's roof sign at `x` [m], its foot at height `z` [m], in the body frame."""
    return join_meshes(
        (
            box((x, 0, z + 0.02), (0.10, 0.30, 0.06), Material.TRIM),
            box((x, 0, z + 0.11), (0.14, 0.55, 0.14), Material.SIGN),
        )
    )

"""Light sources at one instant: signal lenses, head and tail lamps, street lamps, and their irradiance."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Array32, Bytes, Ints32
from flcav.geometry import heading_vectors, transform_points
from flcav.machine.compiled import inlined, kernel
from flcav.world.materials import Material
from flcav.world.meshes import actor_mesh
from flcav.world.scene import Scene

RED, AMBER, GREEN = 1, 2, 4  # flags of lit lenses
LENSES = {"r": RED, "R": RED, "y": AMBER, "Y": AMBER, "u": RED | AMBER, "g": GREEN, "G": GREEN, "o": AMBER}
BRAKING_MS2 = -0.6  # longitudinal acceleration below which brake lamps are on

STREET_LAMP = (4.6, 3.3, 1.75)  # intensity straight down
HEADLAMP = (17.0, 16.2, 14.5)  # intensity on the axis of a low beam
STREET_REACH_M, BEAM_REACH_M = 20.0, 45.0  # distances at which their light ends
CELL_M = 8.0  # side of the grid's cells


class LampState(NamedTuple):
    """Lit signal lenses of the town's things, and brightness of the instances' lamps."""

    lens: Bytes  # (K,) flags RED, AMBER and GREEN of the town's things
    head: Array32  # (I,) brightness of the head lamps, 0 to 1
    tail: Array32  # (I,) brightness of the tail lamps, 0 to 1; brakes included


class Lamps(NamedTuple):
    """K lamps that illuminate the scene, world frame, and a grid whose cells list the lamps in reach."""

    position: Array32  # (K, 3) [m]
    ahead: Array32  # (K, 3) unit direction of a beam; zero for a street lamp
    colour: Array32  # (K, 3) intensity straight down, or on the beam's axis
    corner: Array  # (2,) lowest x, y of the grid [m]
    first: Ints32  # (cells along x, cells along y + 1) start of a cell's list
    listed: Ints32  # lists of lamps, cell by cell


def compute_lamp_state(scene: Scene, lamps_on: float, low_sight: bool) -> LampState:
    """Return the lit lenses and vehicle lamps at the scene's instant.

    `lamps_on` (0 to 1) is the brightness of lamps by the sun's elevation; with `low_sight` (rain or fog), vehicles'
    lamps are also on by day. Lamps of parked vehicles are off.
    """
    trace = scene.trace
    index = scene.index
    letters = dict(zip(trace.light.tolist(), trace.light_state[index].tolist()))
    lens = [LENSES.get(letters.get(link, ""), 0) for link in scene.things.link]
    parked = np.char.startswith(trace.actor, "parked")
    on = np.where(parked | ~trace.present[index], 0.0, max(lamps_on, 0.8 if low_sight else 0.0))
    forward = heading_vectors(trace.yaw[index])
    along = np.nan_to_num((trace.acceleration[index, :, :2] * forward).sum(axis=1))
    stopped = np.nan_to_num(np.linalg.norm(trace.velocity[index], axis=1), nan=9.0) < 0.1
    braking = ((along < BRAKING_MS2) | stopped) & ~parked
    tail = np.where(braking, 1.0, 0.25 * on)
    return LampState(np.array(lens, np.uint8), *(np.append(0.0, row).astype(np.float32) for row in (on, tail)))


def collect_lamps(scene: Scene, state: LampState) -> Lamps:
    """Return the lamps that illuminate the scene: all street lamps, then the head lamps that are on."""
    street = scene.town.lamps - (0.0, 0.0, 0.08)
    street[:, 2] += scene.town.grounds(*street[:, :2].T)
    places = [street]
    beams = [np.zeros_like(street)]
    for actor in np.flatnonzero(state.head[1:] > 0.5):
        body = scene.world_from_actor(int(actor))
        heads, _ = lamp_places(*scene.trace.model(int(actor)))
        if len(heads):
            places.append(transform_points(body, heads))
            beams.append(np.tile(body[:3, 0] - (0, 0, 0.012), (len(heads), 1)))
    position, ahead = np.concatenate(places), np.concatenate(beams)
    reach = np.where(np.abs(ahead).sum(axis=1) > 0, BEAM_REACH_M, STREET_REACH_M)
    beam = np.abs(ahead).sum(axis=1, keepdims=True) > 0
    colour = np.where(beam, HEADLAMP, STREET_LAMP).astype(np.float32)
    return Lamps(position.astype(np.float32), ahead.astype(np.float32), colour, *_grid(position, ahead, reach))


def no_lamps() -> Lamps:
    """Return an empty set of lamps, for daylight."""
    none = np.zeros((0, 3))
    position, ahead, colour = (none.astype(np.float32) for _ in range(3))
    return Lamps(position, ahead, colour, *_grid(none, none, np.zeros(0)))


@lru_cache(maxsize=256)
def lamp_places(category: str, shape: int, size: tuple[float, ...] | None = None) -> tuple[Array, Array]:
    """Return the centres of an actor's head lamps (K, 3) and tail lamps (L, 3), body frame [m]."""
    mesh = actor_mesh(category, shape, size)
    centres = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)

    def centre(material: Material) -> Array:
        lamps = centres[mesh.material == material]
        sides = [lamps[lamps[:, 1] > 0.15], lamps[lamps[:, 1] < -0.15], lamps[np.abs(lamps[:, 1]) <= 0.15]]
        return np.array([side.mean(axis=0) for side in sides if len(side)]).reshape(-1, 3)

    return centre(Material.HEADLAMP), centre(Material.TAILLAMP)


@inlined
def lamp_light(lamp, x, y, z, nx, ny, nz, lamps):
    """Return the irradiance of a lamp over its intensity [1/m^2] at x, y, z [m] for the unit normal nx, ny, nz."""
    px, py, pz = lamps.position[lamp, 0] - x, lamps.position[lamp, 1] - y, lamps.position[lamp, 2] - z
    square = px * px + py * py + pz * pz
    faced = px * nx + py * ny + pz * nz
    if faced <= 0 or square > np.float32(BEAM_REACH_M * BEAM_REACH_M):
        return np.float32(0)
    distance = np.sqrt(square)
    incidence = faced / distance
    ax, ay, az = lamps.ahead[lamp, 0], lamps.ahead[lamp, 1], lamps.ahead[lamp, 2]
    if ax == 0 and ay == 0:
        down = pz / distance
        if down <= np.float32(0.05) or distance > STREET_REACH_M:
            return np.float32(0)
        end = 1 - square / np.float32(STREET_REACH_M * STREET_REACH_M)
        return incidence * down * (np.float32(0.55) + np.float32(0.45) / max(down, np.float32(0.25))) * end / square
    forward = -(px * ax + py * ay) / distance
    if forward <= np.float32(0.2) or distance > BEAM_REACH_M:
        return np.float32(0)
    aside = (px * ay - py * ax) / distance
    above = -pz / distance - az
    level = above * 14
    if above > 0:
        spread = max(np.float32(0.02), 1 - above * 60)
    else:
        spread = np.float32(0.85) / (1 + level * level * level * level) + np.float32(0.04)
    beam = max(np.float32(0), 1 - aside * aside * np.float32(2.6))
    end = 1 - square / np.float32(BEAM_REACH_M * BEAM_REACH_M)
    return incidence * spread * beam * beam * end / max(square, np.float32(9))


@kernel
def light_up(survey, lamps, light, most, towards, distance):
    """Write the irradiance of lamps at N hits: `light` (N, 3) of all but the strongest lamp, `most` (N, 3) of that one.

    `towards` (N, 3) and `distance` (N,) [m] are unit direction and length of the shadow ray to the strongest lamp; the
    length is -1 where there is none.
    """
    for ray in range(len(distance)):
        distance[ray] = -1
        if survey.row[ray] < 0:
            continue
        x, y, z = survey.position[ray, 0], survey.position[ray, 1], survey.position[ray, 2]
        i, j = int((x - lamps.corner[0]) / CELL_M), int((y - lamps.corner[1]) / CELL_M)
        if i < 0 or j < 0 or i >= lamps.first.shape[0] or j >= lamps.first.shape[1] - 1:
            continue
        nx, ny, nz = survey.normal[ray, 0], survey.normal[ray, 1], survey.normal[ray, 2]
        best, which = np.float32(1e-5), -1
        for place in range(lamps.first[i, j], lamps.first[i, j + 1]):
            lamp = lamps.listed[place]
            share = lamp_light(lamp, x, y, z, nx, ny, nz, lamps)
            if share <= 0:
                continue
            red, green, blue = (
                lamps.colour[lamp, 0] * share,
                lamps.colour[lamp, 1] * share,
                lamps.colour[lamp, 2] * share,
            )
            if red > best:
                light[ray, 0] += most[ray, 0]
                light[ray, 1] += most[ray, 1]
                light[ray, 2] += most[ray, 2]
                most[ray, 0], most[ray, 1], most[ray, 2] = red, green, blue
                best, which = red, lamp
            else:
                light[ray, 0] += red
                light[ray, 1] += green
                light[ray, 2] += blue
        if which >= 0:
            px, py, pz = lamps.position[which, 0] - x, lamps.position[which, 1] - y, lamps.position[which, 2] - z
            length = np.sqrt(px * px + py * py + pz * pz)
            towards[ray, 0], towards[ray, 1], towards[ray, 2] = px / length, py / length, pz / length
            distance[ray] = length - np.float32(0.6)


def _grid(position: Array, ahead: Array, reach: Array) -> tuple[Array, Ints32, Ints32]:
    if not len(position):
        return np.zeros(2), np.zeros((1, 2), np.int32), np.zeros(0, np.int32)
    corner = (position[:, :2] - reach[:, None]).min(axis=0)
    cells = np.ceil(((position[:, :2] + reach[:, None]).max(axis=0) - corner) / CELL_M).astype(int) + 1
    x, y = (corner[axis] + (np.arange(cells[axis]) + 0.5) * CELL_M for axis in (0, 1))
    dx = x[:, None, None] - position[:, 0]  # (X, 1, K)
    dy = y[None, :, None] - position[:, 1]
    within = dx**2 + dy**2 < (reach + 0.71 * CELL_M) ** 2
    beam = ahead.any(axis=1)
    within &= ~beam | (dx * ahead[:, 0] + dy * ahead[:, 1] > -CELL_M)
    count = within.sum(axis=2).ravel()
    starts = np.append(0, np.cumsum(count)).astype(np.int32)
    first = np.empty((cells[0], cells[1] + 1), np.int32)
    first[:, :-1] = starts[:-1].reshape(cells)
    first[:, -1] = starts[cells[1] :: cells[1]]
    return corner, first, np.nonzero(within)[2].astype(np.int32)

"""Lens glare: halos around lamps, and veiling glare of the sun."""

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import heading_vectors, inverse, transform_points
from flcav.machine.compiled import compiled
from flcav.sensors.lens import Lens, project
from flcav.sensors.rendering.light import DARK, Illumination
from flcav.sensors.rendering.state import AMBER, GREEN, RED, LampState, lamp_places
from flcav.world.materials import Material
from flcav.world.meshes.furniture import LENS_PITCH_M, SIGNAL_LENSES
from flcav.world.scene import Scene

HEAD, TAIL, STREET, SIGNAL = 9.0, 0.55, 1.6, 0.35  # strengths of the halos
HEAD_COLOUR, TAIL_COLOUR, STREET_COLOUR = (1.0, 0.95, 0.86), (1.0, 0.05, 0.03), (1.0, 0.74, 0.40)
SIGNAL_COLOURS = {RED: (1.0, 0.05, 0.03), AMBER: (1.0, 0.5, 0.03), GREEN: (0.06, 1.0, 0.55)}
FLAGS = {Material.LENS_RED: RED, Material.LENS_AMBER: AMBER, Material.LENS_GREEN: GREEN}
FARTHEST_M = 150.0  # of lamps with halos
SUN_RAYS, SUN_RAD, SUN_REACH_M = 16, 0.0046, 1000.0  # rays over the sun's disc, its angular radius, rays' length
SUN_SPREAD_RAD, SUN_VEIL_RAD = 0.016, 0.16  # widths of the lens' narrow and wide scattering of the sun
SUN_STRENGTH, VEIL_STRENGTH = 9.0, 0.22  # of the narrow and of the wide scattering
HAZE_M = 500.0  # path through the air before the sun
BESIDE = 0.25  # distance of the sun from the image's edge, over its size, up to which it causes glare

Glowing = tuple[NDArray[np.float64], tuple[float, float, float], float]  # place, colour, strength


def add_glare(
    image: NDArray[np.float32],
    scene: Scene,
    state: LampState,
    light: Illumination,
    world_from_camera: NDArray[np.float64],
    lens: Lens,
    hidden: int | None,
) -> None:
    """Add a halo to an image (H, W, 3) for every lamp that is on and not hidden from the camera."""
    glowing = [row for row in _glowing(scene, state, light, world_from_camera[:3, 3], hidden) if row[2] > 0.01]
    if not glowing:
        return
    places = np.array([place for place, _, _ in glowing])
    eye = world_from_camera[:3, 3]
    away = places - eye
    distance = np.linalg.norm(away, axis=1)
    local = transform_points(inverse(world_from_camera), places)
    pixels = project(lens, local)
    inside = (local[:, 2] > 0.5) & (distance < FARTHEST_M)
    inside &= (np.abs(pixels - (lens.width / 2, lens.height / 2)) < (lens.width, lens.height)).all(axis=1)
    far = np.where(inside, distance - 0.5, -1.0)
    towards = (away / distance[:, None]).astype(np.float32)
    hides = scene.find_occluded(
        np.tile(eye, (len(places), 1)).astype(np.float32), towards, far.astype(np.float32), hidden=hidden
    )
    kept = inside & ~hides
    colour = np.array([np.multiply(colour, strength) for _, colour, strength in glowing])[kept]
    focal = lens.intrinsics()[0, 0]
    near = distance[kept]
    through = np.exp(-float(light.extinction) * near)
    size = focal * 0.14 / near + focal * 0.010 * (1 + min(150.0 * float(light.extinction), 4.0))
    power = colour * (through / (1 + (near / 25.0) ** 2))[:, None] * 1.8 * (0.3 + 0.7 * float(light.lamps))
    _draw(image, pixels[kept], power, size)


def add_sun_glare(
    image: NDArray[np.float32],
    scene: Scene,
    light: Illumination,
    world_from_camera: NDArray[np.float64],
    lens: Lens,
    hidden: int | None,
) -> None:
    """Add the veiling glare of the sun to an image (H, W, 3), by the share of its disc that is visible."""
    to_sun, eye = np.array(light.to_sun, np.float64), world_from_camera[:3, 3]
    towards = world_from_camera[:3, :3].T @ to_sun
    pixel = project(lens, towards)[0]
    size = np.array((lens.width, lens.height))
    if max(light.sun) < DARK or not (np.abs(pixel - size / 2) < (0.5 + BESIDE) * size).all():
        return
    turn = np.arange(SUN_RAYS) * 2.399963
    across = (
        np.stack((np.cos(turn), np.sin(turn), 0 * turn), axis=1)
        * np.sqrt((np.arange(SUN_RAYS) + 0.5) / SUN_RAYS)[:, None]
    )
    rays = (towards + SUN_RAD * across) @ world_from_camera[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    far = np.full(SUN_RAYS, SUN_REACH_M, np.float32)
    eyes = np.tile(eye, (SUN_RAYS, 1)).astype(np.float32)
    free = 1 - float(scene.find_occluded(eyes, rays.astype(np.float32), far, hidden=hidden).mean())
    if free > 0:
        power = free * np.array(light.sun) * np.exp(-float(light.extinction) * HAZE_M)
        focal = lens.intrinsics()[0, 0]
        _veil(image, pixel, power.astype(np.float32), 1 / (SUN_SPREAD_RAD * focal), 1 / (SUN_VEIL_RAD * focal))


def _glowing(
    scene: Scene, state: LampState, light: Illumination, eye: NDArray[np.float64], hidden: int | None
) -> list[Glowing]:
    trace, out = scene.trace, []
    for actor in np.flatnonzero((state.head[1:] > 0) | (state.tail[1:] > 0)):
        if actor == hidden or not trace.present[scene.index, actor]:
            continue
        body = scene.world_from_actor(int(actor))
        heads, tails = lamp_places(*trace.model(int(actor)))
        towards = (eye - body[:3, 3]) / (np.linalg.norm(eye - body[:3, 3]) + 1e-6)
        ahead = float(towards @ body[:3, 0])
        for place in transform_points(body, heads):
            out.append((place, HEAD_COLOUR, HEAD * float(state.head[actor + 1]) * max(ahead, 0.0) ** 4))
        for place in transform_points(body, tails):
            out.append((place, TAIL_COLOUR, TAIL * float(state.tail[actor + 1]) * max(-ahead, 0.0) ** 2))
    if light.lamps > 0:
        street = STREET * float(light.lamps)
        for x, y, z in scene.town.lamps:
            out.append((np.array((x, y, z - 0.2 + scene.town.ground(x, y))), STREET_COLOUR, street))
        things = scene.things
        for number, (place, yaw, kind) in enumerate(zip(things.position, things.yaw, things.kind)):
            cos, sin = heading_vectors(yaw)
            ahead = (eye - place) @ (cos, sin, 0.0)
            if kind in SIGNAL_LENSES and ahead > 0:
                for material, place_up in SIGNAL_LENSES[kind]:
                    lens = FLAGS[material]
                    if state.lens[number] & lens:
                        lit = place + np.array((0.2 * cos, 0.2 * sin, place_up * LENS_PITCH_M))
                        out.append((lit, SIGNAL_COLOURS[lens], SIGNAL * float(light.lamps)))
    return out


@compiled
def _draw(image, pixel, power, size):
    height, width = image.shape[0], image.shape[1]
    for lamp in range(len(size)):
        reach = 5 * size[lamp]
        for y in range(max(int(pixel[lamp, 1] - reach), 0), min(int(pixel[lamp, 1] + reach) + 1, height)):
            for x in range(max(int(pixel[lamp, 0] - reach), 0), min(int(pixel[lamp, 0] + reach) + 1, width)):
                square = (x - pixel[lamp, 0]) ** 2 + (y - pixel[lamp, 1]) ** 2
                share = square / (size[lamp] * size[lamp])
                edge = max(1 - square / (reach * reach), 0.0)
                halo = edge * edge * (0.20 / (1 + 9 * share) + 0.012 / (1 + share))
                for band in range(3):
                    image[y, x, band] += np.float32(power[lamp, band] * halo)


@compiled
def _veil(image, pixel, power, narrow, wide):
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            square = np.float32((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2)
            near, far = 1 + square * np.float32(narrow * narrow), 1 + square * np.float32(wide * wide)
            share = np.float32(SUN_STRENGTH) / (near * np.sqrt(near)) + np.float32(VEIL_STRENGTH) / far
            for band in range(3):
                image[y, x, band] += share * power[band]

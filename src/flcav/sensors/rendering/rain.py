"""Rain and glare in camera images: wet roads, streaks, drops on the lens, halos of lamps, the sun's veiling glare."""

import numpy as np

from flcav.arrays import Array, Array32
from flcav.geometry import heading_vectors, inverse, transform_points
from flcav.machine.compiled import compiled
from flcav.sensors.lens import Lens, project_optical
from flcav.sensors.rendering.light import DARK, Illumination
from flcav.sensors.rendering.noise import sample_noise
from flcav.sensors.rendering.state import AMBER, GREEN, RED, LampState, lamp_places
from flcav.world.materials import Material
from flcav.world.meshes.furniture import LENS_PITCH_M, SIGNAL_LENSES
from flcav.world.scene import Scene

ROAD = int(Material.ROAD)
WATER = 0.02  # Fresnel reflectance at normal incidence
SMEAR_PX = 15  # half height of the blur of reflections, in pixels of an image of half the size
RIPPLE_PX = 4.0  # sideways displacement by ripples, in the same pixels
STREAKS_PER_MM = 55.0  # number in an image of 640 x 384 at 1 mm/h; grows as rain^0.6
DROPS_PER_MM = 3.0  # number on a lens at 1 mm/h, for any image size; grows as rain^0.6
DROP_VIEW = 0.45  # share of the image's height that a drop shows, upside down
BLOCK_PX = 8  # drops are out of focus: they show means over squares of this side


@compiled
def wet_pixels(seen, appearance, width, height):
    """Return the indices (K,) of road pixels in every second row and column."""
    pixels = np.empty((width // 2) * (height // 2), np.int64)
    count = 0
    for j in range(height // 2):
        for i in range(width // 2):
            pixel = 2 * j * width + 2 * i
            row = seen.row[pixel]
            if row >= 0 and seen.instance[pixel] == 0 and appearance.material[row] == ROAD:
                pixels[count] = pixel
                count += 1
    return pixels[:count]


@compiled
def smear(image, weight, width, height, out):
    """Blur `image` (H, W, 3) vertically, as ripples do, into `out`; pixels without `weight` (H, W) do not count."""
    for i in range(width):
        for j in range(height):
            total = np.float32(0)
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for b in range(max(j - SMEAR_PX, 0), min(j + SMEAR_PX + 1, height)):
                near = np.float32(SMEAR_PX + 1 - abs(b - j))
                share = weight[b, i] * near * near
                total += share
                red += share * image[b, i, 0]
                green += share * image[b, i, 1]
                blue += share * image[b, i, 2]
            if total > 0:
                out[j, i, 0], out[j, i, 1], out[j, i, 2] = red / total, green / total, blue / total


@compiled
def add_mirrored(radiance, seen, appearance, mirrored, wetness, extinction, width):
    """Add the reflections `mirrored` (H / 2, W / 2, 3) to road pixels, by Fresnel reflectance and puddles.

    `radiance` is (H * W, 3), `extinction` in [1/m], `wetness` 0 to 1.
    """
    height = len(radiance) // width
    for pixel in range(len(radiance)):
        row = seen.row[pixel]
        if row < 0 or seen.instance[pixel] != 0 or appearance.material[row] != ROAD:
            continue
        x, y = seen.position[pixel, 0], seen.position[pixel, 1]
        level = sample_noise(appearance.noise, x * 0.45 + 11.0, y * 0.45) * np.float32(0.6)
        level += sample_noise(appearance.noise, x * 0.10, y * 0.10 + 29.0) * np.float32(0.4)
        puddle = min(max((level - np.float32(1.02) + np.float32(0.75) * wetness) * 4, np.float32(0)), np.float32(1))
        facing = -seen.ray[pixel, 2]
        grazing = 1 - facing
        # Schlick's approximation of the Fresnel reflectance
        share = np.float32(WATER) + (1 - np.float32(WATER)) * grazing * grazing * grazing * grazing * grazing
        share *= wetness * (np.float32(0.35) + np.float32(0.65) * puddle)
        share *= np.exp(-extinction * seen.distance[pixel])
        ripple = (sample_noise(appearance.noise, x * 5.0, y * 5.0) - np.float32(0.5)) * RIPPLE_PX
        j = min(pixel // width // 2, height // 2 - 1)
        i = min(max(int(pixel % width / 2 + ripple), 0), width // 2 - 1)
        for band in range(3):
            radiance[pixel, band] += share * (mirrored[j, i, band] - np.float32(0.4) * radiance[pixel, band])


def add_streaks(image: Array32, rain_mm_h: float, brightness: Array, rng: np.random.Generator) -> None:
    """Draw motion-blurred streaks of falling drops with the radiance `brightness` (3,) into an image (H, W, 3)."""
    height, width = image.shape[:2]
    count = int(STREAKS_PER_MM * rain_mm_h**0.6 * width * height / (640 * 384))
    size = rng.random(count) ** 3  # 1 is nearest; few are near
    place = rng.random((count, 2)) * (width, height)
    length = (0.02 + 0.16 * size) * height
    slant = rng.normal(0.06, 0.03, count)
    strength = (0.14 + 0.26 * rng.random(count)) * (0.6 + 0.4 * size)
    thick = (0.5 + 1.6 * size) * height / 384
    _draw_streaks(image, place, length, slant, strength, thick, brightness)


@compiled
def _draw_streaks(image, place, length, slant, strength, thick, brightness):
    height, width = image.shape[0], image.shape[1]
    for drop in range(len(length)):
        for step in range(int(length[drop]) + 1):
            y = int(place[drop, 1]) + step
            if y >= height:
                break
            x = place[drop, 0] + slant[drop] * step
            along = 1 - abs(2 * step / (length[drop] + 1) - 1)
            for column in range(int(x - thick[drop]), int(x + thick[drop]) + 2):
                if column < 0 or column >= width:
                    continue
                share = strength[drop] * along * max(1 - abs(column - x) / (thick[drop] + 0.5), 0.0)
                for band in range(3):
                    image[y, column, band] += np.float32(share * (brightness[band] - image[y, column, band]))


def add_drops(image: Array32, rain_mm_h: float, rng: np.random.Generator) -> None:
    """Draw drops on the lens into an image (H, W, 3): they show small, blurred, inverted views of the scene."""
    height, width = image.shape[:2]
    count = int(rng.poisson(DROPS_PER_MM * rain_mm_h**0.6))
    place = rng.random((count, 2)) * (width, height)
    radius = height * np.minimum(0.012 * np.exp(0.5 * rng.standard_normal(count)), 0.045)
    blocks = np.empty((max(height // BLOCK_PX, 1), max(width // BLOCK_PX, 1), 3), np.float32)
    _shrink(image, blocks)
    _draw_drops(image, blocks, place, radius, rng.uniform(1.0, 1.35, count))


@compiled
def _shrink(image, blocks):
    for j in range(blocks.shape[0]):
        for i in range(blocks.shape[1]):
            for band in range(3):
                total = np.float32(0)
                for y in range(j * BLOCK_PX, (j + 1) * BLOCK_PX, 2):
                    for x in range(i * BLOCK_PX, (i + 1) * BLOCK_PX, 2):
                        total += image[min(y, image.shape[0] - 1), min(x, image.shape[1] - 1), band]
                blocks[j, i, band] = total / (BLOCK_PX * BLOCK_PX // 4)


@compiled
def _draw_drops(image, blocks, place, radius, tall):
    height, width = image.shape[0], image.shape[1]
    for drop in range(len(radius)):
        view = np.float32(DROP_VIEW / 2 * height) / radius[drop]
        reach = radius[drop] * tall[drop]
        for y in range(max(int(place[drop, 1] - reach), 0), min(int(place[drop, 1] + reach) + 2, height)):
            for x in range(max(int(place[drop, 0] - reach), 0), min(int(place[drop, 0] + reach) + 2, width)):
                right, down = x - place[drop, 0], (y - place[drop, 1]) / tall[drop]
                if down < 0:
                    right *= 1 - 0.25 * down / radius[drop]  # drops that run down are narrower above
                apart = np.sqrt(right * right + down * down) / radius[drop]
                share = np.float32(min(max((1 - apart) * 2, 0.0), 0.9))
                if share <= 0:
                    continue
                bent = view * (1 + apart * apart)
                i = int(min(max((place[drop, 0] - right * bent) / BLOCK_PX, 0), blocks.shape[1] - 1))
                j = int(min(max((place[drop, 1] - down * bent) / BLOCK_PX, 0), blocks.shape[0] - 1))
                rim = np.float32(1.05 - 0.45 * apart * apart * apart)
                for band in range(3):
                    image[y, x, band] += share * (rim * blocks[j, i, band] - image[y, x, band])


HEAD, TAIL, STREET, SIGNAL = 9.0, 0.55, 1.6, 0.35  # strengths of halos
HEAD_COLOUR, TAIL_COLOUR, STREET_COLOUR = (1.0, 0.95, 0.86), (1.0, 0.05, 0.03), (1.0, 0.74, 0.40)
SIGNAL_COLOURS = {RED: (1.0, 0.05, 0.03), AMBER: (1.0, 0.5, 0.03), GREEN: (0.06, 1.0, 0.55)}
FLAGS = {Material.LENS_RED: RED, Material.LENS_AMBER: AMBER, Material.LENS_GREEN: GREEN}
FARTHEST_M = 150.0  # greatest distance of lamps with halos
SUN_RAYS, SUN_RAD, SUN_REACH_M = 16, 0.0046, 1000.0  # rays over the sun's disc, its angular radius, rays' length
SUN_SPREAD_RAD, SUN_VEIL_RAD = 0.016, 0.16  # widths of the narrow and wide scattering of sunlight in the lens
SUN_STRENGTH, VEIL_STRENGTH = 9.0, 0.22  # strengths of the narrow and the wide scattering
HAZE_M = 500.0  # length of the path of sunlight through the air
BESIDE = 0.25  # distance of the sun from the image's edge, over its size, up to which it causes glare

Glowing = tuple[Array, tuple[float, float, float], float]  # position [m], world frame, colour, strength


def add_glare(
    image: Array32,
    scene: Scene,
    state: LampState,
    light: Illumination,
    world_from_camera: Array,
    lens: Lens,
    hidden: int | None,
) -> None:
    """Add a halo to an image (H, W, 3) for every lamp that is on and visible from the camera."""
    glowing = [row for row in _glowing(scene, state, light, world_from_camera[:3, 3], hidden) if row[2] > 0.01]
    if not glowing:
        return
    places = np.array([place for place, _, _ in glowing])
    eye = world_from_camera[:3, 3]
    away = places - eye
    distance = np.linalg.norm(away, axis=1)
    local = transform_points(inverse(world_from_camera), places)
    pixels = project_optical(lens, local)
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
    image: Array32, scene: Scene, light: Illumination, world_from_camera: Array, lens: Lens, hidden: int | None
) -> None:
    """Add the veiling glare of the sun to an image (H, W, 3), in proportion to the visible share of its disc."""
    to_sun, eye = np.array(light.to_sun, np.float64), world_from_camera[:3, 3]
    towards = world_from_camera[:3, :3].T @ to_sun
    pixel = project_optical(lens, towards)[0]
    size = np.array((lens.width, lens.height))
    if max(light.sun) < DARK or not (np.abs(pixel - size / 2) < (0.5 + BESIDE) * size).all():
        return
    turn = np.arange(SUN_RAYS) * 2.399963  # the golden angle: points spread evenly over a disc (Vogel's spiral)
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


def _glowing(scene: Scene, state: LampState, light: Illumination, eye: Array, hidden: int | None) -> list[Glowing]:
    trace = scene.trace
    out = []
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

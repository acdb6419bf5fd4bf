"""Deferred renderer: primary rays, G-buffer, shading, wet reflections, supersampling, rain and glare, in this order.

The result is the radiance of every pixel; exposure and tone mapping follow in `flcav.sensors.camera`.

Supersampling is adaptive: pixels at visible edges get two more rays, which form a pattern of three rooks with the
first; pixels that a thin distant object may cross get eight more, in a pattern of nine rooks. So a pole covers a share
of its pixels that corresponds to its width, whether or not a pixel's centre hits it.
"""

from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Array32, Bytes, Ints32, Mask
from flcav.geometry import inverse, transform_points
from flcav.machine.compiled import compiled
from flcav.machine.threads import keep_freed_memory, share_among_threads
from flcav.sensors.lens import Lens, compute_pixel_rays, project_optical
from flcav.sensors.rendering import rain
from flcav.sensors.rendering.appearance import Appearance, build_appearance
from flcav.sensors.rendering.gbuffer import GBuffer, fill_gbuffer
from flcav.sensors.rendering.light import (
    Illumination,
    compute_ambient_occlusion,
    compute_lamplight,
    compute_light,
    compute_sun_visibility,
    soften,
)
from flcav.sensors.rendering.rain import add_glare, add_sun_glare
from flcav.sensors.rendering.state import Lamps, LampState, collect_lamps, compute_lamp_state, no_lamps
from flcav.sensors.rendering.surface import mark_paint, shade
from flcav.world.map.town import Town
from flcav.world.materials import Material
from flcav.world.rays.packets import Hits
from flcav.world.scene import Scene
from flcav.world.weather import Weather

FAR_M = 1000.0  # length of primary rays
LOW_SIGHT = 0.002  # extinction [1/m] above which vehicles' lamps are on by day
MIRRORS = 0.2  # wetness above which roads show reflections
NO_LAMPS = np.zeros((0, 3), np.float32)


class RadianceImage(NamedTuple):
    """An image as radiance, with its exposure, G-buffer and appearance tables."""

    radiance: Array32  # (N, 3) of the pixels, in row order
    exposure: np.float32  # factor of the radiance before tone mapping
    seen: GBuffer  # G-buffer of the primary rays
    painted: Mask  # (N,) whether the pixel shows a road marking
    appearance: Appearance


class _World(NamedTuple):
    scene: Scene
    appearance: Appearance
    light: Illumination
    state: LampState
    lamps: Lamps
    pixel_angle: np.float32
    hidden: int | None
    threads: int


def render_radiance(
    scene: Scene,
    world_from_camera: Array,
    lens: Lens,
    weather: Weather,
    rng: np.random.Generator,
    *,
    hidden: int | None,
    threads: int = 1,
    fine: bool = False,
) -> RadianceImage:
    """Render the radiance of the pixels of `lens` at the scene's instant: see `camera.photograph`.

    `world_from_camera` (4, 4) [m] is the pose of the optical frame, `hidden` the actor that is left out (the carrier);
    `rng` draws the rain. Rays are cast and shaded by `threads` threads. `fine`: see `Camera.look`.
    """
    keep_freed_memory()
    rays, light, appearance = compute_pixel_rays(lens), compute_light(weather), build_appearance(scene)
    appearance = appearance._replace(fine=np.bool_(fine))
    state = compute_lamp_state(scene, float(light.lamps), low_sight=bool(light.extinction > LOW_SIGHT))
    angle = np.float32(1 / lens.intrinsics()[0, 0])
    lamps = collect_lamps(scene, state) if light.lamps > 0 else no_lamps()
    world = _World(scene, appearance, light, state, lamps, angle, hidden, threads)
    seen = _meet(world, world_from_camera, rays)
    open_sky = compute_ambient_occlusion(scene, seen, lens, hidden, threads)
    radiance, painted = _radiance(world, seen, open_sky, lens.width)
    if light.wetness > MIRRORS:
        _mirror(world, world_from_camera, lens, rays, seen, radiance)
    kind = find_edges(seen, radiance, light.exposure, appearance, lens, threads)
    mark_thin(kind, scene.town, world_from_camera, lens, seen)
    further, pixel = further_rays(rays, kind, lens)
    if len(pixel):
        more = _further(world, world_from_camera, further, pixel, lens.width, seen, open_sky, radiance)
        average_samples(radiance, more, pixel, np.float32(BRIGHTEST / light.exposure))
    image = radiance.reshape(lens.height, lens.width, 3)
    if weather.rain_mm_h > 0:
        rain.add_streaks(image, weather.rain_mm_h, 0.75 * np.array(light.horizon) + 0.05 * np.array(light.sun), rng)
    if state.head.any() or light.lamps > 0:
        add_glare(image, scene, state, light, world_from_camera, lens, hidden)
    add_sun_glare(image, scene, light, world_from_camera, lens, hidden)
    return RadianceImage(radiance, light.exposure, seen, painted, appearance)


def survey(
    scene: Scene, world_from_camera: Array, lens: Lens, *, hidden: int | None, threads: int = 1
) -> tuple[GBuffer, Mask, Appearance]:
    """Return the G-buffer of the pixels' centres, where they show road markings (N,), and the appearance tables.

    Arguments are those of `render_radiance`.
    """
    rays, appearance = compute_pixel_rays(lens), build_appearance(scene)
    hits = scene.cast(world_from_camera, rays, far_m=FAR_M, hidden=hidden, threads=threads)
    seen = fill_gbuffer(scene, appearance, world_from_camera, rays, hits, threads)
    painted = np.empty(len(seen), np.bool_)
    angle = np.float32(1 / lens.intrinsics()[0, 0])

    def mark(first: int, last: int) -> None:
        at = slice(first, last)
        mark_paint(seen.part(at), appearance, angle, painted[at])

    share_among_threads(mark, len(seen), threads)
    return seen, painted, appearance


def _meet(world: _World, world_from_camera: Array, rays: Array32, near_m: Array32 | None = None) -> GBuffer:
    reach, hidden, threads = FAR_M, world.hidden, world.threads
    hits = world.scene.cast(world_from_camera, rays, near_m=near_m, far_m=reach, hidden=hidden, threads=threads)
    return fill_gbuffer(world.scene, world.appearance, world_from_camera, rays, hits, threads)


def _radiance(world: _World, seen: GBuffer, open_sky: Array32, width: int | None = None) -> tuple[Array32, Mask]:
    scene, light, hidden, threads = world.scene, world.light, world.hidden, world.threads
    lit = compute_sun_visibility(scene, seen, light, hidden, threads)
    if width is not None:  # the rays are those of a whole image
        lit = soften(lit, seen, width, threads)
    lamplight = compute_lamplight(scene, seen, world.lamps, hidden, threads) if light.lamps > 0 else NO_LAMPS
    radiance, painted = np.empty((len(seen), 3), np.float32), np.empty(len(seen), np.bool_)
    tables, angle = (light, world.appearance, world.state), world.pixel_angle

    def shade_part(first: int, last: int) -> None:
        at = slice(first, last)
        shade(seen.part(at), *tables, lit[at], lamplight[at], open_sky[at], angle, radiance[at], painted[at])

    share_among_threads(shade_part, len(seen), threads)
    return radiance, painted


def _further(
    world: _World,
    world_from_camera: Array,
    rays: Array32,
    pixel: Ints32,
    width: int,
    seen: GBuffer,
    open_sky: Array32,
    radiance: Array32,
) -> Array32:
    """Return the radiance (S, 3) of further rays in the pixels `pixel` (S,), copied from a pixel nearby, or shaded."""
    scene = world.scene
    appearance = world.appearance
    hits = scene.cast(world_from_camera, rays, far_m=FAR_M, hidden=world.hidden, threads=world.threads)
    donor = np.empty(len(rays), np.int32)
    donors(hits, pixel, seen, scene.surfaces.first, appearance.material, width, donor)
    out = radiance[donor]
    rest = np.flatnonzero(donor < 0)
    unknown = Hits(hits.distance[rest], hits.instance[rest], hits.face[rest])
    unknown_seen = fill_gbuffer(scene, appearance, world_from_camera, rays[rest], unknown)
    finer = world._replace(pixel_angle=world.pixel_angle / ROOKS)
    out[rest], _ = _radiance(finer, unknown_seen, open_sky[pixel[rest]])
    return out


def _mirror(
    world: _World, world_from_camera: Array, lens: Lens, rays: Array32, seen: GBuffer, radiance: Array32
) -> None:
    """Add planar reflections to wet roads: rays are cast from the camera mirrored at the road's plane, z = 0."""
    wet = rain.wet_pixels(seen, world.appearance, lens.width, lens.height)
    if not len(wet):
        return
    below = np.diag((1.0, 1.0, -1.0, 1.0)) @ world_from_camera
    met = _meet(world, below, np.ascontiguousarray(rays[wet]), near_m=seen.distance[wet] + np.float32(0.05))
    reflected, _ = _radiance(world, met, np.ones(len(wet), np.float32))
    width, height = lens.width // 2, lens.height // 2
    image, weight = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    j, i = wet // lens.width // 2, wet % lens.width // 2
    image[j, i], weight[j, i] = reflected, 1
    smeared = np.zeros_like(image)
    rain.smear(image, weight, width, height, smeared)
    light = world.light
    rain.add_mirrored(radiance, seen, world.appearance, smeared, light.wetness, light.extinction, lens.width)


LEAF = int(Material.LEAF)
EDGE, THIN = 1, 2  # flags of a pixel
BEND = 0.93  # cosine between the normals of two pixels below which there is an edge
STEP = 0.02  # distance from the other pixel's plane, over range, above which there is an edge
CONTRAST = 0.03  # difference over sum of two pixels' radiance below which an edge is not visible
DARK = 0.02  # exposed radiance that is added to that sum: no edges in the dark
THIN_PX = 4.0  # width below which objects are thin
REACH_PX = 0.8  # margin around thin objects
FARTHEST_M = 220.0  # greatest distance of thin objects
POST_M, SIGN_M, SIGNAL_M = 0.1, 0.42, 0.6  # half widths of thin objects
SIGN = int(Material.SIGN)
ROOKS = np.float32(3)  # factor by which the footprint of a further ray is narrower than its pixel
_THREE = np.array([(-1, 1), (1, -1)], np.float32) / 3
_NINE = np.array([(-4, -1), (-3, 2), (-2, -3), (-1, 4), (1, -4), (2, 3), (3, -2), (4, 1)], np.float32) / 9
BRIGHTEST = 3.0  # exposed radiance at which samples are clamped: otherwise edges of lamps would stay jagged


def find_edges(
    seen: GBuffer, radiance: Array32, exposure: np.float32, appearance: Appearance, lens: Lens, threads: int = 1
) -> Bytes:
    """Return (N,) EDGE for pixels at visible edges, else 0, from the G-buffer and the `radiance` (N, 3)."""
    out = np.zeros(len(seen), np.uint8)
    dark = np.float32(DARK / exposure)

    def find_part(first: int, last: int) -> None:
        _edges(seen, radiance, dark, appearance.material, lens.width, first, last, out)

    share_among_threads(find_part, lens.height, threads)
    return out


def mark_thin(kind: Bytes, town: Town, world_from_camera: Array, lens: Lens, seen: GBuffer) -> None:
    """Set THIN in `kind` (N,) for pixels that a lamp, mast, sign or signal head may cross with nothing in front."""
    bars = thin_bars(town)
    camera_from_world = inverse(world_from_camera)
    ends = [transform_points(camera_from_world, bars[:, part]) for part in (slice(0, 3), slice(3, 6))]
    near = np.minimum(ends[0][:, 2], ends[1][:, 2])
    kept = (near > 2.0) & (near < FARTHEST_M)
    pixels = [project_optical(lens, end[kept]) for end in ends]
    focal = lens.intrinsics()[0, 0]
    half_px = bars[kept, 6] * focal / near[kept]
    small = (half_px * 2 < THIN_PX) | (bars[kept, 6] > POST_M) & (half_px * 2 < 6 * THIN_PX)
    small &= np.isfinite(pixels[0]).all(axis=1) & np.isfinite(pixels[1]).all(axis=1)
    _draw_bars(
        pixels[0][small],
        pixels[1][small],
        half_px[small],
        near[kept][small],
        seen.distance,
        lens.width,
        kind,
    )


def thin_bars(town: Town) -> Array:
    """Return the thin objects of a town as bars (K, 7): both ends x, y, z and half width [m], world frame."""
    rows = [(x, y, 0, x, y, height, POST_M) for x, y, height in town.lamps]
    rows += [(x, y, 0, x, y, z, POST_M) for x, y, z in town.poles.position]
    for x, y, z in town.signs.position:
        rows += [(x, y, 0, x, y, z, POST_M), (x, y, z - 0.36, x, y, z + 0.36, SIGN_M)]
    for (x, y, z), foot in zip(town.signals.position, town.signals.foot):
        rows += [(*foot, 0, *foot, z + 0.25, POST_M), (*foot, z, x, y, z, POST_M)]
        rows.append((x, y, z - 0.6, x, y, z + 0.6, SIGNAL_M))
    return np.array(rows, np.float64).reshape(-1, 7)


@compiled
def _edges(seen, radiance, dark, material, width, first, last, out):
    row = seen.row
    column = 0
    for pixel in range(
        max(first * width, 0), last * width
    ):  # the `max` proves to the compiler that indices are not negative
        column = column + 1 if column < width else 1  # counted from 1
        for side in range(2):
            if side == 0 and column == width:
                continue
            other = pixel + (width if side else 1)
            if other >= len(out) or row[pixel] == row[other]:
                continue
            edge = row[pixel] < 0 or row[other] < 0 or seen.instance[pixel] != seen.instance[other]
            if not edge and not (material[row[pixel]] == LEAF and material[row[other]] == LEAF):
                bend, off = np.float32(0), np.float32(0)
                for axis in range(3):
                    bend += seen.normal[pixel, axis] * seen.normal[other, axis]
                    off += seen.normal[pixel, axis] * (seen.position[other, axis] - seen.position[pixel, axis])
                edge = bend < BEND or abs(off) > STEP * min(seen.distance[pixel], seen.distance[other])
            if edge:
                for band in range(3):
                    one, two = radiance[pixel, band], radiance[other, band]
                    if abs(one - two) > np.float32(CONTRAST) * (one + two + dark):
                        out[pixel], out[other] = EDGE, EDGE


@compiled
def _draw_bars(start, end, half, near, distance, width, kind):
    height = len(kind) // width
    for bar in range(len(half)):
        along_x, along_y = end[bar, 0] - start[bar, 0], end[bar, 1] - start[bar, 1]
        steps = int(max(abs(along_x), abs(along_y))) + 1
        if steps > 4 * (width + height):
            continue
        reach = half[bar] + REACH_PX
        for step in range(steps + 1):
            x = start[bar, 0] + along_x * step / steps
            y = start[bar, 1] + along_y * step / steps
            flat = abs(along_y) < abs(along_x)
            middle = y if flat else x
            for aside in range(int(np.ceil(middle - reach)), int(np.floor(middle + reach)) + 1):
                column, row = (round(x), aside) if flat else (aside, round(y))
                if column < 0 or row < 0 or column >= width or row >= height:
                    continue
                pixel = row * width + column
                if distance[pixel] > near[bar] - 1.0:
                    kind[pixel] |= THIN


def further_rays(rays: Array32, kind: Bytes, lens: Lens) -> tuple[Array32, Ints32]:
    """Return further unit rays (S, 3), optical frame, for pixels flagged in `kind` (N,), and their pixels (S,)."""
    flagged = kind[kind > 0]
    total = int(np.bincount(flagged, minlength=4) @ (0, len(_THREE), len(_NINE), len(_NINE)))
    directions, pixel = np.empty((total, 3), np.float32), np.empty(total, np.int32)
    _spread(rays, kind, lens.width, directions, pixel)
    return directions, pixel


@compiled
def donors(hits, pixel, seen, first, material, width, out):
    """Write to `out` (S,) the pixel whose radiance a further ray copies: this pixel or a neighbour on the same face.

    It is -1 where no neighbour has the ray's face, and on signs, whose letters are finer than pixels; textures of other
    faces are smooth over pixels. `first` and `material` are those of `Scene.surfaces`.
    """
    for sample in range(len(pixel)):
        out[sample] = -1
        centre, instance, row = pixel[sample], hits.instance[sample], -1
        if instance >= 0:
            row = first[instance] + hits.face[sample]
            if material[row] == SIGN:
                continue
        for step in (0, -1, 1, -width, width, -width - 1, -width + 1, width - 1, width + 1):
            other = centre + step
            if other >= 0 and other < len(seen.row) and seen.row[other] == row and seen.instance[other] == instance:
                out[sample] = other
                break


@compiled
def average_samples(radiance, further, pixel, ceiling):
    """Replace the `radiance` of pixels by the mean with their `further` samples (S, 3), clamped to `ceiling`."""
    start = 0
    while start < len(pixel):
        centre = pixel[start]
        end = start
        while end < len(pixel) and pixel[end] == centre:
            end += 1
        for band in range(3):
            total = min(radiance[centre, band], ceiling)
            for sample in range(start, end):
                total += min(further[sample, band], ceiling)
            radiance[centre, band] = total / (end - start + 1)
        start = end


@compiled
def _spread(rays, kind, width, directions, pixel):
    sample = 0
    for centre in range(len(kind)):
        if kind[centre] == 0:
            continue
        offsets = _NINE if kind[centre] & THIN else _THREE
        right = centre + 1 if centre % width + 1 < width else centre - 1
        below = centre + width if centre + width < len(kind) else centre - width
        sign_x, sign_y = np.float32(right - centre), np.float32(1 if below > centre else -1)
        a, b = rays[centre, 0] / rays[centre, 2], rays[centre, 1] / rays[centre, 2]
        a_x, b_x = (rays[right, 0] / rays[right, 2] - a) * sign_x, (rays[right, 1] / rays[right, 2] - b) * sign_x
        a_y, b_y = (rays[below, 0] / rays[below, 2] - a) * sign_y, (rays[below, 1] / rays[below, 2] - b) * sign_y
        for number in range(len(offsets)):
            u, v = offsets[number, 0], offsets[number, 1]
            x, y = a + u * a_x + v * a_y, b + u * b_x + v * b_y
            length = np.sqrt(x * x + y * y + 1)
            directions[sample, 0], directions[sample, 1], directions[sample, 2] = x / length, y / length, 1 / length
            pixel[sample] = centre
            sample += 1

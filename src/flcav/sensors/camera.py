"""Simulation of a colour camera: rendering, tone mapping and sensor noise; depth, semantic and instance images.

Tone mapping applies exposure, a filmic curve and the sRGB transfer function by one look-up table.
"""

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from flcav.arrays import Array, Array32, Bytes, Ints32, Mask
from flcav.machine.compiled import compiled, kernel
from flcav.machine.threads import share_among_threads
from flcav.sensors.frame import SEMANTICS
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.sensors.rendering.appearance import Appearance
from flcav.sensors.rendering.gbuffer import GBuffer
from flcav.sensors.rendering.rain import add_drops
from flcav.sensors.rendering.render import render_radiance, survey
from flcav.statistics.streams import stream
from flcav.world.scene import Scene
from flcav.world.weather import Weather


class Camera(Lens):
    """Settings of a colour camera; its mount is in the rig."""

    noise: float = Field(default=0.8, ge=0, le=20)  # standard deviation of a colour value, 0 to 255
    drops: bool = True  # rain leaves drops on the lens
    look: Literal["plain", "fine"] = "plain"  # fine: worn paint, dark kerbs, dull grass, a skyline, clouds in mirrors


class Exposure(NamedTuple):
    """A colour image, with ground truth of depth, semantics and instances at the pixels' centres."""

    rgb: Bytes  # (H, W, 3) sRGB
    depth_m: Array32  # (H, W) z in the optical frame [m]; inf for the sky
    semantic: Bytes  # (H, W) one of SEMANTICS
    instance: Ints32  # (H, W) 0 none, a + 1: the trace's actor a, -(t + 1): thing t of `list_signs_and_signals`


def photograph(
    scene: Scene,
    world_from_camera: Array,
    camera: Camera,
    weather: Weather,
    rng: np.random.Generator,
    *,
    hidden: int | None = None,
    threads: int = 1,
) -> Exposure:
    """Render the image at the scene's instant and its ground truth, without the actor `hidden` (the carrier).

    `world_from_camera` (4, 4) [m] is the pose of the optical frame (x right, y down, z forward): for a mount with body
    axes `world_from_sensor @ BODY_FROM_OPTICAL`. The same arguments and state of `rng` give the same bytes, with any
    number of `threads`.
    """
    fine = camera.look == "fine"
    picture = render_radiance(scene, world_from_camera, camera, weather, rng, hidden=hidden, threads=threads, fine=fine)
    shape = (camera.height, camera.width)
    if camera.drops and weather.rain_mm_h > 0:
        add_drops(picture.radiance.reshape(*shape, 3), weather.rain_mm_h, rng)
    rgb = np.empty((*shape, 3), np.uint8)
    shift = int(rng.integers(GRAINS))
    shown = rgb.reshape(-1, 3)

    def develop_part(first: int, last: int) -> None:
        at, noise = slice(first, last), np.float32(camera.noise)
        develop(picture.radiance[at], picture.exposure, grain(), shift + 3 * first, noise, shown[at])

    share_among_threads(develop_part, len(shown), threads)
    semantic, instance = _labels(picture.seen, picture.painted, picture.appearance)
    depth = picture.seen.distance * compute_pixel_rays(camera)[:, 2]
    return Exposure(rgb, depth.reshape(shape), semantic.reshape(shape), instance.reshape(shape))


def label(
    scene: Scene, world_from_camera: Array, lens: Lens, *, hidden: int | None = None, threads: int = 1
) -> tuple[Bytes, Ints32]:
    """Return the semantic and the instance image (H, W) of `photograph`, without rendering colours."""
    semantic, instance = _labels(*survey(scene, world_from_camera, lens, hidden=hidden, threads=threads))
    return semantic.reshape(lens.height, lens.width), instance.reshape(lens.height, lens.width)


def _labels(seen: GBuffer, painted: Mask, appearance: Appearance) -> tuple[Bytes, Ints32]:
    semantic, instance = np.empty(len(seen), np.uint8), np.empty(len(seen), np.int32)
    _label(seen, appearance, painted, SEMANTICS["sky"], SEMANTICS["road_line"], semantic, instance)
    return semantic, instance


@kernel
def _label(seen, appearance, painted, sky, road_line, semantic, instance):
    for ray in range(len(semantic)):
        row = seen.row[ray]
        if row < 0:
            semantic[ray], instance[ray] = sky, 0
        else:
            semantic[ray] = road_line if painted[ray] else appearance.semantic[row]
            instance[ray] = appearance.thing[row] if seen.instance[ray] == 0 else seen.instance[ray]


STEPS = 4096  # entries of the look-up table
GRAINS = 65521  # length of the noise table: a prime, so that it does not repeat from row to row


CONTRAST, SHOULDER = 1.25, 0.977  # a and d of Lottes' curve
WHITE = 5.0  # exposed radiance that maps to white: sunlit walls are below
MIDDLE, MIDDLE_SHOWN = 0.15, 0.17  # exposed radiance of middle grey, and the value it maps to


def _filmic(light: Array) -> Array:
    """Tone-map exposed radiance to 0..1 (Lottes, Advanced Techniques and Optimization of HDR Color Pipelines, 2016)."""
    low, high = MIDDLE ** (CONTRAST * SHOULDER), WHITE ** (CONTRAST * SHOULDER)
    scale = (WHITE**CONTRAST * MIDDLE_SHOWN - MIDDLE**CONTRAST) / ((high - low) * MIDDLE_SHOWN)
    shift = (high * MIDDLE**CONTRAST - WHITE**CONTRAST * low * MIDDLE_SHOWN) / ((high - low) * MIDDLE_SHOWN)
    return np.minimum(light**CONTRAST / (light ** (CONTRAST * SHOULDER) * scale + shift), 1)


def _table() -> Array32:
    share = (np.arange(STEPS) + 0.5) / STEPS
    shown = _filmic(share / (1 - share))  # the table is indexed by light / (1 + light)
    return (255 * np.where(shown < 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)).astype(np.float32)


TABLE = _table()


@lru_cache(maxsize=1)
def grain() -> Array32:
    """Return the noise table: (GRAINS,) fixed standard normal numbers, which are read from a random index on."""
    return stream(0, "grain").standard_normal(GRAINS, np.float32)


@compiled
def develop(radiance, exposure, grain, shift, noise, out):
    """Tone-map `radiance` (N, 3) into sRGB bytes `out` (N, 3).

    `exposure` is a factor of the radiance; `noise` is the standard deviation of the noise in byte values, read from the
    table `grain` (GRAINS,), from index `shift` on.
    """
    number = shift % GRAINS
    for pixel in range(len(radiance)):
        for band in range(3):
            light = max(radiance[pixel, band] * exposure, np.float32(0))
            value = TABLE[int(light / (np.float32(1) + light) * np.float32(STEPS - 0.01))]
            rise = np.float32(0.5)
            if noise > 0:
                number = number + 1 if number + 1 < GRAINS else 0
                rise = noise * grain[number] + np.float32(0.5)
            value += rise
            out[pixel, band] = np.uint8(min(max(value, np.float32(0)), np.float32(255)))

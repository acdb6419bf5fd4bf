"""Rain in camera images: reflections of wet roads, streaks of falling drops, and drops on the lens."""

import numpy as np
from numpy.typing import NDArray

from flcav.machine.compiled import compiled
from flcav.sensors.rendering.noise import sample_noise
from flcav.world.materials import Material

ROAD = int(Material.ROAD)
WATER = 0.02  # Fresnel reflectance at normal incidence
SMEAR_PX = 15  # half height of the blur of reflections, in pixels of an image of half the size
RIPPLE_PX = 4.0  # sideways displacement by ripples, likewise
STREAKS_PER_MM = 55.0  # number in an image of 640 x 384 at 1 mm/h; grows as rain^0.6
DROPS_PER_MM = 3.0  # number on a lens of any size at 1 mm/h, likewise
DROP_VIEW = 0.45  # share of the image's height that a drop shows, upside down
BLOCK_PX = 8  # drops are out of focus: they show means over squares of this side


@compiled
def wet_pixels(seen, appearance, width, height):
    """Return the indices (K,) of the pixels that show a road, of every second row and column."""
    found = np.empty((width // 2) * (height // 2), np.int64)
    count = 0
    for j in range(height // 2):
        for i in range(width // 2):
            pixel = 2 * j * width + 2 * i
            row = seen.row[pixel]
            if row >= 0 and seen.instance[pixel] == 0 and appearance.material[row] == ROAD:
                found[count] = pixel
                count += 1
    return found[:count]


@compiled
def smear(image, weight, width, height, out):
    """Blur `image` (H, W, 3) vertically, as ripples do: write weighted means `out` (H, W, 3), 0 where no weight is."""
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
def add_mirrored(radiance, seen, appearance, mirrored, wetness, extinction, width, height):
    """Add the reflections `mirrored` (H / 2, W / 2, 3) to pixels that show road, by Fresnel reflectance and puddles."""
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
        share = np.float32(WATER) + (1 - np.float32(WATER)) * grazing * grazing * grazing * grazing * grazing
        share *= wetness * (np.float32(0.35) + np.float32(0.65) * puddle)
        share *= np.exp(-extinction * seen.distance[pixel])
        ripple = (sample_noise(appearance.noise, x * 5.0, y * 5.0) - np.float32(0.5)) * RIPPLE_PX
        j = min(pixel // width // 2, height // 2 - 1)
        i = min(max(int(pixel % width / 2 + ripple), 0), width // 2 - 1)
        for band in range(3):
            radiance[pixel, band] += share * (mirrored[j, i, band] - np.float32(0.4) * radiance[pixel, band])


def add_streaks(
    image: NDArray[np.float32], rain_mm_h: float, brightness: NDArray[np.float64], rng: np.random.Generator
) -> None:
    """Draw motion-blurred streaks of falling drops, of the radiance `brightness` (3,), into an image (H, W, 3)."""
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


def add_drops(image: NDArray[np.float32], rain_mm_h: float, rng: np.random.Generator) -> None:
    """Draw drops on the lens into an image (H, W, 3): each shows a small, blurred view of the scene, upside down."""
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

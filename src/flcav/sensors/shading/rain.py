"""Wet roads that mirror, and falling drops."""

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.shading.noise import noise_at
from flcav.world.materials import Material
from flcav.world.rays.compiled import compiled

ROAD = int(Material.ROAD)
WATER = 0.02  # reflectance face on
SMEAR_PX = 11  # half height of the blur of mirrored things, in pixels of half size
STREAKS_PER_MM = 26.0  # in a picture of 640 x 384, at 1 mm/h, growing with the rain's power of 0.6


@compiled
def wet_pixels(seen, appearance, width, height):
    """Return the pixels, one of every four, that show a road."""
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
    """Write the weighted mean `out` (H, W, 3) of `image` over a tall neighbourhood, as ripples do; zero where none."""
    for i in range(width):
        for j in range(height):
            total = np.float32(0)
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for b in range(max(j - SMEAR_PX, 0), min(j + SMEAR_PX + 1, height)):
                share = weight[b, i] * np.float32(SMEAR_PX + 1 - abs(b - j))
                total += share
                red += share * image[b, i, 0]
                green += share * image[b, i, 1]
                blue += share * image[b, i, 2]
            if total > 0:
                out[j, i, 0], out[j, i, 1], out[j, i, 2] = red / total, green / total, blue / total


@compiled
def add_mirrored(radiance, seen, appearance, mirrored, wetness, extinction, width, height):
    """Add what the wet road mirrors, `mirrored` (H / 2, W / 2, 3), to the pixels that show it: puddles most."""
    for pixel in range(len(radiance)):
        row = seen.row[pixel]
        if row < 0 or seen.instance[pixel] != 0 or appearance.material[row] != ROAD:
            continue
        x, y = seen.position[pixel, 0], seen.position[pixel, 1]
        level = noise_at(appearance.noise, x * 0.45 + 11.0, y * 0.45) * np.float32(0.6)
        level += noise_at(appearance.noise, x * 0.10, y * 0.10 + 29.0) * np.float32(0.4)
        puddle = min(max((level - np.float32(1.02) + np.float32(0.75) * wetness) * 4, np.float32(0)), np.float32(1))
        facing = -seen.ray[pixel, 2]
        grazing = 1 - facing
        share = np.float32(WATER) + (1 - np.float32(WATER)) * grazing * grazing * grazing * grazing * grazing
        share *= wetness * (np.float32(0.35) + np.float32(0.65) * puddle)
        share *= np.exp(-extinction * seen.distance[pixel])
        j, i = min(pixel // width // 2, height // 2 - 1), min(pixel % width // 2, width // 2 - 1)
        for band in range(3):
            radiance[pixel, band] += share * (mirrored[j, i, band] - np.float32(0.4) * radiance[pixel, band])


def add_streaks(
    image: NDArray[np.float32], rain_mm_h: float, brightness: NDArray[np.float64], rng: np.random.Generator
) -> None:
    """Draw falling drops into an image (H, W, 3), blurred by their fall, as bright as the sky behind the camera."""
    height, width = image.shape[:2]
    count = int(STREAKS_PER_MM * rain_mm_h**0.6 * width * height / (640 * 384))
    size = rng.random(count) ** 3  # few are near
    place = rng.random((count, 2)) * (width, height)
    length = (0.015 + 0.085 * size) * height
    slant = rng.normal(0.06, 0.03, count)
    strength = (0.10 + 0.22 * rng.random(count)) * (0.5 + 0.5 * size)
    thick = 0.5 + 1.1 * size
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

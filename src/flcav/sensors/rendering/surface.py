"""Surface shading: diffuse colour under sun, sky and lamps, emission, mirror reflection, and aerial perspective.

Diffuse light is Lambertian, on procedural textures. Mirror reflection grows towards grazing incidence by Schlick's
approximation of the Fresnel term, and shows a procedural environment map of a street: sky, sun, clouds and houses. The
air attenuates radiance by exp(-extinction * distance), and adds airlight.
"""

import numpy as np

from flcav.machine.compiled import kernel
from flcav.sensors.rendering.facade import sample_sign, shade_facade
from flcav.sensors.rendering.ground import asphalt, grass, paving, sample_paint, wear
from flcav.sensors.rendering.noise import fade, hash_pair, sample_noise
from flcav.sensors.rendering.sky import add_skyline, compute_environment, compute_sky
from flcav.sensors.rendering.state import AMBER, GREEN, RED
from flcav.world.materials import Material
from flcav.world.static import TownPart

GROUND, ROAD, SIDEWALK, WALL, ROOF = (int(Material[name]) for name in ("GROUND", "ROAD", "SIDEWALK", "WALL", "ROOF"))
BARK, LEAF, SIGN, HEADLAMP, TAILLAMP, PLATE, LAMP = (
    int(Material[name]) for name in ("BARK", "LEAF", "SIGN", "HEADLAMP", "TAILLAMP", "PLATE", "LAMP")
)
LENS_RED, LENS_GREEN = int(Material.LENS_RED), int(Material.LENS_GREEN)
BUILDING, CLUTTER = int(TownPart.BUILDING), int(TownPart.CLUTTER)

LENS_RADIANCE = 2.2  # of a lit signal lens
LOW_SUN = 0.4  # sine of the sun's elevation below which dry roads have a sheen towards the sun
SHEEN, SHEEN_GLOSS = 0.28, 22.0  # strength and exponent of that sheen
FINE_WORN, FINE_KERB, FINE_GRASS = 0.45, 0.6, 0.4  # fine look: wear of paint, tone of kerbs, share of grey in grass
ROAD_LINE = 0.5  # painted share of a pixel above which its class is road marking


@kernel
def mark_paint(survey, appearance, pixel_angle, painted):
    """Write whether the N hits of a G-buffer are on road markings to `painted` (N,), as `shade` does."""
    for ray in range(len(painted)):
        row = survey.row[ray]
        painted[ray] = False
        if row < 0 or appearance.material[row] != ROAD:
            continue
        dx, dy, dz = survey.ray[ray, 0], survey.ray[ray, 1], survey.ray[ray, 2]
        nx, ny, nz = survey.normal[ray, 0], survey.normal[ray, 1], survey.normal[ray, 2]
        facing = max(-(dx * nx + dy * ny + dz * nz), np.float32(0.02))
        across = np.float32(survey.distance[ray] * pixel_angle)
        level = max(np.sqrt(dx * dx + dy * dy), np.float32(1e-6))
        x, y, slant = survey.position[ray, 0], survey.position[ray, 1], across / facing
        share, _ = sample_paint(x, y, dx / level, dy / level, across, slant, appearance.markings)
        painted[ray] = share > ROAD_LINE


@kernel
def shade(survey, light, appearance, state, lit, lamplight, open_sky, pixel_angle, radiance, painted):
    """Shade the N hits of a G-buffer: write `radiance` (N, 3), and whether they are on road markings, `painted` (N,).

    `lit` (N,) is the visible share of the sun, `lamplight` (N, 3) the irradiance of lamps ((0, 3) if none is on),
    `open_sky` (N,) the ambient occlusion (1: open), `pixel_angle` [rad] the angle of view of a pixel.
    """
    lamps_on = len(lamplight) > 0
    table = appearance.noise
    for ray in range(len(lit)):
        dx, dy, dz = survey.ray[ray, 0], survey.ray[ray, 1], survey.ray[ray, 2]
        row = survey.row[ray]
        painted[ray] = False
        if row < 0:
            red, green, blue = compute_sky(dx, dy, dz, light, table)
            if appearance.fine:
                red, green, blue = add_skyline(red, green, blue, dx, dy, dz, pixel_angle, light, table)
            radiance[ray, 0], radiance[ray, 1], radiance[ray, 2] = red, green, blue
            continue
        instance = survey.instance[ray]
        material = appearance.material[row]
        x, y, z = survey.position[ray, 0], survey.position[ray, 1], survey.position[ray, 2]
        nx, ny, nz = survey.normal[ray, 0], survey.normal[ray, 1], survey.normal[ray, 2]
        facing = max(-(dx * nx + dy * ny + dz * nz), np.float32(0.02))
        across = np.float32(survey.distance[ray] * pixel_angle)
        slant = across / facing
        colours = appearance.colour
        red, green, blue = (
            colours[instance, material, 0],
            colours[instance, material, 1],
            colours[instance, material, 2],
        )
        mirror, gloss = appearance.mirror[material], appearance.gloss[material]
        shine_r, shine_g, shine_b = np.float32(0), np.float32(0), np.float32(0)
        sunny = lit[ray]
        through = np.float32(0)  # translucency: share of sunlight transmitted from behind
        if material == ROAD:
            tone = asphalt(x, y, slant, table)
            red, green, blue = red * tone, green * tone, blue * tone
            level = max(np.sqrt(dx * dx + dy * dy), np.float32(1e-6))
            share, piece = sample_paint(x, y, dx / level, dy / level, across, slant, appearance.markings)
            if share > 0:
                painted[ray] = share > ROAD_LINE
                worn = np.float32(0.72) + np.float32(0.28) * sample_noise(table, x * 1.7, y * 1.7)
                share *= min(worn + np.float32(0.25) * tone, np.float32(1))
                worn = max(appearance.markings.worn, np.float32(FINE_WORN if appearance.fine else 0))
                if worn > 0:
                    share *= wear(x, y, worn, table)
                colour = appearance.markings.colour
                red += share * (colour[piece, 0] * tone - red)
                green += share * (colour[piece, 1] * tone - green)
                blue += share * (colour[piece, 2] * tone - blue)
            if light.to_sun[2] < np.float32(LOW_SUN) and nz > np.float32(0.9):
                toward_sun = dx * light.to_sun[0] + dy * light.to_sun[1] - dz * light.to_sun[2]
                flat = 1 - facing
                sheen = sunny * np.float32(SHEEN) * flat * flat * np.exp(np.float32(SHEEN_GLOSS) * (toward_sun - 1))
                shine_r, shine_g, shine_b = sheen * light.sun[0], sheen * light.sun[1], sheen * light.sun[2]
        elif material == SIDEWALK:
            if nz > np.float32(0.5):
                tone = paving(x, y, slant, table)
            else:
                tone = np.float32(0.95) + np.float32(0.25) * sample_noise(table, (x + y) * 1.3, z * 2.0)
                if appearance.fine:
                    tone *= np.float32(FINE_KERB)
            red, green, blue = red * tone, green * tone, blue * tone
        elif instance > 0:
            if material == HEADLAMP:
                shine = state.head[instance] * np.float32(5) + np.float32(0)
                shine_r, shine_g, shine_b = shine, shine * np.float32(0.96), shine * np.float32(0.88)
            elif material == TAILLAMP:
                shine_r = state.tail[instance] * np.float32(1.3)
                shine_g, shine_b = shine_r * np.float32(0.045), shine_r * np.float32(0.035)
            elif material == SIGN:
                red, green, blue = np.float32(0.75), np.float32(0.60), np.float32(0.16)
        elif material == GROUND:
            tone, dry = grass(x, y, slant, table)
            red = (red + np.float32(0.045) * dry) * tone
            green = (green + np.float32(0.020) * dry) * tone
            blue = blue * tone
            if appearance.fine:
                grey = (red + green + blue) / np.float32(3)
                red += np.float32(FINE_GRASS) * (grey - red)
                green += np.float32(FINE_GRASS) * (grey - green)
                blue += np.float32(FINE_GRASS) * (grey - blue)
        elif material == WALL and appearance.part[row] == BUILDING:
            red, green, blue, glass, window = shade_facade(
                appearance.part_row[row], x, y, z, nx, ny, across, slant, appearance.facades, table
            )
            if glass > 0:
                mirror, gloss = np.float32(0.09) * glass, np.float32(0)
                if light.lamps > 0 and hash_pair(appearance.part_row[row] + 77, window) < np.float32(0.34):
                    warm = hash_pair(window, appearance.part_row[row])
                    glow = np.float32(light.lamps) * glass * (np.float32(0.010) + np.float32(0.030) * warm)
                    shine_r, shine_g, shine_b = (
                        glow,
                        glow * (np.float32(0.62) + np.float32(0.2) * warm),
                        glow * np.float32(0.34),
                    )
        elif material == WALL:
            tone = np.float32(0.85) + np.float32(0.3) * sample_noise(table, (x + y) * 1.9, z * 1.9)
            red, green, blue = red * tone, green * tone, blue * tone
        elif material == ROOF and appearance.part[row] == BUILDING:
            colour = appearance.facades.roof
            building = appearance.part_row[row]
            tone = np.float32(0.85) + np.float32(0.3) * sample_noise(table, x * 2.3, y * 2.3 + z)
            near = fade(np.float32(0.25), slant)
            if near > 0 and nz > np.float32(0.2) and nz < np.float32(0.97):
                tone *= 1 - near * np.float32(0.28) * np.float32(abs((z * 4.5) % 1.0 - 0.5) * 2)
            red, green, blue = (colour[building, 0] * tone, colour[building, 1] * tone, colour[building, 2] * tone)
        elif material == LEAF:
            near = fade(np.float32(0.10), across)
            tone = np.float32(0.62) + np.float32(0.75) * hash_pair(row, 5)
            if appearance.part[row] == CLUTTER:
                tone = np.float32(0.55) + np.float32(0.8) * sample_noise(table, (x + y) * 5.0, z * 5.0 + (x - y) * 3.0)
            if near > 0:
                tone *= 1 + near * np.float32(1.5) * (
                    sample_noise(table, (x + y) * 19.0, z * 19.0 + x * 7.0) - np.float32(0.5)
                )
            autumn = hash_pair(appearance.part_row[row], 11)
            red, green, blue = red * tone * (np.float32(0.75) + autumn * np.float32(0.7)), green * tone, blue * tone
            through = np.float32(0.55)
        elif material == SIGN:
            place = appearance.plates.place
            plate = appearance.part_row[row]
            right = (x - place[plate, 0]) * place[plate, 3] + (y - place[plate, 1]) * place[plate, 4]
            red, green, blue = sample_sign(
                appearance.plates.kind[plate], right, z - place[plate, 2], across, appearance.plates.drawn
            )
        elif material >= LENS_RED and material <= LENS_GREEN:
            lens = state.lens[-appearance.thing[row] - 1]
            if material == LENS_RED and lens & RED:
                shine_r, shine_g, shine_b = np.float32(LENS_RADIANCE), np.float32(0.10), np.float32(0.06)
            elif material == LENS_GREEN and lens & GREEN:
                shine_r, shine_g, shine_b = np.float32(0.12), np.float32(LENS_RADIANCE), np.float32(1.15)
            elif material != LENS_RED and material != LENS_GREEN and lens & AMBER:
                shine_r, shine_g, shine_b = np.float32(LENS_RADIANCE), np.float32(1.05), np.float32(0.06)
        elif material == LAMP:
            shine_r = np.float32(light.lamps * 2.0)
            shine_g, shine_b = shine_r * np.float32(0.75), shine_r * np.float32(0.42)
        elif material == BARK:
            tone = np.float32(0.6) + np.float32(0.8) * sample_noise(table, (x + y) * 22.0, z * 3.0)
            red, green, blue = red * tone, green * tone, blue * tone

        if light.wetness > 0 and (nz > np.float32(0.3) or instance == 0):
            dark = 1 - np.float32(light.wetness) * (np.float32(0.45) if nz > np.float32(0.6) else np.float32(0.15))
            if instance == 0:
                red, green, blue = red * dark, green * dark, blue * dark

        sun = nx * light.to_sun[0] + ny * light.to_sun[1] + nz * light.to_sun[2]
        if through > 0:
            sun = (np.float32(0.25) + np.float32(0.75) * max(sun, -sun * through)) * sunny
        else:
            sun = max(sun, np.float32(0)) * sunny
        up = (np.float32(0.5) + np.float32(0.5) * nz) * open_sky[ray]
        down = (np.float32(0.5) - np.float32(0.5) * nz) * (np.float32(0.4) + np.float32(0.6) * open_sky[ray])
        arrive_r = sun * light.sun[0] + up * light.ambient[0] + down * light.bounce[0]
        arrive_g = sun * light.sun[1] + up * light.ambient[1] + down * light.bounce[1]
        arrive_b = sun * light.sun[2] + up * light.ambient[2] + down * light.bounce[2]
        if lamps_on:
            arrive_r += lamplight[ray, 0] * light.lamps
            arrive_g += lamplight[ray, 1] * light.lamps
            arrive_b += lamplight[ray, 2] * light.lamps
            if material in (SIGN, PLATE):  # retro-reflective in the light of lamps
                arrive_r, arrive_g, arrive_b = arrive_r * 2, arrive_g * 2, arrive_b * 2
        red, green, blue = red * arrive_r, green * arrive_g, blue * arrive_b

        if mirror > 0:
            grazing = 1 - facing
            grazing *= grazing * grazing * grazing * grazing
            mirror += (1 - mirror) * grazing * np.float32(0.8)
            turned = 2 * facing
            rx, ry, rz = dx + turned * nx, dy + turned * ny, dz + turned * nz
            env_r, env_g, env_b = compute_environment(rx, ry, rz, light, table, appearance.fine)
            if gloss > 0 and sunny > 0:
                toward_sun = rx * light.to_sun[0] + ry * light.to_sun[1] + rz * light.to_sun[2]
                if toward_sun > np.float32(0.6):
                    flash = np.exp(gloss * (toward_sun - 1)) * sunny * gloss * np.float32(0.02)
                    env_r += flash * light.sun[0]
                    env_g += flash * light.sun[1]
                    env_b += flash * light.sun[2]
            mirror *= np.float32(0.35) + np.float32(0.65) * open_sky[ray]
            red += mirror * (env_r - red)
            green += mirror * (env_g - green)
            blue += mirror * (env_b - blue)

        red, green, blue = red + shine_r, green + shine_g, blue + shine_b
        kept = np.exp(np.float32(-light.extinction) * survey.distance[ray])
        radiance[ray, 0] = light.air[0] + kept * (red - light.air[0])
        radiance[ray, 1] = light.air[1] + kept * (green - light.air[1])
        radiance[ray, 2] = light.air[2] + kept * (blue - light.air[2])

"""LiDAR returns: surfaces behind panes of glass, their brightness (reflectance models), and detection.

Reflectance is Lambertian, Oren-Nayar for rough surfaces, stronger for retro-reflectors, and lower on wet roads.
"""

from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import ndtri

from flcav.arrays import Array32, Bytes, Ints, Ints32, Mask
from flcav.machine.compiled import compiled
from flcav.world.materials import Material
from flcav.world.rays.packets import Hits

PANES = 6  # number of panes that a ray can pass
PANE_TRANSMISSION = 0.8  # two-way transmittance of a pane
RETRO_GAIN = 4.0  # factor of a retro-reflector's reflectivity, at any incidence
GLASS = int(Material.GLASS)
ROAD, SIDEWALK = int(Material.ROAD), int(Material.SIDEWALK)
WATER_INDEX = 1.33  # refractive index
TURNED_BACK = 1 - (1 - 0.066) / WATER_INDEX**2  # p: share of diffuse light that the film reflects back down
AFTER_PANE_M = 0.002  # distance behind a pane from which a ray is cast again
ROUGH = np.array(
    [
        name in ("GROUND", "ROAD", "SIDEWALK", "WALL", "ROOF", "BARK", "LEAF", "CLOTH", "TROUSERS")
        for name in Material.__members__
    ]
)
LEVELS = 4096  # of the tabulated normal distribution
QUANTILES = ndtri((np.arange(LEVELS) + 0.5) / LEVELS).astype(np.float32)  # of the normal distribution


class CastRays(Protocol):
    """A ray caster over a fixed set of rays, called with the indices of those to cast: see `embree.Hierarchy.trace`."""

    def __call__(self, rays: Ints | slice, *, near_m: Array32 | None = None) -> Hits:
        """Return the first hits of `rays`, beyond `near_m` (one distance per ray [m]) if given."""
        ...


class Returns(NamedTuple):
    """The surfaces that N LiDAR rays return from."""

    distance: Array32  # (N,) [m]; inf where none
    instance: Ints32  # (N,) instance of the scene; -1 where none
    face: Ints32  # (N,) face of the instance's mesh
    material: Bytes  # (N,) a Material; undefined where none
    panes: Bytes  # (N,) panes of glass on the way


def cast_through_glass(trace: CastRays, passes: Mask, first: Ints, material: Bytes) -> Returns:
    """Return the surfaces that N rays return from; rays marked in `passes` (N,) pass through up to PANES panes.

    Face f of instance i has the material `material[first[i] + f]`.
    """
    hits = trace(slice(None))
    materials, through = _look_up(hits.instance, hits.face, first, material, passes, GLASS)
    echoes = Returns(*hits, materials, np.zeros(len(passes), np.uint8))
    for _ in range(PANES):
        if not len(through):
            break
        beyond = trace(through, near_m=echoes.distance[through] + np.float32(AFTER_PANE_M))
        materials, again = _look_up(beyond.instance, beyond.face, first, material, passes[through], GLASS)
        for known, further in zip(echoes, (*beyond, materials)):
            known[through] = further
        echoes.panes[through] += 1
        through = through[again]
    return echoes


@compiled
def _look_up(instance, face, first, material, passes, glass):
    """Return the materials (N,) at the hits, and the indices of the rays that hit glass and pass it."""
    materials = np.zeros(len(instance), np.uint8)
    through = np.empty(len(instance), np.int64)
    count = 0
    for ray in range(len(instance)):
        if instance[ray] >= 0:
            materials[ray] = material[first[instance[ray]] + face[ray]]
            if materials[ray] == glass and passes[ray]:
                through[count] = ray
                count += 1
    return materials, through[:count]


@compiled
def compute_brightness(echoes, directions, surfaces, sensor_from_instance, wetness, roughness=0.0):
    """Return the brightness of the hit surfaces, reflectivity * cos(incidence): (N,) float32, 0 where nothing is hit.

    It is 1 for a white surface at normal incidence. `directions` (N, 3) are unit rays, sensor frame;
    `sensor_from_instance` (I, 3, 3) rotates normals into that frame. A water film dims roads and sidewalks in
    proportion to `wetness` (0 to 1). Ground, masonry, plants and cloth are Oren-Nayar surfaces with slope deviation
    `roughness` [rad]. Panes on the way attenuate by PANE_TRANSMISSION.
    """
    _, instance, face, materials, panes = echoes
    turn = sensor_from_instance.reshape(-1, 9)
    out = np.zeros(len(directions), np.float32)
    for ray in range(len(directions)):
        i = instance[ray]
        if i < 0:
            continue
        row = surfaces.first[i] + face[ray]
        material = materials[ray]
        x, y, z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        nx, ny, nz = surfaces.normal[row, 0], surfaces.normal[row, 1], surfaces.normal[row, 2]
        cosine = abs(
            x * (turn[i, 0] * nx + turn[i, 1] * ny + turn[i, 2] * nz)
            + y * (turn[i, 3] * nx + turn[i, 4] * ny + turn[i, 5] * nz)
            + z * (turn[i, 6] * nx + turn[i, 7] * ny + turn[i, 8] * nz)
        )
        seen = surfaces.reflectivity[i, material]
        if wetness > 0 and material in (ROAD, SIDEWALK):
            seen *= np.float32(1 - wetness * (1 - compute_wet_brightness(cosine, seen)))
        if surfaces.retro[material]:
            seen *= np.float32(RETRO_GAIN)
        elif roughness > 0 and ROUGH[material]:
            seen *= compute_oren_nayar(cosine, roughness)
        else:
            seen *= cosine
        for _ in range(panes[ray]):
            seen *= np.float32(PANE_TRANSMISSION)
        out[ray] = seen
    return out


@compiled
def compute_oren_nayar(cosine, roughness):
    """Return the monostatic Oren-Nayar reflectance, over that of a Lambertian surface at normal incidence.

    `cosine` is that of the angle of incidence, `roughness` the standard deviation of the facets' slopes [rad]. Source:
    Oren and Nayar, "Generalization of Lambert's reflectance model", SIGGRAPH 1994, eq. 30, for equal directions of
    incidence and reflection.
    """
    square = roughness * roughness
    flat = 1 - 0.5 * square / (square + 0.33)
    return np.float32(flat * cosine + 0.45 * square / (square + 0.09) * (1 - cosine * cosine))


@compiled
def compute_wet_brightness(cosine, reflectivity):
    """Return the brightness of a diffuse surface under a water film, relative to dry: (1 - F)^2 / n^2 / (1 - p a).

    F is the film's Fresnel reflectance at the angle of incidence with this `cosine`, n the refractive index, p the
    share of light that the film reflects back down, a the `reflectivity`: Lekner and Dorf, "Why some things are darker
    when wet", Applied Optics 27:1278 (1988).
    """
    inside = np.sqrt(1 - (1 - cosine**2) / WATER_INDEX**2)
    across = (cosine - WATER_INDEX * inside) / (cosine + WATER_INDEX * inside)
    along = (inside - WATER_INDEX * cosine) / (inside + WATER_INDEX * cosine)
    fresnel = (across**2 + along**2) / 2
    return (1 - fresnel) ** 2 / WATER_INDEX**2 / (1 - TURNED_BACK * reflectivity)


@compiled
def detect_returns(
    directions,
    distance,
    brightness,
    source,
    inverse_threshold,
    keep,
    chance,
    noise,
    noise_m,
    noise_share,
    points,
    actor,
):
    """Detect returns: write the first M rows of `points` (N, 4) and `actor` (N,), and return M.

    A return of power P = `brightness` / `distance`^2 is detected with a probability that rises linearly from 0 at
    0.7 P_min to `keep` at 1.3 P_min; `inverse_threshold` is 1 / P_min, `chance` (N,) uniform in [0, 1). `noise` (N,) is
    the quantile of a normal range error with standard deviation hypot(`noise_m`, `noise_share` * distance) [m]. A point
    is x, y, z [m], sensor frame, and the brightness, at most 1. `source` (N,) is the actor that a return comes from.
    """
    count = 0
    for ray in range(len(directions)):
        if brightness[ray] <= 0:
            continue
        power = brightness[ray] / (distance[ray] * distance[ray])
        margin = (power * inverse_threshold - np.float32(0.7)) / np.float32(0.6)
        if chance[ray] >= keep * min(margin, np.float32(1.0)):
            continue
        deviation = noise_m
        if noise_share > 0:
            deviation = np.float32(np.hypot(noise_m, noise_share * distance[ray]))
        measured = distance[ray] + deviation * QUANTILES[noise[ray]]
        points[count, 0] = directions[ray, 0] * measured
        points[count, 1] = directions[ray, 1] * measured
        points[count, 2] = directions[ray, 2] * measured
        points[count, 3] = min(brightness[ray], np.float32(1.0))
        actor[count] = source[ray]
        count += 1
    return count

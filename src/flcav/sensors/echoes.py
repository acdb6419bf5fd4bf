"""From ray hits to echoes: through panes of glass, and into the detector."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from flcav.world.materials import Material
from flcav.world.rays.compiled import compiled
from flcav.world.rays.raycaster import Hits

PANES = 6  # more panes than these stop a ray
PANE_TRANSMISSION = 0.8  # of the power, there and back
RETRO_GAIN = 4.0  # how much brighter than a white surface a retro-reflector is
GLASS = int(Material.GLASS)
AFTER_PANE_M = 0.002
LEVELS = 4096
QUANTILES = ndtri((np.arange(LEVELS) + 0.5) / LEVELS).astype(np.float32)  # of the normal distribution


class Trace(Protocol):
    """`Target.trace` with everything but the rays settled."""

    def __call__(self, directions: NDArray[np.float32], *, near_m: NDArray[np.float32] | None = None) -> Hits:
        """Return the first hits."""
        ...


class Echoes(NamedTuple):
    """The surface each of N rays comes back from."""

    distance: NDArray[np.float32]  # (N,) [m]; inf where none
    instance: NDArray[np.int32]  # (N,) -1 where none
    face: NDArray[np.int32]  # (N,)
    material: NDArray[np.uint8]  # (N,) a Material; meaningless where none
    panes: NDArray[np.uint8]  # (N,) panes of glass on the way


def cast_through_glass(
    trace: Trace,
    directions: NDArray[np.float32],
    passes: NDArray[np.bool_],
    first: NDArray[np.int64],
    material: NDArray[np.uint8],
) -> Echoes:
    """Return what comes back along `directions` (N, 3) when the rays that `passes` (N,) marks go through glass.

    Face f of instance i is of `material[first[i] + f]`.
    """
    hits = trace(directions)
    found, through = _look_up(hits.instance, hits.face, first, material, passes, GLASS)
    echoes = Echoes(*hits, found, np.zeros(len(directions), np.uint8))
    for _ in range(PANES):
        if not len(through):
            break
        beyond = trace(directions[through], near_m=echoes.distance[through] + np.float32(AFTER_PANE_M))
        found, again = _look_up(beyond.instance, beyond.face, first, material, passes[through], GLASS)
        for known, further in zip(echoes, (*beyond, found)):
            known[through] = further
        echoes.panes[through] += 1
        through = through[again]
    return echoes


@compiled
def _look_up(instance, face, first, material, passes, glass):
    """Return the materials met, and the numbers of the rays that meet glass and pass it."""
    found = np.zeros(len(instance), np.uint8)
    through = np.empty(len(instance), np.int64)
    count = 0
    for ray in range(len(instance)):
        if instance[ray] >= 0:
            found[ray] = material[first[instance[ray]] + face[ray]]
            if found[ray] == glass and passes[ray]:
                through[count] = ray
                count += 1
    return found, through[:count]


@compiled
def detect(
    echoes, directions, surfaces, sensor_from_instance, inverse_threshold, keep, chance, noise, noise_m, points, actor
):
    """Write the detected echoes' `points` (N, 4) and `actor` (N,) and return their number.

    An echo of power P is detected with a probability that rises from 0 at 0.7 P_min to `keep` at 1.3 P_min;
    `chance` (N,) in [0, 1) decides. `inverse_threshold` is 1 / P_min; `sensor_from_instance` (I, 3, 3) turns normals;
    `noise` (N,) picks a quantile of the range error, whose standard deviation is `noise_m`.
    """
    distance, instance, face, materials, panes = echoes
    turn = sensor_from_instance.reshape(-1, 9)
    count = 0
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
        brightness = surfaces.reflectivity[i, material]
        if surfaces.retro[material]:
            brightness *= np.float32(RETRO_GAIN)
        else:
            brightness *= cosine
        for _ in range(panes[ray]):
            brightness *= np.float32(PANE_TRANSMISSION)
        power = brightness / (distance[ray] * distance[ray])
        margin = (power * inverse_threshold - np.float32(0.7)) / np.float32(0.6)
        if chance[ray] >= keep * min(margin, np.float32(1.0)):
            continue
        measured = distance[ray] + noise_m * QUANTILES[noise[ray]]
        points[count, 0] = x * measured
        points[count, 1] = y * measured
        points[count, 2] = z * measured
        points[count, 3] = min(brightness, np.float32(1.0))
        actor[count] = i - 1
        count += 1
    return count

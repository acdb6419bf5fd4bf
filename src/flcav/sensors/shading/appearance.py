"""What the surfaces of a scene look like, as tables that shading looks up by surface row and instance."""

import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.world.materials import COLOUR, PAINT_COLOURS, PAINT_REFLECTIVITY, Material
from flcav.world.scene import Scene
from flcav.world.static import Part, static_world, town_things

# Numbers and names of CARLA's semantic tags (0.9.15)
SEMANTICS: dict[str, int] = {
    "unlabeled": 0,
    "road": 1,
    "sidewalk": 2,
    "building": 3,
    "pole": 6,
    "traffic_light": 7,
    "traffic_sign": 8,
    "vegetation": 9,
    "terrain": 10,
    "sky": 11,
    "pedestrian": 12,
    "rider": 13,
    "car": 14,
    "truck": 15,
    "bus": 16,
    "motorcycle": 18,
    "bicycle": 19,
    "static": 20,
    "road_line": 24,
}
_OF_PART = {
    Part.GROUND: "terrain",
    Part.ROAD: "road",
    Part.SIDEWALK: "sidewalk",
    Part.BUILDING: "building",
    Part.TREE: "vegetation",
    Part.CLUTTER: "static",
    Part.LAMP: "pole",
    Part.POST: "pole",
    Part.MAST: "pole",
    Part.SIGN: "traffic_sign",
    Part.SIGNAL: "traffic_light",
}
_RIDER = (Material.SKIN, Material.CLOTH, Material.TROUSERS)


class Appearance(NamedTuple):
    """Tables of one scene."""

    semantic: NDArray[np.uint8]  # (S,) by surface row
    thing: NDArray[np.int32]  # (S,) -(t + 1) for thing t of the town, else 0
    part: NDArray[np.uint8]  # (S,) a Part; meaningless for actors
    part_row: NDArray[np.int32]  # (S,) see `StaticWorld.row`
    colour: NDArray[np.float32]  # (I, M, 3) by instance and material: actors differ in paint and clothes


def appearance_of(scene: Scene) -> Appearance:
    """Return the tables of `scene`; they hold for all its instants."""
    surfaces, trace = scene.surfaces, scene.trace
    world = static_world(scene.town)
    rows = len(surfaces.material)
    semantic = np.zeros(rows, np.uint8)
    part, part_row, thing = np.zeros(rows, np.uint8), np.zeros(rows, np.int32), np.zeros(rows, np.int32)
    own = slice(int(surfaces.first[0]), int(surfaces.first[0]) + len(world.part))
    numbers = np.array([SEMANTICS[_OF_PART[Part(value)]] for value in range(len(Part))], np.uint8)
    leafy = (world.part == Part.CLUTTER) & (world.mesh.material == Material.LEAF)
    semantic[own] = np.where(leafy, SEMANTICS["vegetation"], numbers[world.part])
    part[own], part_row[own] = world.part, world.row
    thing[own] = -(town_things(scene.town).face + 1)
    starts = np.append(np.unique(surfaces.first), rows)
    for instance, category in enumerate(trace.category, start=1):
        first = surfaces.first[instance]
        faces = slice(int(first), int(starts[np.searchsorted(starts, first) + 1]))
        semantic[faces] = SEMANTICS["car" if category == "van" else str(category)]
        if category in ("bicycle", "motorcycle"):
            semantic[faces][np.isin(surfaces.material[faces], _RIDER)] = SEMANTICS["rider"]
    return Appearance(semantic, thing, part, part_row, _colours([str(name) for name in trace.actor]))


def _colours(names: list[str]) -> NDArray[np.float32]:
    out = np.tile(COLOUR, (len(names) + 1, 1, 1))
    for instance, name in enumerate(names, start=1):
        number = zlib.crc32(name.encode())
        paints = PAINT_COLOURS[number % len(PAINT_REFLECTIVITY)]
        out[instance, Material.PAINT] = paints[number // len(PAINT_REFLECTIVITY) % len(paints)]
    return out

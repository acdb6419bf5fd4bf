"""Appearance tables of a scene: materials, semantic classes, colours and textures of its faces and instances."""

import zlib
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from flcav.arrays import Array32, Bytes, Ints32
from flcav.geometry import left_vectors
from flcav.sensors.frame import SEMANTICS
from flcav.sensors.rendering.facade import SIGN_KINDS, Facades, draw_signs, facades_of
from flcav.sensors.rendering.ground import Markings, build_markings
from flcav.sensors.rendering.noise import make_noise
from flcav.world.map.lanes import map_layers
from flcav.world.map.layers import MapLayers
from flcav.world.materials import (
    CLOTH_COLOURS,
    COLOUR,
    GLOSS,
    MIRROR,
    PAINT_COLOURS,
    PAINT_REFLECTIVITY,
    SKIN_TONES,
    TROUSER_COLOURS,
    Material,
)
from flcav.world.meshes import actor_mesh
from flcav.world.rays.embree import Solid
from flcav.world.scene import Scene, Surfaces
from flcav.world.static import TownPart, build_static_world

_OF_PART = {
    TownPart.GROUND: "terrain",
    TownPart.ROAD: "road",
    TownPart.SIDEWALK: "sidewalk",
    TownPart.BUILDING: "building",
    TownPart.TREE: "vegetation",
    TownPart.CLUTTER: "static",
    TownPart.LAMP: "pole",
    TownPart.POST: "pole",
    TownPart.MAST: "pole",
    TownPart.SIGN: "traffic_sign",
    TownPart.SIGNAL: "traffic_light",
    TownPart.POLE: "pole",
    TownPart.DECK: "road",
}
_RIDER = (Material.SKIN, Material.CLOTH, Material.TROUSERS)


class Plates(NamedTuple):
    """The plates of a town's traffic signs: places, kinds and textures."""

    place: Array32  # (S, 5) centre x, y, z [m], cosine and sine of the direction to the reader's right, world frame
    kind: Bytes  # (S,) row of SIGN_KINDS
    drawn: Array32  # mip-maps, see `draw_signs`


class Appearance(NamedTuple):
    """Appearance tables of one scene with S surface rows, I instances and M materials."""

    material: Bytes  # (S,) by surface row
    semantic: Bytes  # (S,) one of SEMANTICS
    thing: Ints32  # (S,) -(t + 1) for thing t of the town, else 0
    part: Bytes  # (S,) a `TownPart`; undefined for actors
    part_row: Ints32  # (S,) see `StaticWorld.row`
    first_actor: int  # first surface row of the actors' faces, which follow the town's
    corner: Array32  # (S - first_actor, 3, 3) corners of actors' faces, body frame [m]
    corner_normal: Array32  # (S - first_actor, 3, 3) see `Mesh.corner_normals`
    colour: Array32  # (I, M, 3) linear RGB by instance and material: actors differ in paint and clothes
    mirror: Array32  # (M,) specular reflectance at normal incidence
    gloss: Array32  # (M,) exponent of the sun's highlight
    markings: Markings
    facades: Facades
    plates: Plates
    noise: Array32  # see `make_noise`
    fine: np.bool_ = np.bool_(False)  # the fine look: see `Camera.look`


_AS = {"van": "car", "prop": "static"}  # categories without a semantic class
_KNOWN: WeakKeyDictionary[Scene, tuple[Surfaces, Appearance]] = WeakKeyDictionary()
_TOWNS: WeakKeyDictionary[Solid, Appearance] = WeakKeyDictionary()  # of towns without actors


def build_appearance(scene: Scene) -> Appearance:
    """Return the appearance tables of `scene`; they are cached, and shared by all instants with the same actors."""
    if scene not in _KNOWN or _KNOWN[scene][0] is not scene.surfaces:
        if scene.town_solid not in _TOWNS:
            _TOWNS[scene.town_solid] = _of_town(scene)
        _KNOWN[scene] = scene.surfaces, _add_actors(scene, _TOWNS[scene.town_solid])
    return _KNOWN[scene][1]


def _of_town(scene: Scene) -> Appearance:
    """Return the appearance of a scene's town without actors; its faces come first in the scene."""
    town = scene.town
    world, signs = build_static_world(town), town.signs
    numbers = np.array([SEMANTICS[_OF_PART[TownPart(value)]] for value in range(len(TownPart))], np.uint8)
    leafy = (world.part == TownPart.CLUTTER) & (world.mesh.material == Material.LEAF)
    place = np.c_[signs.position, left_vectors(signs.yaw)].astype(np.float32)
    kinds = np.array([SIGN_KINDS.index(kind) for kind in signs.kind], np.uint8)
    no_corners = np.zeros((0, 3, 3), np.float32)
    return Appearance(
        material=world.mesh.material,
        semantic=np.where(leafy, SEMANTICS["vegetation"], numbers[world.part]).astype(np.uint8),
        thing=-(scene.things.face + 1),
        part=world.part,
        part_row=world.row,
        first_actor=len(world.part),
        corner=no_corners,
        corner_normal=no_corners,
        colour=COLOUR[None],
        mirror=MIRROR,
        gloss=GLOSS,
        markings=build_markings(
            map_layers(town) if town.net.exists() else MapLayers((), (), (), (), (), ()), town.parameters.worn_paint
        ),
        facades=facades_of(town.name, town.buildings),
        plates=Plates(place, kinds, draw_signs()),
        noise=make_noise(),
    )


def _add_actors(scene: Scene, of_town: Appearance) -> Appearance:
    """Return the appearance of a scene: that of its town, extended by the actors' faces."""
    surfaces, trace = scene.surfaces, scene.trace
    actors = len(of_town.part)
    beyond = (0, len(surfaces.material) - actors)  # the faces of the actors follow the town's
    semantic = np.pad(of_town.semantic, beyond)
    corner = np.zeros((beyond[1], 3, 3), np.float32)
    corner_normal = np.zeros((beyond[1], 3, 3), np.float32)
    for instance, category in enumerate(trace.category, start=1):
        corners, normals = _corners(*trace.model(instance - 1))
        first = int(surfaces.first[instance])
        faces = slice(first, first + len(corners))
        corner[first - actors :][: len(corners)], corner_normal[first - actors :][: len(corners)] = corners, normals
        semantic[faces] = SEMANTICS[_AS.get(str(category), str(category))]
        if category in ("bicycle", "motorcycle"):
            semantic[faces][np.isin(surfaces.material[faces], _RIDER)] = SEMANTICS["rider"]
    return of_town._replace(
        material=surfaces.material,
        semantic=semantic,
        thing=np.pad(of_town.thing, beyond),
        part=np.pad(of_town.part, beyond),
        part_row=np.pad(of_town.part_row, beyond),
        corner=corner,
        corner_normal=corner_normal,
        colour=_colours([str(name) for name in trace.actor], scene.paints),
    )


@lru_cache(maxsize=256)
def _corners(category: str, shape: int, size: tuple[float, ...]) -> tuple[Array32, Array32]:
    mesh = actor_mesh(category, shape, size)
    return mesh.vertices[mesh.faces], mesh.corner_normals()


def _colours(names: list[str], paints_of: Mapping[str, tuple[float, float, float]]) -> Array32:
    """Return the colours (I, M, 3) by instance and material, chosen by a hash of the actor's name, or its paint."""
    out = np.tile(COLOUR, (len(names) + 1, 1, 1))
    for instance, name in enumerate(names, start=1):
        number = zlib.crc32(name.encode())
        paints = PAINT_COLOURS[number % len(PAINT_REFLECTIVITY)]
        out[instance, Material.PAINT] = paints_of.get(name, paints[number // len(PAINT_REFLECTIVITY) % len(paints)])
        out[instance, Material.CLOTH] = CLOTH_COLOURS[number // 64 % len(CLOTH_COLOURS)]
        out[instance, Material.TROUSERS] = TROUSER_COLOURS[number // 1024 % len(TROUSER_COLOURS)]
        out[instance, Material.SKIN] *= SKIN_TONES[number // 8192 % len(SKIN_TONES)]
    return out

"""Write the pictures of docs/gallery that cameras took: python tools/gallery_camera.py [NAME ...]."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flcav.geometry import pose
from flcav.report.pictures.camera import thermal_grey
from flcav.sensors.camera import Camera, photograph
from flcav.sensors.infrared import Infrared, render_thermal
from flcav.sensors.lens import BODY_FROM_OPTICAL
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.shapes import SHAPES
from flcav.world.traffic.traffic import simulate
from flcav.world.weather import WEATHERS

Picture = NDArray[np.uint8]
GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
SIX = (60.0, 0.0, -60.0, 120.0, 180.0, -120.0)  # yaw of each of six cameras [deg]


@lru_cache(maxsize=2)
def scene_of(town: str) -> Scene:
    """Return a scene of a town with dense traffic."""
    built = load_town(town)
    return Scene(built, simulate(built, seed=1, cavs=3, times_s=np.arange(40.0, 42.01, 0.5).round(1)))


def shoot(scene: Scene, world_from_body: NDArray, weather: str, camera: Camera, hidden: int | None = None) -> Picture:
    """Return the picture of a camera that looks along a body's x axis."""
    at = world_from_body @ BODY_FROM_OPTICAL
    return photograph(scene, at, camera, WEATHERS[weather], np.random.default_rng(0), hidden=hidden).rgb


def sheet(pictures: Sequence[Picture], columns: int) -> Picture:
    """Return pictures of one size tiled into one, row by row."""
    rows = [np.concatenate(pictures[first : first + columns], axis=1) for first in range(0, len(pictures), columns)]
    return np.concatenate(rows, axis=0)


def ego(scene: Scene) -> tuple[int, NDArray]:
    """Return the first CAV and the pose (4, 4) of its windscreen camera in the world."""
    actor = int(np.flatnonzero(scene.trace.actor == "cav0")[0])
    return actor, scene.world_from_actor(actor) @ pose(0.8, 0.0, 1.5)


def weathers() -> Picture:
    """One scene in all presets."""
    scene, camera = scene_of("grid"), Camera(width=400, height=240, noise=0)
    own, at = ego(scene)
    return sheet([shoot(scene, at, name, camera, own) for name in WEATHERS], 3)


def six_cameras() -> Picture:
    """Six cameras all around one vehicle."""
    scene, camera = scene_of("ring"), Camera(width=400, height=240, noise=0, fov_deg=70)
    own, at = ego(scene)
    return sheet([shoot(scene, at @ pose(0, 0, 0, np.radians(yaw)), "clear", camera, own) for yaw in SIX], 3)


def roadside() -> Picture:
    """From a pole at a crossroads, by day and by night."""
    scene, camera, poles = scene_of("grid"), Camera(noise=0), scene_of("grid").town.poles
    x, y, z = poles.position[4]
    at = pose(x, y, z, float(poles.yaw[4]), np.radians(14))
    return sheet([shoot(scene, at, name, camera) for name in ("clear", "night")], 2)


def actors() -> Picture:
    """Every shape of every category, on an empty square."""
    town, trace = load_town("suburb"), scene_of("suburb").trace
    shapes = [(category, shape) for category, rows in SHAPES.items() for shape in range(len(rows))]
    shapes.sort(key=lambda row: SHAPES[row[0]][row[1]].length)  # long shapes last
    picked = np.arange(len(shapes)) % len(trace.actor)
    size = np.array([SHAPES[category][shape][1:4] for category, shape in shapes])
    row, column = np.divmod(np.arange(len(shapes)), 6)
    place = np.stack((6.0 * column - 265.0, 11.0 * row - 290.0, 0.0 * row - 0.03), axis=1)
    still = replace(
        trace,
        time_s=trace.time_s[:1],
        actor=np.array([f"shape{number}" for number in range(len(shapes))]),
        category=np.array([category for category, _ in shapes]),
        shape=np.array([shape for _, shape in shapes]),
        size=size,
        present=np.ones((1, len(shapes)), np.bool_),
        position=place[None],
        yaw=np.full((1, len(shapes)), np.radians(-125)),
        velocity=np.full((1, len(shapes), 3), 5.0),
        acceleration=np.zeros((1, len(shapes), 3)),
        yaw_rate=np.zeros((1, len(picked))),
        light_state=trace.light_state[:1],
    )
    at = pose(-250.0, -309.0, 13.0, np.pi / 2, np.radians(24))
    return shoot(Scene(town, still), at, "clear", Camera(width=1280, height=560, fov_deg=72, noise=0))


def infrared() -> Picture:
    """The same instant in the thermal camera, by day and by night; brighter is warmer."""
    scene, out = scene_of("grid"), []
    own, at = ego(scene)
    for name in ("clear", "night"):
        image = render_thermal(
            scene, at @ BODY_FROM_OPTICAL, Infrared(), WEATHERS[name], np.random.default_rng(0), hidden=own
        )
        out.append(thermal_grey(image))
    return sheet(out, 2)


def signs() -> Picture:
    """Each kind of sign from 10, 30 and 60 m, cut out and enlarged."""
    tiles, camera = [], Camera(width=1280, height=768, fov_deg=60, noise=0)
    for town, kind in (("suburb", "stop"), ("suburb", "yield"), ("grid", "speed_30"), ("grid", "speed_60")):
        scene = scene_of(town)
        place, ahead = _in_plain_sight(scene, kind)
        for distance in (10.0, 30.0, 60.0):
            x, y, z = place + distance * ahead
            at = pose(x, y, z - 0.4, float(np.arctan2(-ahead[1], -ahead[0])))
            picture = shoot(scene, at, "clear", camera)[300:420, 580:700]
            tiles.append(picture.repeat(2, axis=0).repeat(2, axis=1))
    return sheet(tiles, 6)


def _in_plain_sight(scene: Scene, kind: str) -> tuple[NDArray, NDArray]:
    """Return a sign's position and the direction of an unobstructed view of it from 60 m; else of the freest view."""
    found = []
    for place, yaw, own in zip(scene.town.signs.position, scene.town.signs.yaw, scene.town.signs.kind):
        for aside in np.radians((0, 2, -2, 5, -5, 8, -8, 12, -12, 16, -16)) if own == kind else ():
            ahead = np.array([np.cos(yaw + aside), np.sin(yaw + aside), 0.0])
            eye = np.array([place + 60.0 * ahead - (0, 0, 0.4)], np.float32)
            hits = scene.cast(pose(*place + 0.2 * ahead), (eye - place).astype(np.float32) / 60.0, far_m=60.0)
            found.append((min(float(hits.distance[0]), 60.0), -abs(aside), place, ahead))
    _, _, place, ahead = max(found, key=lambda row: row[:2])
    return place, ahead


PICTURES: dict[str, Callable[[], Picture]] = {
    "weathers": weathers,
    "six_cameras": six_cameras,
    "roadside": roadside,
    "actors": actors,
    "infrared": infrared,
    "signs": signs,
}


def main() -> None:
    """Write the pictures named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(PICTURES), metavar="NAME", help=", ".join(PICTURES))
    GALLERY.mkdir(parents=True, exist_ok=True)
    for name in parser.parse_args().names:
        Image.fromarray(PICTURES[name]()).save(GALLERY / f"camera_{name}.png", optimize=True)


if __name__ == "__main__":
    main()

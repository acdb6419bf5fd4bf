"""Write the pictures of docs/gallery that cameras took: python tools/gallery_camera.py [NAME ...].

Sheets are 1280 x 720. Where a picture shows traffic, it is the view with the most moving road users in a minute of
dense traffic, 8 to 50 m away and up to 40 degrees off the axis, among the cameras that could take it.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from flcav.geometry import Boxes, inverse, pose, transform_points
from flcav.report.pictures.camera import thermal_grey
from flcav.sensors.camera import Camera, photograph
from flcav.sensors.infrared import Infrared, render_thermal
from flcav.sensors.lens import BODY_FROM_OPTICAL, project_optical
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.shapes import SHAPES
from flcav.world.traffic.traffic import simulate
from flcav.world.weather import WEATHERS

Picture = NDArray[np.uint8]
GALLERY = Path(__file__).parents[1] / "docs" / "gallery"
WIDTH, HEIGHT, GAP = 1280, 720, 4  # of a sheet, and between its tiles [px]
FONT = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 15)
SIX = {"front left": 60.0, "front": 0.0, "front right": -60.0, "rear left": 120.0, "rear": 180.0, "rear right": -120.0}
ROADSIDE = {"clear": "clear day", "sunset": "sunset", "heavy_rain": "heavy rain", "night": "night"}
NEAR_M, VIEW_M, VIEW_DEG = 8.0, 50.0, 40.0  # where road users are counted


@lru_cache(maxsize=3)
def scene_of(town: str) -> Scene:
    """Return a scene of a town with dense traffic, over a minute."""
    built = load_town(town)
    return Scene(built, simulate(built, seed=1, cavs=6, times_s=np.arange(40.0, 100.01, 2.0)))


def tile_size(columns: int, rows: int) -> tuple[int, int]:
    """Return width and height [px] of the tiles of a sheet."""
    return (WIDTH - (columns - 1) * GAP) // columns, (HEIGHT - (rows - 1) * GAP) // rows


def lens_of(columns: int, rows: int, fov_deg: float) -> Camera:
    """Return a camera without noise whose pictures have twice the size of a sheet's tiles."""
    width, height = tile_size(columns, rows)
    return Camera(width=2 * width, height=2 * height, noise=0, fov_deg=fov_deg, look="fine")


def shoot(scene: Scene, world_from_body: NDArray, weather: str, camera: Camera, hidden: int | None = None) -> Picture:
    """Return the picture of a camera that looks along a body's x axis."""
    at = world_from_body @ BODY_FROM_OPTICAL
    return photograph(scene, at, camera, WEATHERS[weather], np.random.default_rng(0), hidden=hidden).rgb


def sheet(pictures: Sequence[tuple[str, Picture]], columns: int) -> Picture:
    """Return pictures with their labels tiled into one of 1280 x 720, row by row."""
    rows = -(-len(pictures) // columns)
    width, height = tile_size(columns, rows)
    out = Image.new("RGB", (WIDTH, HEIGHT), "white")
    for number, (label, picture) in enumerate(pictures):
        row, column = divmod(number, columns)
        tile = Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS)
        write(tile, (10, 8), label)
        out.paste(tile, (column * (width + GAP), row * (height + GAP)))
    return np.asarray(out)


def write(image: Image.Image, at: tuple[float, float], label: str, anchor: str = "la") -> None:
    """Write a label onto an image, white on a dark ground."""
    draw = ImageDraw.Draw(image, "RGBA")
    left, top, right, bottom = draw.textbbox(at, label, FONT, anchor=anchor)
    draw.rounded_rectangle((left - 6, top - 4, right + 6, bottom + 4), 4, fill=(16, 21, 27, 190))
    draw.text(at, label, "white", FONT, anchor=anchor)


def count_ahead(scene: Scene, world_from_body: NDArray) -> int:
    """Return the number of moving road users from NEAR_M to VIEW_M and within VIEW_DEG of a body's x axis."""
    present = scene.trace.present[scene.index]
    x, y, _ = transform_points(inverse(world_from_body), scene.trace.position[scene.index][present]).T
    distance = np.hypot(x, y)
    moving = ~np.char.startswith(scene.trace.actor[present], "parked")
    seen = (distance > NEAR_M) & (distance < VIEW_M) & (np.abs(np.degrees(np.arctan2(y, x))) < VIEW_DEG)
    return int((seen & moving).sum())


def busiest_drive(town: str) -> tuple[Scene, int, NDArray]:
    """Return a scene at the instant when a CAV sees most, that actor, and the pose (4, 4) of its windscreen camera."""
    scene = scene_of(town)
    actors = [int(actor) for actor in np.flatnonzero(np.char.startswith(scene.trace.actor, "cav"))]
    found = []
    for number in range(len(scene.trace.time_s)):
        scene.move_to(number)
        for actor in actors:
            if scene.trace.present[number, actor]:
                at = scene.world_from_actor(actor) @ pose(0.8, 0.0, 1.5)
                found.append((count_ahead(scene, at), -number, actor))
    _, number, actor = max(found)
    scene.move_to(-number)
    return scene, actor, scene.world_from_actor(actor) @ pose(0.8, 0.0, 1.5)


def weathers() -> Picture:
    """One scene in all presets."""
    scene, own, at = busiest_drive("grid")
    camera = lens_of(4, 3, 80.0)
    return sheet([(name.replace("_", " "), shoot(scene, at, name, camera, own)) for name in WEATHERS], 4)


def six_cameras() -> Picture:
    """Six cameras all around one vehicle."""
    scene, own, at = busiest_drive("grid")
    camera = lens_of(3, 2, 70.0)
    turned = {name: at @ pose(0, 0, 0, np.radians(yaw)) for name, yaw in SIX.items()}
    return sheet([(name, shoot(scene, body, "clear", camera, own)) for name, body in turned.items()], 3)


def roadside() -> Picture:
    """From the pole with most traffic, in four weathers."""
    scene = scene_of("grid")
    poles, found = scene.town.poles, []
    for number in range(len(scene.trace.time_s)):
        scene.move_to(number)
        for pole, ((x, y, z), yaw) in enumerate(zip(poles.position, poles.yaw)):
            for turned in (float(yaw) + np.radians((-50, 0, 50))).tolist():
                seen = count_ahead(scene, pose(x, y, z, turned))
                found.append((seen, -number, -pole, turned))
    _, number, pole, turned = max(found)
    x, y, z = poles.position[-pole]
    at = pose(x, y, z, turned, np.radians(14))
    scene.move_to(-number)
    camera = lens_of(2, 2, 80.0)
    return sheet([(label, shoot(scene, at, name, camera)) for name, label in ROADSIDE.items()], 2)


def actors() -> Picture:
    """Every shape of every category, on an empty square."""
    town, trace = load_town("suburb"), scene_of("suburb").trace
    shapes = [(category, shape) for category, rows in SHAPES.items() for shape in range(len(rows))]
    shapes.sort(key=lambda row: SHAPES[row[0]][row[1]].length)  # long shapes last
    size = np.array([SHAPES[category][shape][1:4] for category, shape in shapes])
    row, column = np.divmod(np.arange(len(shapes)), 8)
    spread, depth = np.array([(2.7, -298.0), (3.5, -290.5), (4.3, -281.5), (5.6, -266.0)])[row].T
    place = np.stack((spread * (column - 3.5) - 250.0, depth, 0.0 * row - 0.03), axis=1)
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
        yaw_rate=np.zeros((1, len(shapes))),
        light_state=trace.light_state[:1],
    )
    at, camera = pose(-250.0, -313.0, 17.5, np.pi / 2, np.radians(35)), lens_of(1, 1, 66.0)
    picture = Image.fromarray(shoot(Scene(town, still), at, "clear", camera)).resize(
        (WIDTH, HEIGHT), Image.Resampling.LANCZOS
    )
    boxes = Boxes(place + 0.5 * size * (0, 0, 1), size, still.yaw[0], still.category)
    optical = transform_points(inverse(at @ BODY_FROM_OPTICAL), boxes.corners().reshape(-1, 3))
    outlines = project_optical(camera, optical).reshape(len(shapes), 8, 2) / 2
    for (category, shape), outline in zip(shapes, outlines):
        name = SHAPES[category][shape].name.replace("_", " ")
        below = (outline[:, 0].mean(), outline[:, 1].max() + 6)
        write(picture, below, f"person: {name}" if category == "pedestrian" else name, "ma")
    return np.asarray(picture)


def infrared() -> Picture:
    """The same instant in a colour and a thermal camera, by day and by night; brighter is warmer."""
    scene, own, at = busiest_drive("grid")
    camera, tiles = lens_of(2, 2, 80.0), []
    thermal = Infrared(width=camera.width, height=camera.height, fov_deg=80.0)
    for name, label in (("clear", "day"), ("night", "night")):
        tiles.append((f"{label}, colour", shoot(scene, at, name, camera, own)))
        body, rng = at @ BODY_FROM_OPTICAL, np.random.default_rng(0)
        image = thermal_grey(render_thermal(scene, body, thermal, WEATHERS[name], rng, hidden=own))
        tiles.append((f"{label}, thermal: brighter is warmer", image))
    return sheet(tiles, 2)


def signs() -> Picture:
    """Each kind of sign from 10, 30 and 60 m, cut out."""
    camera = Camera(width=3840, height=2304, fov_deg=60, noise=0, look="fine")
    width, height = (2 * side for side in tile_size(4, 3))
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    tiles: dict[float, list[tuple[str, Picture]]] = {10.0: [], 30.0: [], 60.0: []}
    for kind in ("stop", "yield", "speed_30", "speed_60"):
        scene, place, ahead = _in_plain_sight(kind)
        for distance, row in tiles.items():
            x, y, z = place + distance * ahead
            at = pose(x, y, z + 0.1, float(np.arctan2(-ahead[1], -ahead[0])))
            picture = shoot(scene, at, "clear", camera)[top : top + height, left : left + width]
            row.append((f"{kind.replace('_', ' ')}, {distance:.0f} m", picture))
    return sheet([tile for row in tiles.values() for tile in row], 4)


def _in_plain_sight(kind: str) -> tuple[Scene, NDArray, NDArray]:
    """Return a scene, the position of a sign, and the direction of the freest view of it from 60 m.

    The freest is the one with most of seven parallel lines free, over a metre across the sign.
    """
    found = []
    for town in ("suburb", "grid", "ring"):
        scene = scene_of(town)
        for place, yaw, own in zip(scene.town.signs.position, scene.town.signs.yaw, scene.town.signs.kind):
            for aside in np.radians((0, 2, -2, 5, -5, 8, -8, 12, -12, 16, -16)) if own == kind else ():
                ahead = np.array([np.cos(yaw + aside), np.sin(yaw + aside), 0.0])
                across = np.array([-ahead[1], ahead[0], 0.0])
                starts = [pose(*place + 0.2 * ahead + side * across) for side in np.linspace(-0.5, 0.5, 7)]
                way = ahead[None].astype(np.float32)
                free = sum(bool(scene.cast(start, way, far_m=60.0).instance[0] < 0) for start in starts)
                found.append((free, -abs(aside), -len(found), scene, place, ahead))
    return max(found, key=lambda row: row[:3])[3:]


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
    parser.add_argument("--out", type=Path, default=GALLERY)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.names:
        Image.fromarray(PICTURES[name]()).save(arguments.out / f"camera_{name}.webp", quality=90, method=6)


if __name__ == "__main__":
    main()

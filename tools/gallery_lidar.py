"""Draw the gallery's pictures of LiDAR and radar: `python tools/gallery_lidar.py [--out docs/gallery]`."""

import argparse
from pathlib import Path

import numpy as np
from gallery_camera import busiest_drive
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from flcav.geometry import Boxes, inverse, points_in_boxes, pose, transform_points
from flcav.report import style
from flcav.report.pictures import perspective
from flcav.report.pictures.birdseye import HEIGHT_COLOURS, HEIGHTS_M, BirdseyeView, draw_view
from flcav.report.pictures.clouds import GROUND_M, draw_boxes, on_page
from flcav.sensors.lidar.lidar import Lidar, scan
from flcav.sensors.radar import Radar, sweep_radar
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.traffic.traffic import simulate
from flcav.world.weather import WEATHERS, Weather

TOWN, SEED, AGENT, TIME_S = "grid", 3, "cav2", 71.0  # a busy junction, met at 12 m/s
ROOF = pose(0.0, 0.0, 1.85)
BUMPER = pose(2.2, 0.0, 0.6)
LIDAR = Lidar(beams="hdl64e")
ROLLING = LIDAR.model_copy(update={"rolling": True})
SHOWN: dict[str, Weather] = {
    "clear": WEATHERS["clear"],
    "heavy rain, 35 mm/h": WEATHERS["heavy_rain"],
    "fog, visibility 120 m": WEATHERS["fog"],
    "dense fog, visibility 40 m": Weather(visibility_m=40.0, wetness=0.2),
}
DARK_HEIGHTS = LinearSegmentedColormap.from_list(
    "heights on dark", ["#3d6ea8", "#35b0d8", "#37d0a8", "#b4e05c", "#ffd23f", "#ff7b3d"]
)
KINDS = {  # of boxes: words, labels and colour on dark
    "cars and vans": (("car", "van"), "#ff5ca8"),
    "trucks and buses": (("truck", "bus"), "#c58bff"),
    "pedestrians": (("pedestrian",), "#ffffff"),
    "bicycles and motorcycles": (("bicycle", "motorcycle"), "#ffd23f"),
}


def busy_scene() -> tuple[Scene, int]:
    """Return the gallery's scene and the actor that carries its sensors."""
    town = load_town(TOWN)
    scene = Scene(town, simulate(town, seed=SEED, cavs=4, times_s=np.array([TIME_S])))
    return scene, int(np.flatnonzero(scene.trace.actor == AGENT)[0])


def truth(scene: Scene, own: int) -> Boxes:
    """Return the boxes of all other actors in the carrier's frame."""
    others = np.flatnonzero(scene.trace.present[scene.index] & (np.arange(len(scene.trace.actor)) != own))
    x, y, z, yaw = scene.poses()[others].T
    size = scene.trace.size[others]
    center = np.column_stack((x, y, z + size[:, 2] / 2))
    boxes = Boxes(center, size, yaw, scene.trace.category[others])
    return boxes.transform(inverse(scene.world_from_actor(own)))


def sweep(scene: Scene, own: int, lidar: Lidar, weather: Weather | None = None) -> np.ndarray:
    """Return (N, 3) points in the carrier's frame."""
    at = scene.world_from_actor(own) @ ROOF
    points = scan(scene, at, lidar, np.random.default_rng(0), own, weather).points
    return transform_points(ROOF, points[:, :3])


@style.styled
def lidar_in_perspective(scene: Scene, own: int, path: Path) -> None:
    """Draw one sweep from behind and above its vehicle, 1280 x 720: returns by height, boxes by kind of road user.

    Boxes are those of road users with a return.
    """
    figure = Figure(figsize=(12.8, 7.2), facecolor=perspective.NIGHT)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-0.86, 0.86), ylim=(-0.5675, 0.40), facecolor=perspective.NIGHT)
    style.hide_axes(axes)
    points = sweep(scene, own, Lidar(beams="pandar128"))
    boxes = truth(scene, own)
    returns = points_in_boxes(points, boxes).sum(axis=1)
    ahead = boxes[(returns > 0) & (boxes.center[:, 0] > -4.0) & (boxes.center[:, 0] < 90.0)]
    shown = points[points[:, 0] > perspective.EYE[0] + 2]
    perspective.draw_returns(axes, shown, 0.0, DARK_HEIGHTS, Normalize(0.0, 8.0), 36.0)
    handles = []
    for name, (kinds, colour) in KINDS.items():
        chosen = ahead[np.isin(ahead.label, kinds)]
        perspective.draw_boxes(axes, chosen, 0.0, colour, 1.4)
        if len(chosen):
            handles.append(Line2D([], [], color=colour, linewidth=2, label=f"{name}: {len(chosen)}"))
    style.key(axes, handles, loc="lower left", labelcolor=perspective.TEXT, ncols=1)
    title = f"One sweep of 128 beams: {len(points):,} returns, coloured by height above ground, 0 to 8 m"
    axes.text(0.012, 0.965, title, transform=axes.transAxes, color=perspective.TEXT, va="top", fontsize=13)
    figure.savefig(path, dpi=100, pil_kwargs={"quality": 90, "method": 6})


@style.styled
def lidar_in_weather(scene: Scene, own: int, path: Path) -> None:
    """Draw one sweep in four weathers."""
    figure = style.canvas(10.0, 10.9)
    boxes = truth(scene, own)
    for axes, (title, weather) in zip(figure.subplots(2, 2).flat, SHOWN.items()):
        points = sweep(scene, own, LIDAR, weather)
        length, width, _ = scene.trace.size[own]
        draw_view(axes, BirdseyeView(points, boxes, np.ones(len(boxes), int), title, 40.0, agent_size=(length, width)))
        axes.set_title(f"{title}: {len(points):,} points")
    bar = figure.colorbar(
        ScalarMappable(HEIGHTS_M, HEIGHT_COLOURS), ax=figure.axes, location="bottom", fraction=0.02, pad=0.01, aspect=90
    )
    bar.set_label("height of a return above ground [m]; ground in grey")
    figure.savefig(path, dpi=110)


@style.styled
def radar_over_lidar(scene: Scene, own: int, path: Path) -> None:
    """Draw a radar's detections over the LiDAR's points, by their speed over ground."""
    figure = style.canvas(8.0, 9.0)
    axes = figure.add_subplot()
    points = sweep(scene, own, LIDAR)
    velocity = scene.trace.velocity[0, own]
    at = scene.world_from_actor(own) @ BUMPER
    found, actor = sweep_radar(scene, at, velocity, Radar(range_m=100.0), np.random.default_rng(0), hidden=own)
    distance, azimuth, elevation, doppler, rcs = found.T
    level = distance * np.cos(elevation)
    place = np.column_stack((level * np.cos(azimuth), level * np.sin(azimuth))) + BUMPER[:2, 3]
    ahead = velocity @ scene.world_from_actor(own)[:3, :3]
    speed = doppler + np.cos(elevation) * (np.cos(azimuth) * ahead[0] + np.sin(azimuth) * ahead[1])
    axes.set(xlim=(-40, 40), ylim=(-8, 82), aspect="equal")
    style.hide_axes(axes)
    axes.scatter(*on_page(points[:, :2]).T, s=0.5, color=style.POINT, linewidths=0, zorder=1)
    draw_boxes(axes, truth(scene, own), style.INK, width=0.7)
    size = 5 + 3 * np.clip(rcs + 20, 0, 30)
    norm = TwoSlopeNorm(0.0, -12.0, 12.0)
    order = np.argsort(np.abs(speed))
    dots = axes.scatter(
        *on_page(place[order]).T, s=size[order], c=speed[order], norm=norm, cmap="coolwarm", zorder=3,
        linewidths=0.4, edgecolors=style.INK,
    )  # fmt: skip
    axes.set_title(
        f"{len(found)} radar detections, {np.count_nonzero(actor >= 0)} of them on road users, over LiDAR points (grey)"
    )
    bar = figure.colorbar(dots, ax=axes, location="bottom", fraction=0.03, pad=0.01, aspect=70)
    bar.set_label("speed over ground along the line of sight [m/s], positive away; larger dots: larger cross-section")
    style.scale_bar(axes, 10)
    figure.savefig(path, dpi=110)


@style.styled
def rolling(scene: Scene, own: int, path: Path) -> None:
    """Draw the motion distortion (rolling shutter) of a spin that takes time."""
    figure = style.canvas(8.0, 8.6)
    axes = figure.add_subplot()
    axes.set(xlim=(-20, 20), ylim=(-20, 20), aspect="equal")
    style.hide_axes(axes)
    names = {"all at one instant": (LIDAR, style.BLUE), "over 0.1 s, as a real sensor": (ROLLING, style.VERMILLION)}
    for name, (lidar, colour) in names.items():
        points = sweep(scene, own, lidar)
        raised = points[points[:, 2] > GROUND_M]
        axes.scatter(*on_page(raised[:, :2]).T, s=1.5, color=colour, linewidths=0, label=name)
    draw_boxes(axes, truth(scene, own), style.INK, width=0.7)
    speed = np.linalg.norm(scene.trace.velocity[0, own])
    axes.set_title(
        f"a spin from a car at {speed:.0f} m/s: what is ahead (up) is measured in time, what is behind 0.05 s off"
    )
    figure.legend(loc="outside lower center", ncols=2, frameon=False, markerscale=5)
    style.scale_bar(axes, 5)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "gallery")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    scene, own = busy_scene()
    lidar_in_perspective(*busiest_drive("grid")[:2], out / "lidar_perspective.webp")
    lidar_in_weather(scene, own, out / "lidar_weather.png")
    radar_over_lidar(scene, own, out / "radar.png")
    rolling(scene, own, out / "lidar_rolling.png")


if __name__ == "__main__":
    main()

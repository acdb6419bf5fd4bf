"""Record a recipe on both sources, and fill docs/carla-source.md: python tools/source_page.py PORT OUT.

At PORT a CARLA server must run, such as `flcav carla serve grid --port PORT`; recordings are kept below OUT.
"""

import re
import sys
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from flcav.dataset.recording.recorder import open_source, record
from flcav.dataset.store import Dataset
from flcav.report import style
from flcav.sensors.camera import Camera, photograph
from flcav.sensors.frame import Frame
from flcav.sources.recipe import parse_recipe
from flcav.storage.files import write_bytes
from flcav.storage.markdown import format_table
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.traffic.traffic import simulate
from flcav.world.weather import WEATHERS

DOCS = Path(__file__).parents[1] / "docs"
PAGE, PICTURE = DOCS / "carla-source.md", DOCS / "carla-source.png"
RECIPE: dict[str, Any] = {
    **{"town": "grid", "seed": 3, "scenes": 3, "spins_per_scene": 4, "every_s": 1.0, "warmup_s": 20.0, "cavs": 2},
    "poles": [3, 8],
    "vehicle_rig": {
        "lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 32, "azimuth_steps": 900, "carla": {}}}},
        "cameras": {"camera": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 480, "height": 288}}},
    },
    "pole_rig": {
        "lidars": {
            "lidar": {
                "settings": {"channels": 64, "azimuth_steps": 1024, "down_deg": -45.0, "up_deg": 2.0, "carla": {}}
            }
        }
    },
}
SOURCES = {"built-in simulator": style.MUTED, "CARLA's protocol": style.BLUE}
EDGES_M = np.array((0.0, 10.0, 20.0, 30.0, 40.0, 60.0))  # distances of cars
RANGES_M = np.arange(0, 84, 4.0)
VEHICLES = ("car", "van")


def measure(data: Dataset) -> Mapping[str, NDArray[np.float64]]:
    """Return distance and points of every car and van of vehicles' frames, and the ranges of all their points."""
    away, returns, ranges, pole = [], [], [], []
    for i in range(len(data)):
        frame = data.frame(i)
        own = np.linalg.norm(frame.lidar["lidar"][:, :3], axis=1)
        if frame.agent.startswith("pole"):
            pole.append(own)
            continue
        ranges.append(own)
        cars = np.isin(frame.annotations.boxes.label, VEHICLES)
        place = frame.world_from_sensor("lidar")[:3, 3]
        away.append(np.linalg.norm(frame.annotations.boxes.center[cars] - place, axis=1))
        returns.append(frame.annotations.returns[cars].astype(float))
    names = ("away", "returns", "ranges", "pole")
    return {name: np.concatenate(each) for name, each in zip(names, (away, returns, ranges, pole))}


def photograph_alike(frame: Frame) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of the built-in simulator from where a frame's camera stands, in its own traffic."""
    town, seed = load_town(RECIPE["town"]), RECIPE["seed"]
    times = np.array([RECIPE["warmup_s"]])
    scene = Scene(town, simulate(town, seed=seed, cavs=0, times_s=times))
    camera = Camera(**RECIPE["vehicle_rig"]["cameras"]["camera"]["settings"])
    at = frame.world_from_sensor("camera")
    return photograph(scene, at, camera, WEATHERS["clear"], np.random.default_rng(0)).rgb


@style.styled
def draw(data: Mapping[str, Dataset], found: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> Figure:
    """Return points per car, shares of ranges, and a picture of each source."""
    figure = style.canvas(8.6, 6.2)
    (objects, ranges), pictures = figure.subplots(2, 2)
    for (name, own), colour in zip(found.items(), SOURCES.values()):
        objects.scatter(
            own["away"], np.maximum(own["returns"], 0.5), s=9, color=colour, alpha=0.6, label=name, linewidths=0
        )
        share = np.histogram(own["ranges"], RANGES_M)[0] / len(own["ranges"])
        ranges.step(RANGES_M[:-1], share, where="post", color=colour, label=name)
    objects.set(yscale="log", xlim=(0, 80), xlabel="distance of a car or van [m]", ylabel="points (0.5: none)")
    ranges.set(xlim=(0, 80), ylim=(0, None), xlabel="range of a point [m]", ylabel="share of the points")
    for axes in (objects, ranges):
        axes.grid()
    served = data["CARLA's protocol"]
    frame = next(served.frame(i) for i in range(len(served)) if served.cameras(i))
    shown = photograph_alike(frame), frame.images["camera"].rgb
    for axes, name, picture in zip(pictures, SOURCES, shown, strict=True):
        axes.imshow(picture)
        axes.set_title(f"{name}: from the same place")
        style.hide_axes(axes)
    style.key(figure, list(ranges.get_lines()))
    return figure


def tabulate(found: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> str:
    """Return the table of the page."""
    rows = []
    for low, high in pairwise(EDGES_M):
        cells: list[str] = []
        for own in found.values():
            within = (own["away"] >= low) & (own["away"] < high) & (own["returns"] > 0)
            cells += [str(int(within.sum())), f"{np.median(own['returns'][within]):.0f}" if within.any() else "–"]
        rows.append((f"{low:.0f}–{high:.0f} m", *cells))
    header = ["cars and vans at", *(f"{what}, {name}" for name in found for what in ("seen", "median of points"))]
    clouds = [("points of all sweeps of vehicles", "ranges"), ("points of all sweeps of poles", "pole")]
    more = [
        (label, *(f"{len(own[key])}, median range {np.median(own[key]):.1f} m" for own in found.values()))
        for label, key in clouds
    ]
    return f"{format_table(header, rows)}\n\n{format_table(['', *found], more)}"


def main(port: int, out: Path) -> None:
    """Record, draw, and write the page."""
    asked = (RECIPE, RECIPE | {"source": "carla", "port": port, "traffic_port": port + 50, "vehicles": 40})
    data = {}
    for name, fields in zip(SOURCES, asked):
        folder = out / re.sub(r"\W+", "-", name)
        record(open_source(parse_recipe(fields, name)), folder)
        data[name] = Dataset.open(folder)
    found = {name: measure(own) for name, own in data.items()}
    write_bytes(PICTURE, style.png(draw(data, found), dpi=110))
    text = PAGE.read_text(encoding="utf-8")
    filled = re.sub(
        r"(<!-- sources -->\n).*?(<!-- end -->)", lambda m: f"{m[1]}{tabulate(found)}\n{m[2]}", text, flags=re.S
    )
    PAGE.write_text(filled, encoding="utf-8")


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))

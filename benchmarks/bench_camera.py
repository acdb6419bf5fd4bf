"""A whole image against bare Embree tracing of one ray per pixel, in one run and one thread."""

import argparse
import json
from collections.abc import Callable

import numpy as np
from cpu_time import cpu_ms

from flcav.geometry import pose
from flcav.sensors.camera import Camera, photograph
from flcav.sensors.lens import BODY_FROM_OPTICAL, compute_pixel_rays
from flcav.sensors.rendering.render import FAR_M
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.traffic.traffic import simulate
from flcav.world.weather import WEATHERS

AIM_CLEAR, AIM_NIGHT = 7.0, 2.0


def measure(scene: Scene, agent: str, names: list[str], repeats: int) -> dict[str, float]:
    """Return the median CPU-ms of the bare trace ("bare"), of an image in each weather, and of a clear "fine" one.

    They are taken in turns.
    """
    own, camera = int(np.flatnonzero(scene.trace.actor == agent)[0]), Camera()
    at = scene.world_from_actor(own) @ pose(0.8, 0.0, 1.5) @ BODY_FROM_OPTICAL
    works: list[Callable[[], object]] = [lambda: scene.cast(at, compute_pixel_rays(camera), far_m=FAR_M, hidden=own)]
    for name in names:
        works.append(
            lambda weather=WEATHERS[name]: photograph(scene, at, camera, weather, np.random.default_rng(0), hidden=own)
        )
    fine = Camera(look="fine")
    works.append(lambda: photograph(scene, at, fine, WEATHERS["clear"], np.random.default_rng(0), hidden=own))
    return dict(zip(["bare", *names, "fine"], cpu_ms(works, repeats)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--town", default="grid")
    parser.add_argument("--weathers", nargs="+", default=["clear", "heavy_rain", "night"], choices=list(WEATHERS))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    town = load_town(arguments.town)
    scene = Scene(town, simulate(town, seed=1, cavs=1, times_s=np.array([40.0])))
    row = measure(scene, "cav0", arguments.weathers, arguments.repeats)
    if arguments.json:
        print(json.dumps(row, indent=1))
        return
    print(f"{town.name}, 640x384; CPU-ms, median of {arguments.repeats}; bare trace {row['bare']:.1f} ms")
    for name in arguments.weathers:
        print(f"{name:12} {row[name]:6.1f} ms, {row[name] / row['bare']:.2f} of bare (aim {AIM_CLEAR:.0f}, clear)")
    if "clear" in arguments.weathers:
        print(f"look fine over plain, clear: {row['fine'] / row['clear']:.2f}")
    if {"clear", "night"} <= set(arguments.weathers):
        print(f"night over clear: {row['night'] / row['clear']:.2f} (aim {AIM_NIGHT:.0f})")


if __name__ == "__main__":
    main()

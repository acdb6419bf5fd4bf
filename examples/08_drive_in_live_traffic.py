"""Let a planner of one's own drive a car through a town whose traffic reacts to it."""

import sys

import numpy as np

from flcav.geometry import rotate, wrap_angle
from flcav.sensors.observe import observe
from flcav.sensors.rig import lidar32
from flcav.world.commands import Controls, Spawn
from flcav.world.live import LiveWorld, Settings
from flcav.world.map.roads import Route, draw_route, read_net
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot


def plan(now: Snapshot, route: Route, along: float) -> Controls:
    """Return the controls: steer towards the route ahead (pure pursuit), and keep the limit and a distance."""
    trace, own = now.trace, now.row("ego")
    (x, y, _), yaw, speed = trace.position[0, own], trace.yaw[0, own], np.hypot(*trace.velocity[0, own, :2])
    aim_x, aim_y, heading = route.at(along + 4 + 0.4 * speed)
    ahead, left = rotate(aim_x - x, aim_y - y, -yaw)
    steer = np.arctan(2 * 2.8 * left / (ahead**2 + left**2)) / np.radians(70)
    others = np.delete(trace.position[0, :, :2], own, axis=0)
    away = np.linalg.norm(others[:, None] - route.at(along + np.arange(3, 60))[:, :2], axis=2).min(axis=0)
    gaps = [*(3 + np.flatnonzero(away < 1.8)), *(stop - along for stop, link in route.stops if is_red(now, link))]
    gap = min((gap for gap in gaps if gap > 0), default=100.0)
    wanted = min(route.limit(along) / (1 + 3 * abs(wrap_angle(heading - yaw))), np.sqrt(4 * max(gap - 7, 0)))
    return Controls(np.clip((wanted - speed) / 2, 0, 1), steer, np.clip((speed - wanted) / 2, 0, 1))


def is_red(now: Snapshot, link: str) -> bool:
    return now.trace.light_state[0, now.trace.light == link].item() in "ryu"


def main(seconds: float) -> None:
    town = load_town("grid")
    random = np.random.default_rng(5)
    with LiveWorld(town, Settings(seed=5, traffic=40, pedestrians=10)) as world:
        route, along = draw_route(read_net(town.net), random, 1000.0), 10.0
        x, y, yaw = route.at(along)
        world.apply(Spawn("ego", "car", 3, x, y, yaw))
        scene, hits = Scene(town, world.snapshot.trace), 0
        for step in range(round(seconds / world.settings.dt_s)):
            now = world.step({"ego": plan(world.snapshot, route, along)})
            x, y, _ = now.trace.position[0, now.row("ego")]
            along, left = route.project(x, y, along)
            hits += len(now.collisions)
            if step % 100 == 99:
                scene.follow(now.trace)
                frame = observe(scene, lidar32(), "ego", 0, scene_name="live", seed=5, number=now.step)
                print(
                    f"{now.time_s:.0f} s: {along:.0f} m along the route, {left:+.2f} m beside it, {hits} collisions; "
                    f"{len(frame.lidar['lidar'])} points, {len(frame.annotations)} actors around"
                )


if __name__ == "__main__":
    main(float(sys.argv[1] if len(sys.argv) > 1 else 60))

"""The whole LiDAR sensor against bare Embree tracing of the same rays, in one run and one thread.

The reference traces the sweep's rays, and those that pass glass again behind each pane; the sensor also looks up
materials, applies the power equation, noise and dropout, and writes points. Beside that: the sensor in rain and in fog,
and over a spin that takes time. `--slopes` compares a town with its hilly twin instead: the same streets and traffic;
and tells the cost of more triangles from that of inclined ones, which no axis-aligned box of Embree's hierarchy fits.
"""

import argparse
import json

import numpy as np
from cpu_time import cpu_ms

from flcav.sensors.lidar.lidar import build_ray_pattern, cast, draw_passes, scan
from flcav.sensors.lidar.returns import AFTER_PANE_M, PANES
from flcav.sensors.observe import observe
from flcav.sensors.rig import RIGS
from flcav.world.map.town import load_town
from flcav.world.materials import Material
from flcav.world.rays.embree import Solid
from flcav.world.scene import Scene
from flcav.world.static import TownPart, build_static_world
from flcav.world.traffic.traffic import simulate
from flcav.world.weather import WEATHERS

SLOPE = 0.05  # of the evenly sloping town; on the roads of the hilly ones the mean is about that


def measure(scene: Scene, rig_name: str, agent: str, repeats: int) -> dict[str, float]:
    """Return the figures of one agent's sensor at the scene's instant; times are CPU-ms of one thread."""
    rig, index = RIGS[rig_name], scene.index
    lidar = rig.lidars["lidar"].settings
    at = observe(scene, rig, agent, index, scene_name="bench", seed=0).world_from_sensor("lidar")
    hidden = np.flatnonzero(scene.trace.actor == agent)
    own = int(hidden[0]) if len(hidden) else None
    rays, rng = build_ray_pattern(lidar), np.random.default_rng(0)
    passes = draw_passes(lidar, rng)

    def trace(directions: np.ndarray, near_m: np.ndarray | None) -> object:
        return scene.cast(at, directions, near_m=near_m, far_m=lidar.range_m, hidden=own)

    queries: list[tuple[np.ndarray, np.ndarray | None]] = [(rays, None)]
    hits, through = scene.cast(at, rays, far_m=lidar.range_m, hidden=own), np.arange(len(rays))
    for _ in range(PANES):
        rows = scene.surfaces.first[np.maximum(hits.instance, 0)] + np.maximum(hits.face, 0)
        on_glass = (hits.instance >= 0) & (scene.surfaces.material[rows] == Material.GLASS) & passes[through]
        if not on_glass.any():
            break
        through, near = through[on_glass], hits.distance[on_glass] + np.float32(AFTER_PANE_M)
        queries.append((np.ascontiguousarray(rays[through]), near))
        hits = scene.cast(at, *queries[-1][:1], near_m=near, far_m=lidar.range_m, hidden=own)

    roll = lidar.model_copy(update={"rolling": True})
    first, bare, sensor, rain, fog, rolling, whole = cpu_ms(
        (
            lambda: trace(*queries[0]),
            lambda: [trace(*query) for query in queries],
            lambda: scan(scene, at, lidar, rng, own),
            lambda: scan(scene, at, lidar, rng, own, WEATHERS["heavy_rain"]),
            lambda: scan(scene, at, lidar, rng, own, WEATHERS["fog"]),
            lambda: scan(scene, at, roll, rng, own),
            lambda: observe(scene, rig, agent, index, scene_name="bench", seed=0),
        ),
        repeats,
    )
    echoes = cast(scene, at, lidar, passes, own)
    return {
        "rays": len(rays),
        "rays_through_glass": int(np.count_nonzero(echoes.panes)),
        "first_trace_mray_per_s": len(rays) / first / 1e3,
        "bare_ms": bare,
        "sensor_ms": sensor,
        "sensor_in_rain_ms": rain,
        "sensor_in_fog_ms": fog,
        "sensor_rolling_ms": rolling,
        "observe_ms": whole,
        "bare_over_sensor": bare / sensor,
    }


def compare_slopes(name: str, repeats: int) -> dict[str, float]:
    """Return CPU-ms of tracing a vehicle's rays, and of its annotated frame, in a town and in its hilly twin."""
    rig, rays = RIGS["lidar32"], build_ray_pattern(RIGS["lidar32"].lidars["lidar"].settings)
    works = []
    for town in (load_town(name), load_town(f"hilly_{name}")):
        scene = Scene(town, simulate(town, seed=1, cavs=4, times_s=np.array([60.0])))
        own = [int(np.flatnonzero(scene.trace.actor == f"cav{i}")[0]) for i in range(4)]
        at = [scene.world_from_actor(actor) @ rig.lidars["lidar"].mount.agent_from_sensor() for actor in own]

        def trace(scene: Scene = scene, at: list[np.ndarray] = at, own: list[int] = own) -> None:
            for here, actor in zip(at, own):
                scene.cast(here, rays, far_m=100.0, hidden=actor)

        def sense(scene: Scene = scene) -> None:
            for i in range(4):
                observe(scene, rig, f"cav{i}", 0, scene_name="bench", seed=0)

        works += [trace, sense]
    level_trace, level_frame, hilly_trace, hilly_frame = cpu_ms(works, repeats)
    return {
        "level_trace_ms": level_trace,
        "hilly_trace_ms": hilly_trace,
        "trace_ratio": hilly_trace / level_trace,
        "level_frame_ms": level_frame,
        "hilly_frame_ms": hilly_frame,
        "frame_ratio": hilly_frame / level_frame,
    }


def split_cost_of_slopes(name: str, repeats: int) -> dict[str, float]:
    """Return CPU-ms of tracing a town's static mesh alone from four vehicles, in four shapes.

    `level` and `hilly` are the two towns; `sloping` is the level one sheared by `SLOPE` together with its rays, so that
    the same rays meet the same triangles; `flattened` is the level one with the ground of the hilly one pressed flat,
    so that its triangles are as many as there.
    """
    level, hilly = load_town(name), load_town(f"hilly_{name}")
    assert hilly.relief is not None
    works, meshes, poses = [], [], []
    rays, mount = build_ray_pattern(RIGS["lidar32"].lidars["lidar"].settings), RIGS["lidar32"].lidars["lidar"].mount
    for town in (level, hilly):
        scene = Scene(town, simulate(town, seed=1, cavs=4, times_s=np.array([60.0])))
        own = [int(np.flatnonzero(scene.trace.actor == f"cav{i}")[0]) for i in range(4)]
        poses.append([scene.world_from_actor(actor) @ mount.agent_from_sensor() for actor in own])
        world = build_static_world(town)
        ground = world.part <= TownPart.SIDEWALK
        meshes.append((world.mesh.vertices, world.mesh.faces, ground))
    shear = np.eye(4)
    shear[2, 0] = SLOPE
    (vertices, faces, ground), (high, hilly_faces, hilly_ground) = meshes
    pressed = np.c_[high[:, :2], high[:, 2] - hilly.relief.heights(*high[:, :2].T)].round(3)
    both = np.concatenate((vertices, pressed)).astype(np.float32)
    flattened = np.concatenate((faces[~ground], hilly_faces[hilly_ground] + len(vertices))).astype(np.int32)
    shapes = {
        "level": (Solid(vertices, faces), poses[0]),
        "flattened": (Solid(both, flattened), poses[0]),
        "sloping": (
            Solid((vertices @ shear[:3, :3].T).astype(np.float32), faces),
            [shear @ at for at in poses[0]],
        ),
        "hilly": (Solid(high, hilly_faces), poses[1]),
    }
    for solid, at in shapes.values():

        def trace(solid: Solid = solid, at: list[np.ndarray] = at) -> None:
            for here in at:
                solid.trace(here, rays, far_m=100.0)

        works.append(trace)
    return {f"static_{shape}_ms": taken for shape, taken in zip(shapes, cpu_ms(works, repeats))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--town", default="suburb")
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--slopes", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.slopes:
        row = compare_slopes(arguments.town, arguments.repeats)
        row |= split_cost_of_slopes(arguments.town, arguments.repeats)
        if arguments.json:
            print(json.dumps(row, indent=1))
            return
        print(f"{arguments.town}, sweeps of four vehicles; CPU-ms of one thread, median of {arguments.repeats}")
        for what in ("trace", "frame"):
            level, hilly, ratio = (row[f"{name}"] for name in (f"level_{what}_ms", f"hilly_{what}_ms", f"{what}_ratio"))
            print(f"{what}: level {level:.2f} ms, hilly {hilly:.2f} ms, ratio {ratio:.2f} (aim 1.10 or less)")
        of_level = {
            shape: row[f"static_{shape}_ms"] / row["static_level_ms"] for shape in ("flattened", "sloping", "hilly")
        }
        print(
            f"town without traffic, level {row['static_level_ms']:.2f} ms; "
            f"with the hilly town's triangles pressed flat {of_level['flattened']:.2f}, "
            f"on an even slope of {SLOPE:.0%} {of_level['sloping']:.2f}, hilly {of_level['hilly']:.2f} times that"
        )
        return
    town = load_town(arguments.town)
    scene = Scene(town, simulate(town, seed=1, cavs=1, times_s=np.array([60.0])))
    agents = {"lidar32": "cav0", "lidar_pole": f"pole{town.poles.id[0]}"}
    figures = {name: measure(scene, name, agent, arguments.repeats) for name, agent in agents.items()}
    if arguments.json:
        print(json.dumps(figures, indent=1))
        return
    print(f"{town.name}, {len(scene.trace.actor)} actors; CPU-ms of one thread, median of {arguments.repeats}")
    for name, row in figures.items():
        print(
            f"{name:10} {row['rays']:6.0f} rays ({row['rays_through_glass']:.0f} through glass): "
            f"bare {row['bare_ms']:.2f} ms ({row['first_trace_mray_per_s']:.1f} Mray/s), "
            f"sensor {row['sensor_ms']:.2f} ms, ratio {row['bare_over_sensor']:.2f} (aim 0.50), "
            f"in rain {row['sensor_in_rain_ms']:.2f}, in fog {row['sensor_in_fog_ms']:.2f}, "
            f"rolling {row['sensor_rolling_ms']:.2f} ms, "
            f"annotated frame {row['observe_ms']:.2f} ms"
        )


if __name__ == "__main__":
    main()

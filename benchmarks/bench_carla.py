"""`flcav carla serve` in one run: CPU time of images, load times of maps, ticks a second, real-time factor, memory.

Images are drawn in this process, from six places of `--town`, by as many threads as the server draws them with: the CPU
time is that of all threads. All else is measured under the genuine client (needs the extra `carla`): a server and this
process share the cores; the client's time, its Traffic Manager's too, is part of the figures of ticks. Load times are
those of the client's `load_world`, first with an empty folder of kept maps, then by a new server. Memory is that of the
server, before and after `--ticks` ticks.
"""

import argparse
import json
import os
import queue
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cpu_time import cpu_ms

from flcav.carla.server.calls import Calls
from flcav.carla.server.maps import Maps
from flcav.carla.server.sensors import sense_depth, sense_instance, sense_rgb, sense_semantic
from flcav.carla.server.sight import Sensor, TownSight

DT_S = 0.05
VEHICLES = 20
PLACES = 6
EYE_M = 1.3  # above a spawn point, which is above the road
SIZES = ((640, 384), (800, 600), (1280, 720))
IMAGES: dict[str, tuple[Callable[[TownSight, Sensor], bytes], str]] = {
    "rgb": (sense_rgb, "high"),
    "rgb, low": (sense_rgb, "low"),
    "depth": (sense_depth, "high"),
    "semantic": (sense_semantic, "high"),
    "instance": (sense_instance, "high"),
}


def time_images(maps: Maps, town: str, repeats: int) -> dict[str, list[float]]:
    """Return the CPU time [ms] of an image of each kind, by size."""
    calls = Calls(maps, town, seed=0, traffic=VEHICLES, port=2000)
    episode = calls.episode
    for _ in range(100):
        episode.step(DT_S)
    episode.prepare()
    points = episode.spawn_points
    poses = []
    for (x, y, z), rotation in points[:: max(1, len(points) // PLACES)][:PLACES]:
        poses.append(episode.served.frame.from_transform((x, y, z + EYE_M), rotation))

    def draw(kind: str, size: tuple[int, int]) -> Callable[[], None]:
        sense, quality = IMAGES[kind]
        told = {"image_size_x": str(size[0]), "image_size_y": str(size[1]), "fov": "90", "quality": quality}

        def draw_all() -> None:
            for pose in poses:
                sense(episode.look("images")(), Sensor("sensor.camera", told, 0, pose))

        return draw_all

    taken = cpu_ms([draw(kind, size) for size in SIZES for kind in IMAGES], repeats)
    episode.close()
    by_size = [taken[row : row + len(IMAGES)] for row in range(0, len(taken), len(IMAGES))]
    return {kind: [times[row] / len(poses) for times in by_size] for row, kind in enumerate(IMAGES)}


def time_loads(carla: Any, folder: Path, port: int) -> dict[str, list[float]]:
    """Return how long `load_world` takes [s] by map, and the first image after it: not kept, and kept."""
    out: dict[str, list[float]] = {path.stem: [] for path in sorted(folder.glob("*.xodr"))}
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(2):
            server = start_server("grid", port, "--maps", str(folder), XDG_CACHE_HOME=cache)
            try:
                client = carla.Client("127.0.0.1", port)
                client.set_timeout(120.0)
                for name, times in out.items():
                    begun = time.perf_counter()
                    world = client.load_world(name)
                    loaded, images = time.perf_counter(), queue.Queue[Any]()
                    blueprint = world.get_blueprint_library().find("sensor.camera.rgb")
                    camera = world.spawn_actor(blueprint, world.get_map().get_spawn_points()[0])
                    camera.listen(images.put)
                    images.get(timeout=120.0)
                    times += [loaded - begun, time.perf_counter() - loaded]
                    camera.stop()
                    camera.destroy()
            finally:
                server.terminate()
                server.wait()
    return out


def show(title: str, heads: list[str], rows: dict[str, list[float]], form: str) -> None:
    """Print a table of Markdown."""
    print(f"| {' | '.join([title, *heads])} |\n|{'---|' * (len(heads) + 1)}")
    for name, values in rows.items():
        print(f"| {' | '.join([name, *(format(value, form) for value in values)])} |")
    print(flush=True)


def start_server(town: str, port: int, *options: str, **variables: str) -> subprocess.Popen[str]:
    """Return a server that is ready."""
    command = [sys.executable, "-m", "flcav", "carla", "serve", town, "--port", str(port), *options]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | variables)
    assert server.stdout is not None
    if "ready" not in server.stdout.readline():
        raise SystemExit("the server did not start")
    return server


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024


def ticks_per_s(world: Any, count: int) -> float:
    """Return how many ticks a second a synchronous client gets."""
    begun = time.perf_counter()
    for _ in range(count):
        world.tick()
    return count / (time.perf_counter() - begun)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--town", default="grid")
    parser.add_argument("--ticks", type=int, default=1000, help="ticks of the run that looks at memory")
    parser.add_argument("--maps", type=Path, help="folder with OpenDRIVE maps, whose load times are measured")
    parser.add_argument("--repeats", type=int, default=5, help="of each image")
    options = parser.parse_args()
    images = time_images(Maps(options.maps), options.town, options.repeats)
    show(f"CPU-ms, {options.town}", [f"{width} x {height}" for width, height in SIZES], images, ".0f")
    try:
        import carla
    except ImportError:
        print("skipped: needs the extra 'carla'")
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    if options.maps is not None:
        heads = ["load_world [s]", "first image [s]", "kept: load_world [s]", "first image [s]"]
        show("map", heads, time_loads(carla, options.maps, port), ".1f")
    server = start_server(options.town, port, *(["--maps", str(options.maps)] if options.maps is not None else []))
    try:
        client = carla.Client("127.0.0.1", port)
        client.set_timeout(60.0)
        world = client.get_world()
        settings = world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, DT_S
        world.apply_settings(settings)
        world.tick()
        figures: dict[str, float] = {"empty_ticks_per_s": ticks_per_s(world, 500)}

        library, points = world.get_blueprint_library(), world.get_map().get_spawn_points()
        manager = client.get_trafficmanager(port + 6)
        manager.set_synchronous_mode(True)
        manager.set_random_device_seed(0)
        car = library.find("vehicle.tesla.model3")
        spawn = carla.command.SpawnActor
        future: Any = carla.command.FutureActor
        autopilot = carla.command.SetAutopilot(future, True, manager.get_port())
        places = points[:: max(1, len(points) // VEHICLES)][:VEHICLES]
        answers = client.apply_batch_sync([spawn(car, place).then(autopilot) for place in places], True)
        figures["vehicles"] = sum(not answer.error for answer in answers)
        ticks_per_s(world, 100)
        figures["traffic_manager_ticks_per_s"] = ticks_per_s(world, 500)

        ego, counts = world.get_actor(answers[0].actor_id), {"camera": 0, "lidar": 0}
        sensors = []
        for name, attributes in (
            ("camera", {"image_size_x": "640", "image_size_y": "384"}),
            ("lidar", {"channels": "64", "range": "100", "points_per_second": "1300000", "rotation_frequency": "10"}),
        ):
            kind = "sensor.camera.rgb" if name == "camera" else "sensor.lidar.ray_cast"
            blueprint = library.find(kind)
            for key, value in (attributes | {"sensor_tick": "0.1"}).items():
                blueprint.set_attribute(key, value)
            sensor: Any = world.spawn_actor(blueprint, carla.Transform(carla.Location(x=1.5, z=2.4)), attach_to=ego)

            def count(data: Any, name: str = name) -> None:
                counts[name] += 1

            sensor.listen(count)
            sensors.append(sensor)
        ticks_per_s(world, 20)
        time.sleep(1.0)
        counts["camera"] = counts["lidar"] = 0
        figures["real_time_factor"] = ticks_per_s(world, 200) * DT_S
        time.sleep(1.0)
        figures |= {f"{name}_frames_of_100": float(value) for name, value in counts.items()}
        for sensor in sensors:
            sensor.stop()
            sensor.destroy()

        figures["memory_before_mb"] = memory_mb(server.pid)
        figures["long_run_ticks_per_s"] = ticks_per_s(world, options.ticks)
        figures["memory_after_mb"] = memory_mb(server.pid)
        moved = [actor.get_velocity().length() for actor in world.get_actors().filter("vehicle.*")]
        figures["vehicles_moving"] = sum(speed > 0.5 for speed in moved)
        manager.set_synchronous_mode(False)
        manager.shut_down()
        settings.synchronous_mode = False
        world.apply_settings(settings)
        print(json.dumps({name: round(value, 2) for name, value in figures.items()}, indent=2))
    finally:
        server.terminate()
        server.wait()


if __name__ == "__main__":
    main()

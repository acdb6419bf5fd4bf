"""`flcav carla serve` under the genuine client, in one run: ticks a second, and simulated time over the clock's.

A server of grid and this process share the cores; the client's time, its Traffic Manager's too, is part of all figures.
Memory is that of the server, before and after `--ticks` ticks. Needs the extra `carla`.
"""

import argparse
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

DT_S = 0.05
VEHICLES = 20


def start_server(town: str, port: int) -> subprocess.Popen[str]:
    """Return a server that is ready."""
    command = [sys.executable, "-m", "flcav", "carla", "serve", town, "--port", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
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
    options = parser.parse_args()
    try:
        import carla
    except ImportError:
        print("skipped: needs the extra 'carla'")
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = start_server(options.town, port)
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

"""A session of the genuine CARLA client, in a process of its own, since a client that is misled aborts its process.

python carla_session.py NAME PORT TRAFFIC_PORT runs the function of that name; it prints "passed" at its end.
"""

import queue
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import carla  # pyright: ignore[reportMissingImports]
import numpy as np
import pytest

DT_S = 0.05
LONGEST_S = 300.0  # that one measurement takes on a busy machine


@contextmanager
def synchronous(client: Any) -> Iterator[Any]:
    """Give the world in synchronous mode, and destroy what was spawned in it."""
    world = client.get_world()
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, DT_S
    world.apply_settings(settings)
    world.tick()
    before = {actor.id for actor in world.get_actors()}
    try:
        yield world
    finally:
        world.tick()
        left = [actor.id for actor in world.get_actors() if actor.id not in before]
        client.apply_batch_sync([carla.command.DestroyActor(number) for number in left])
        settings.synchronous_mode, settings.fixed_delta_seconds = False, None
        world.apply_settings(settings)


def listen(world: Any, kind: str, parent: Any, **attributes: Any) -> "queue.Queue[Any]":
    """Spawn a sensor on `parent`; return the queue of what it sends."""
    blueprint = world.get_blueprint_library().find(kind)
    for name, value in attributes.items():
        blueprint.set_attribute(name, str(value))
    sensor = world.spawn_actor(blueprint, carla.Transform(carla.Location(z=2.4)), attach_to=parent)
    sent: queue.Queue[Any] = queue.Queue()
    sensor.listen(sent.put)
    parent.heard = [*getattr(parent, "heard", []), sensor]  # a sensor stops when it is collected
    return sent


def the_world(client: Any) -> None:
    """Map, blueprints, settings, weather, snapshots, boxes and the spectator."""
    assert client.get_client_version() == client.get_server_version()
    with synchronous(client) as world:
        town = world.get_map()
        points = town.get_spawn_points()
        assert town.name.endswith("suburb")
        assert len(points) > 20
        assert all(town.get_waypoint(point.location, project_to_road=False) for point in points)
        library = world.get_blueprint_library()
        assert len(library.filter("vehicle.*")) == 41
        assert len(library.filter("walker.*")) == 52
        for weather in (carla.WeatherParameters(80.0, 60.0, fog_density=5.0), carla.WeatherParameters()):
            world.set_weather(weather)
            assert world.get_weather() == weather
        frame = world.tick()
        snapshot = world.get_snapshot()
        assert snapshot.frame == frame
        assert abs(snapshot.timestamp.delta_seconds - DT_S) < 1e-6
        assert all(snapshot.has_actor(actor.id) for actor in world.get_actors())
        assert len(world.get_level_bbs(carla.CityObjectLabel.Buildings)) > 100
        assert world.get_environment_objects(carla.CityObjectLabel.Vegetation)
        ground = world.ground_projection(points[0].location, 5.0)
        assert ground.label == carla.CityObjectLabel.Roads
        assert abs(ground.location.z) < 0.1
        here = carla.Transform(carla.Location(1, 2, 3), carla.Rotation(-20, 30, 0))
        world.get_spectator().set_transform(here)
        world.tick()
        assert world.get_spectator().get_transform().location.distance(here.location) < 1e-3


def walkers(client: Any) -> None:
    """The client's own crowd, on the navigation mesh of the server: walkers keep to footpaths and crossings."""
    with synchronous(client) as world:
        library, crowd = world.get_blueprint_library(), []
        for number in range(8):
            place = world.get_random_location_from_navigation()
            assert abs(place.z - 0.12) < 0.05  # upon the kerb
            kind = library.filter("walker.pedestrian.*")[number]
            crowd.append(world.spawn_actor(kind, carla.Transform(place + carla.Location(z=1.0))))
        world.tick()
        mind = library.find("controller.ai.walker")
        minds = [world.spawn_actor(mind, carla.Transform(), attach_to=walker) for walker in crowd]
        world.tick()
        for each in minds:
            each.start()
            each.go_to_location(world.get_random_location_from_navigation())
            each.set_max_speed(1.4)
        begun = [walker.get_location() for walker in crowd]
        for _ in range(100):
            world.tick()
        gone = [walker.get_location().distance(place) for walker, place in zip(crowd, begun, strict=True)]
        assert sorted(gone)[4] > 4.0
        assert max(gone) < 1.5 * 5.0
        assert sum(abs(walker.get_velocity().length() - 1.4) < 0.2 for walker in crowd) >= 6
        town = world.get_map()
        lanes = [town.get_waypoint(walker.get_location(), True, carla.LaneType.Sidewalk) for walker in crowd]
        away = [lane.transform.location.distance_2d(walker.get_location()) for lane, walker in zip(lanes, crowd)]
        assert sorted(away)[5] < 3.0
        for each in (*minds, *crowd):
            each.destroy()


def actors(client: Any) -> None:
    """Vehicles, walkers and props: spawning, driving, batches, lamps, friction and physics."""
    with synchronous(client) as world:
        library, points = world.get_blueprint_library(), world.get_map().get_spawn_points()
        car = world.spawn_actor(library.find("vehicle.tesla.model3"), points[0])
        assert world.try_spawn_actor(library.find("vehicle.audi.tt"), points[0]) is None
        world.tick()
        assert car.get_transform().location.distance(points[0].location) < 0.5
        assert abs(car.get_transform().rotation.yaw - points[0].rotation.yaw) < 1e-3
        car.apply_control(carla.VehicleControl(throttle=1.0))
        for _ in range(40):
            world.tick()
        ahead = points[0].get_forward_vector()
        assert car.get_velocity().dot(ahead) > 3
        assert car.get_control().throttle == 1.0
        car.set_light_state(carla.VehicleLightState.HighBeam)
        assert car.get_light_state() == carla.VehicleLightState.HighBeam
        physics = car.get_physics_control()
        assert len(physics.wheels) == 4
        assert physics.mass > 500
        car.apply_ackermann_control(carla.VehicleAckermannControl(speed=5.0))
        for _ in range(80):
            world.tick()
        assert abs(car.get_velocity().length() - 5.0) < 1.0
        ice = library.find("static.trigger.friction")
        for name, value in {"friction": 0.1, "extent_x": 1e4, "extent_y": 1e4, "extent_z": 1e4}.items():
            ice.set_attribute(name, str(value))  # 100 m to all sides
        for blueprint in (ice, library.find("util.actor.empty")):
            world.spawn_actor(blueprint, car.get_transform())
        before = car.get_velocity().length()
        car.apply_control(carla.VehicleControl(brake=1.0))
        for _ in range(10):
            world.tick()
        assert abs(before - car.get_velocity().length() - 0.5 * 0.1 * 0.9 * 9.81) < 0.1
        walker = world.spawn_actor(library.find("walker.pedestrian.0001"), points[5])
        walker.apply_control(carla.WalkerControl(carla.Vector3D(0, 1, 0), 1.4))
        for _ in range(5):
            world.tick()
        assert abs(walker.get_velocity().y - 1.4) < 0.1
        walker.destroy()
        command = carla.command
        spawn = command.SpawnActor(library.find("vehicle.mini.cooper_s"), points[9])
        first, second, third = client.apply_batch_sync([spawn, spawn, command.DestroyActor(99999)], True)
        assert not first.error
        assert "collision" in second.error
        assert "99999" in third.error
        prop = world.spawn_actor(library.find("static.prop.streetbarrier"), points[12])
        world.tick()  # only then clients know it to be alive
        assert prop.destroy()


def sensors(client: Any) -> None:
    """All sensors, every tick, whole, in order, and of the tick."""
    with synchronous(client) as world:
        points = world.get_map().get_spawn_points()
        car = world.spawn_actor(world.get_blueprint_library().find("vehicle.tesla.model3"), points[0])
        small = {"image_size_x": 64, "image_size_y": 48}
        spin = {"channels": 8, "range": 60, "rotation_frequency": 20, "points_per_second": 64000}
        sent = {
            name: listen(world, f"sensor.{name}", car, **attributes)
            for name, attributes in {
                "camera.rgb": small,
                "camera.depth": small,
                "camera.semantic_segmentation": small,
                "camera.instance_segmentation": small,
                "lidar.ray_cast": spin | {"dropoff_general_rate": 0, "dropoff_intensity_limit": 0},
                "lidar.ray_cast_semantic": spin,
                "other.gnss": {},
                "other.imu": {},
                "other.radar": {},
            }.items()
        }
        slow = listen(world, "sensor.other.gnss", car, sensor_tick=0.1)
        frames = [world.tick() for _ in range(4)]
        got = {name: [box.get(timeout=LONGEST_S) for _ in frames] for name, box in sent.items()}
        assert [slow.get(timeout=LONGEST_S).frame for _ in range(2)] == frames[::2]
        for name, measured in got.items():
            assert [each.frame for each in measured] == frames, name
        last = {name: measured[-1] for name, measured in got.items()}
        colours = np.frombuffer(last["camera.rgb"].raw_data, np.uint8).reshape(48, 64, 4)
        assert colours[..., :3].std() > 10
        tags = np.frombuffer(last["camera.semantic_segmentation"].raw_data, np.uint8).reshape(48, 64, 4)
        assert (tags[40:, :, 2] == 1).any()
        assert (tags[:5, :, 2] == 11).any()
        sweep, labelled = last["lidar.ray_cast"], last["lidar.ray_cast_semantic"]
        assert len(sweep) == len(labelled) == sum(sweep.get_point_count(channel) for channel in range(8))
        assert {detection.object_tag for detection in labelled} >= {1, 2}
        assert abs(last["other.imu"].accelerometer.z - 9.81) < 0.01
        fix = last["other.gnss"]
        known = world.get_map().transform_to_geolocation(fix.transform.location)
        assert abs(fix.latitude - known.latitude) < 1e-6  # the client computes with less exactness
        assert abs(fix.longitude - known.longitude) < 1e-6
        assert all(0 < detection.depth <= 100 for detection in last["other.radar"])
        for sensor in car.heard:
            sensor.stop()

        blueprint = world.get_blueprint_library().find("sensor.camera.dvs")
        with pytest.raises(RuntimeError, match=r"sensor\.camera\.dvs is not served"):
            world.spawn_actor(blueprint, carla.Transform())


def events(client: Any) -> None:
    """A collision and an obstacle."""
    with synchronous(client) as world:
        library, points = world.get_blueprint_library(), world.get_map().get_spawn_points()
        car = world.spawn_actor(library.find("vehicle.tesla.model3"), points[0])
        world.tick()
        ahead = car.get_transform()
        ahead.location += 9.0 * ahead.get_forward_vector() + carla.Location(z=0.3)
        other = world.spawn_actor(library.find("vehicle.carlamotors.carlacola"), ahead)
        hits, seen = (
            listen(world, "sensor.other.collision", car),
            listen(world, "sensor.other.obstacle", car, distance=20),
        )
        world.tick()
        obstacle = seen.get(timeout=LONGEST_S)
        assert obstacle.other_actor.id == other.id
        assert 1 < obstacle.distance < 9
        car.apply_control(carla.VehicleControl(throttle=1.0))
        for _ in range(60):
            world.tick()
            if not hits.empty():
                break
        hit = hits.get(timeout=LONGEST_S)
        assert hit.actor.id == car.id
        assert hit.other_actor.id == other.id
        assert hit.normal_impulse.dot(ahead.get_forward_vector()) < 0
        for sensor in car.heard:
            sensor.stop()


def traffic(client: Any) -> None:
    """The client's own Traffic Manager drives cars."""
    with synchronous(client) as world:
        library, points = world.get_blueprint_library(), world.get_map().get_spawn_points()
        manager = client.get_trafficmanager(int(sys.argv[3]))
        manager.set_synchronous_mode(True)
        manager.set_random_device_seed(0)
        car = library.find("vehicle.tesla.model3")
        command = carla.command
        future: Any = command.FutureActor
        pilot = command.SetAutopilot(future, True, manager.get_port())
        batch = [command.SpawnActor(car, point).then(pilot) for point in points[::20]]
        answers = client.apply_batch_sync(batch, True)
        cars = world.get_actors([answer.actor_id for answer in answers if not answer.error])
        begun = {each.id: each.get_location() for each in cars}
        for _ in range(120):
            world.tick()
        moved = [each.get_location().distance(begun[each.id]) for each in cars]
        assert sum(distance > 5 for distance in moved) >= len(moved) / 2, moved
        manager.set_synchronous_mode(False)
        manager.shut_down()


def loading(client: Any) -> None:
    """Another map, the same again, an unknown one, and one that the client brings."""
    world = client.get_world()
    number = world.id
    with pytest.raises(RuntimeError, match="no map 'Town77'"):
        client.load_world("Town77")
    world = client.load_world("ring")
    assert world.get_map().name.endswith("ring")
    assert world.id != number
    assert client.reload_world().id != world.id
    world = client.generate_opendrive_world(world.get_map().to_opendrive())
    assert world.get_map().name.endswith("OpenDriveMap")
    assert len(world.get_map().get_spawn_points()) > 10
    assert world.wait_for_tick(10.0).frame > 0
    assert client.load_world("suburb").get_map().name.endswith("suburb")


def loading_beside_a_manager(client: Any) -> None:
    """A Traffic Manager that drives nobody, whose thread goes on while the client loads maps."""
    manager = client.get_trafficmanager(int(sys.argv[3]))
    for town in ("ring", "suburb") * 4:
        assert client.load_world(town).get_map().name.endswith(town)
    manager.shut_down()


SESSIONS = {
    each.__name__: each
    for each in (the_world, actors, walkers, sensors, events, traffic, loading, loading_beside_a_manager)
}

if __name__ == "__main__":
    genuine = carla.Client("127.0.0.1", int(sys.argv[2]))
    genuine.set_timeout(LONGEST_S)
    SESSIONS[sys.argv[1]](genuine)
    time.sleep(0.1)
    print("passed", flush=True)

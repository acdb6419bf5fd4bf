"""CarlaFLCAV's recorder (FLDatasetTool) in its default configuration, by its calls and its files: `FOLDER PORT TICKS`.

Five cars that agents drive, a post, 63 cars of a Traffic Manager in Town02. After each third tick every sensor's queue
is asked for at most a second, in a thread for each, and what is not there by then is lost without a word, as there.
"""

import csv
import math
import pickle
import queue
import random
import sys
import types
from multiprocessing.dummy import Pool
from pathlib import Path

import carla
import numpy as np
from agents.navigation.basic_agent import BasicAgent
from PIL import Image

STEP, WAIT_S = 3, 1.0
CARS, OTHERS, MORE = (73, 76, 68, 82, 90), (44, 55, 64, 39, 58, 10, 95, 3, 13, 100, 5, 26, 25), 50  # spawn points
POST = carla.Location(41.0, 240.0, 2.7)
PICTURE = {"image_size_x": 1382, "image_size_y": 512, "fov": 90.0}
SPIN = {"range": 100, "channels": 64, "points_per_second": 1300000, "upper_fov": 2.0, "lower_fov": -24.8}
SPIN |= {"rotation_frequency": 10}
BEAM = {"horizontal_fov": 30.0, "vertical_fov": 10.0, "points_per_second": 1500, "range": 100.0}
OF_CARS = (
    ("sensor.camera.rgb", "image_2", (2.0, 2.0), PICTURE),
    ("sensor.camera.semantic_segmentation", "image_2_semantic", (2.0, 2.0), PICTURE),
    ("sensor.lidar.ray_cast", "velodyne", (0.0, 2.4), SPIN | {"noise_stddev": 0.02}),
    ("sensor.lidar.ray_cast_semantic", "velodyne_semantic", (0.0, 2.4), SPIN),
    ("sensor.other.radar", "radar_front", (2.0, 2.0), BEAM),
)
FEW, SOME = SPIN | {"channels": 16, "points_per_second": 300000}, SPIN | {"channels": 32, "points_per_second": 695000}
OF_POST = (
    ("sensor.camera.rgb", "image_2", (0.0, 0.0), {"image_size_x": 800, "image_size_y": 600, "fov": 90.0}),
    ("sensor.lidar.ray_cast", "velodyne_16", (0.0, 0.0), FEW | {"upper_fov": 15.0, "lower_fov": -15.0}),
    ("sensor.lidar.ray_cast", "velodyne_32", (0.0, 0.0), SOME | {"upper_fov": 10.67, "lower_fov": -30.67}),
    ("sensor.lidar.ray_cast", "velodyne_64", (0.0, 0.0), SPIN | {"range": 120}),
)
SEMANTIC = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "CosAngle")), ("ObjIdx", "<u4"), ("ObjTag", "<u4")])
carla.CityObjectLabel.Vehicles = carla.CityObjectLabel.Car  # the name that it had until 0.9.13


def define(module, name, fields):
    """Return a class of records by the name that the recorder's pickles have."""
    sys.modules.setdefault("utils", types.ModuleType("utils"))
    module = sys.modules.setdefault(module, types.ModuleType(module))
    made = type(name, (), {"__module__": module.__name__})
    setattr(module, name, made)

    def fill(*values):
        record = made()
        vars(record).update(zip(fields.split(), values))
        return record

    return fill


label = define("utils.label_types", "ObjectLabel", "frame timestamp label_type carla_id transform bounding_box")
location = define("utils.geometry_types", "Location", "x y z")
vector = define("utils.geometry_types", "Vector3d", "x y z")
rotation = define("utils.geometry_types", "Rotation", "roll pitch yaw")
transform = define("utils.geometry_types", "Transform", "location rotation")
box = define("utils.geometry_types", "BoundingBox", "location extent rotation")


def turn(found):
    """Return a transform, or the place of a box, right-handed."""
    at, by = found.location, found.rotation
    return location(at.x, -at.y, at.z), rotation(by.roll, -by.pitch, -by.yaw)


def list_labels(world, frame, time_s):
    """Return the labels of a tick: of the map's parked cars and people, and of the actors."""
    labels = []
    for tag, kind in ((carla.CityObjectLabel.Vehicles, "vehicle"), (carla.CityObjectLabel.Pedestrians, "pedestrian")):
        for found in world.get_environment_objects(object_type=tag):
            half = found.bounding_box.extent
            about = box(location(0, 0, 0), vector(half.x, half.y, half.z), rotation(0.0, 0.0, 0.0))
            labels.append(label(frame, time_s, kind, found.id, transform(*turn(found.transform)), about))
    for actor in world.get_actors():
        if actor.type_id.startswith(("vehicle", "walker")):
            own, half = actor.bounding_box, actor.bounding_box.extent
            at, by = turn(own)
            about = box(at, vector(half.x, half.y, half.z), by)
            kind = "pedestrian" if actor.type_id.startswith("walker") else "vehicle"
            labels.append(label(frame, time_s, kind, actor.id, transform(*turn(actor.get_transform())), about))
    return labels


def write_row(path, row):
    """Add a row to a table."""
    new = not path.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


def stand(frame, time_s, actor, optical=False):
    """Return where an actor is, as a row; of a camera with the axes of its image."""
    found = actor.get_transform()
    at, by = turn(found)
    if optical:
        turned = np.array(found.get_matrix())[:3, :3] * np.outer((1, -1, 1), (1, -1, 1))
        turned = turned @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        flat = math.hypot(turned[0, 0], turned[1, 0])
        angles = (turned[2, 1], turned[2, 2]), (-turned[2, 0], flat), (turned[1, 0], turned[0, 0])
        by = rotation(*(math.degrees(math.atan2(*each)) for each in angles))
    return {"frame": frame, "timestamp": time_s, **vars(at), **vars(by)}


class Sensor:
    """A sensor, its queue and its folder."""

    def __init__(self, world, folder, parent, kind, name, place, settings):
        blueprint = world.get_blueprint_library().find(kind)
        for key, value in settings.items():
            blueprint.set_attribute(key, str(value))
        ahead, up = place
        at = carla.Transform(carla.Location(x=ahead, z=up), carla.Rotation())
        if parent is None:
            self.actor = world.spawn_actor(blueprint, carla.Transform(POST, carla.Rotation()))
        else:
            self.actor = world.spawn_actor(blueprint, at, parent)
        self.folder, self.kind, self.queue = folder / name, kind, queue.Queue()
        self.actor.listen(self.queue.put)

    def save(self, frame, time_s):
        """Write what is sent for a frame; raises `queue.Empty` after a second."""
        found = None
        while found is None or found.frame < frame:
            found = self.queue.get(True, WAIT_S)
        self.folder.mkdir(parents=True, exist_ok=True)
        path, camera = self.folder / f"{found.frame:0>10d}", self.kind.startswith("sensor.camera")
        if camera:
            if self.kind.endswith("segmentation"):
                found.convert(carla.ColorConverter.CityScapesPalette)
            pixels = np.frombuffer(found.raw_data, np.uint8).reshape(found.height, found.width, 4)
            Image.fromarray(pixels[..., [2, 1, 0, 3]]).save(f"{path}.png", compress_level=1)
            width, height, fov = (float(self.actor.attributes[name]) for name in PICTURE)
            focal = width / (2.0 * math.tan(math.radians(fov) / 2))
            if not (info := self.folder / "camera_info.csv").exists():
                sizes = {"width": int(width), "height": int(height), "fx": focal, "fy": focal}
                write_row(info, {**sizes, "cx": width / 2.0, "cy": height / 2.0})
        elif self.kind == "sensor.other.radar":
            np.save(
                path,
                np.array([[0.0, 0.0, 0.0, each.depth, each.velocity, each.azimuth, each.altitude] for each in found]),
            )
        else:
            points = np.frombuffer(
                bytes(found.raw_data), SEMANTIC if self.kind.endswith("semantic") else np.dtype("<f4")
            )
            points = points.copy() if points.dtype == SEMANTIC else points.reshape(-1, 4).copy()
            if points.dtype == SEMANTIC:
                points["y"] *= -1
            else:
                points[:, 1] *= -1
            np.save(path, points)
        write_row(self.folder / "poses.csv", stand(frame, time_s, self.actor, camera))


def save_status(folder, car, frame, time_s):
    """Add a row to the table of a car."""
    speed, force, control = car.get_velocity(), car.get_acceleration(), car.get_control()
    row = {**stand(frame, time_s, car), "speed": 3.6 * speed.length()}
    row |= {f"v{axis}": getattr(speed, axis) for axis in "xyz"} | {f"a{axis}": getattr(force, axis) for axis in "xyz"}
    row |= {name: getattr(control, name) for name in ("throttle", "brake", "steer", "reverse", "gear")}
    write_row(folder / "vehicle_status.csv", row)


def record(folder, port, ticks):
    """Record in a folder."""
    random.seed(5)
    client = carla.Client("127.0.0.1", port)
    client.set_timeout(10.0)
    world = client.get_world()
    manager = client.get_trafficmanager(port + 6000)
    client.load_world("Town02")
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.1
    settings.substepping, settings.max_substep_delta_time, settings.max_substeps = True, 0.01, 16
    looks = carla.Transform(carla.Location(100.0, 150.0, 150.0), carla.Rotation(pitch=-60.0, yaw=90.0))
    world.get_spectator().set_transform(looks)
    world.apply_settings(settings)
    manager.set_synchronous_mode(True)
    for actor in world.get_actors():
        if isinstance(actor, carla.TrafficLight):
            actor.set_red_time(2.0)
            actor.set_green_time(2.0)
            actor.set_yellow_time(0.01)
    library, points = world.get_blueprint_library(), world.get_map().get_spawn_points()
    cars, sensors = {}, []
    for number, row in enumerate(CARS):
        at = folder / ("vehicle.tesla.model3.master" if not number else f"vehicle.tesla.model3_{6 * number + 1}")
        car = world.spawn_actor(library.find("vehicle.tesla.model3"), points[row])
        cars[at] = car, BasicAgent(car)
        sensors += [Sensor(world, at, car, *each) for each in OF_CARS]
    sensors += [Sensor(world, folder / "infra_t_junction", None, *each) for each in OF_POST]
    every = library.filter("vehicle.*")
    others = [world.spawn_actor(random.choice(every), points[row]) for row in OTHERS]
    for _ in range(MORE):
        try:
            others.append(world.spawn_actor(random.choice(every), random.choice(points)))
        except RuntimeError:
            continue
    folder.mkdir(parents=True)
    (folder / "others.world_0").mkdir()
    client.start_recorder(str(folder / "carla_raw_record.log"))
    for number in range(ticks):
        for car, agent in cars.values():
            car.apply_control(agent.run_step())
        for other in others:
            other.set_autopilot(True, port + 6000)
        frame = world.tick(seconds=60.0)
        time_s = world.get_snapshot().timestamp.elapsed_seconds
        if number % STEP:
            continue
        with (folder / "others.world_0" / f"{frame:0>10d}.pkl").open("wb") as file:
            pickle.dump(list_labels(world, frame, time_s), file)
        for at, (car, _) in cars.items():
            save_status(at, car, frame, time_s)
        pool = Pool()
        pool.starmap_async(Sensor.save, [(sensor, frame, time_s) for sensor in sensors], chunksize=1)
        pool.close()
        pool.join()
    client.stop_recorder()
    for actor in [*(each.actor for each in sensors), *(car for car, _ in cars.values()), *others]:
        actor.destroy()
    client.reload_world()
    print("done.", flush=True)


record(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))

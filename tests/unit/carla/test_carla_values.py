"""What clients read of vehicles, signs and sensors, against CARLA's rules."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from carla_calls import describe, invoke, place
from PIL import Image
from shapely.geometry import LineString, Point

from flcav.carla.frames import mirror
from flcav.carla.server import maps as carla_maps
from flcav.carla.server import wire
from flcav.carla.server.actors import choose_gear
from flcav.carla.server.blueprints import CallRefused, Quality, check_description, list_blueprints
from flcav.carla.server.calls import Calls
from flcav.carla.server.lights import find_limits, list_signals
from flcav.carla.server.maps import OPENDRIVE_MAP, SPAWN_POINTS, Maps
from flcav.carla.server.sensors import sense_rgb
from flcav.carla.server.wire import VehicleControl
from flcav.config import InputError
from flcav.sensors.frame import SEMANTICS
from flcav.world import static
from flcav.world.dynamics.obstacles import list_obstacles
from flcav.world.dynamics.vehicle import make_blueprint
from flcav.world.opendrive.importing import ImportedTown

DT_S = 0.05


def spawn(calls, name, where, *attributes):
    return calls.episode.find(invoke(calls, "spawn_actor", (describe(name, *attributes), where)).id)


def tick(calls, count=1):
    for _ in range(count):
        calls.episode.step(DT_S)


def drive(calls, car, **pedals):
    control = [*VehicleControl(**pedals)]
    invoke(calls, "apply_control_to_vehicle", (car.id, control))


def test_wheels_are_where_the_car_is_driven_by(calls):
    car = spawn(calls, "vehicle.tesla.model3", place(calls))
    made = make_blueprint(car.category, 0, car.size)
    places = [wheel[-1] for wheel in invoke(calls, "get_physics_control", (car.id,))[-2]]  # [cm]
    wheels = 0.01 * np.array(places).reshape(2, 2, 3)  # front and rear, left and right
    assert np.linalg.norm(wheels[0] - wheels[1], axis=1) == pytest.approx(made.wheelbase_m)
    assert 0.6 < np.linalg.norm(wheels[:, 0] - wheels[:, 1], axis=1).max() / car.size[1] < 1.0
    assert wheels.mean(axis=(0, 1))[:2] == pytest.approx(car.transform.location[:2], abs=1e-3)


def test_a_car_far_from_all_lights_names_none(calls):
    car = spawn(calls, "vehicle.tesla.model3", place(calls))
    *_, at_light, number, _ = wire.VEHICLE.unpack(calls.episode._union(car, {car.id: -1}))
    assert (at_light, number) == (False, 0)


@pytest.mark.parametrize(("sticky", "ticks"), [("True", 60), ("False", 1), ("false", 1), ("0", 1), ("1", 60)])
def test_a_control_that_does_not_stick_lasts_one_tick(sticky, ticks, calls):
    car = spawn(calls, "vehicle.tesla.model3", place(calls), ("sticky_control", sticky))
    drive(calls, car, throttle=1.0)
    tick(calls)
    assert car.control.throttle == 1.0
    pulled = calls.episode.speed(car)
    tick(calls, 59)
    assert car.control.throttle == (1.0 if ticks == 60 else 0.0)
    assert (calls.episode.speed(car) > 3 * pulled) == (ticks == 60)


@pytest.mark.parametrize(
    ("control", "kmh", "gear"),
    [
        (VehicleControl(), 0.0, 1),
        (VehicleControl(throttle=1.0), 30.0, 2),
        (VehicleControl(throttle=1.0), 90.0, 5),
        (VehicleControl(reverse=True), 10.0, -1),
        (VehicleControl(manual=True, gear=3), 90.0, 3),
    ],
)
def test_the_gear_is_the_driver_s_or_that_of_the_speed(control, kmh, gear):
    assert choose_gear(control, kmh / 3.6) == gear


def test_a_fresh_vehicle_has_30_kmh_until_it_passes_a_sign(maps, calls):
    """CARLA's rule; a sign counts in its own direction alone."""
    calls.episode.step(DT_S)
    car = spawn(calls, "vehicle.tesla.model3", place(calls))
    tick(calls)
    assert car.limit_kmh == 30.0
    served = calls.episode.served
    road = '<road name="r" length="100" id="900001" junction="-1"><planView>'
    road += '<geometry s="0" x="10" y="20" hdg="0.5" length="100"><line/></geometry></planView><signals>'
    for s, orientation, kmh in ((40, "+", 60), (60, "-", 90)):
        road += f'<signal s="{s}" t="-4" id="{s}" orientation="{orientation}" type="274" value="{kmh}"/>'
    text = served.opendrive.replace("</OpenDRIVE>", f"{road}</signals></road></OpenDRIVE>")
    limits = find_limits(list_signals(replace(served, opendrive=text)))
    spaced = "<!-- whose map -->\n" + text.replace("<OpenDRIVE>", '<OpenDRIVE xmlns="http://code.asam.net/simulation">')
    assert "xmlns" in spaced
    assert (
        find_limits(list_signals(replace(served, opendrive=spaced))).kmh.tolist() == limits.kmh.tolist() == [60.0, 90.0]
    )
    ahead = np.array((np.cos(0.5), np.sin(0.5)))

    def passed(s, turn=0.0):
        pose = np.eye(4)
        pose[:2, 0], pose[:2, 3] = ahead * np.cos(turn), np.array((10.0, 20.0)) + s * ahead
        return limits.find_passed(pose)

    assert [passed(s) for s in (35.0, 41.0, 49.0, 51.0, 61.0)] == [None, 60.0, 60.0, None, None]
    assert [passed(s, np.pi) for s in (65.0, 59.0, 41.0)] == [None, 90.0, None]
    calls.episode.signs = limits
    x, y = (np.array((10.0, 20.0)) + 42 * ahead).tolist()
    invoke(calls, "set_actor_transform", (car.id, [[x, -y, 0.0], [0.0, -28.6, 0.0]]))
    tick(calls)
    assert car.limit_kmh == 60.0
    invoke(calls, "set_actor_transform", (car.id, place(calls)))
    tick(calls, 3)
    assert car.limit_kmh == 60.0  # until the next sign


def obstacles(calls, **told):
    """Return names and distances of what an obstacle sensor ahead of the first spawn point reports in one tick."""
    from msgpack import unpackb

    here = place(calls)
    attributes = [(name, str(value)) for name, value in {"distance": 30, **told}.items()]
    sensor = spawn(calls, "sensor.other.obstacle", [[*here[0][:2], here[0][2] + 0.7], here[1]], *attributes)
    tick(calls)
    sent = [unpackb(each.body, strict_map_key=False) for each in calls.episode.measure(DT_S, lambda _: True)]
    invoke(calls, "destroy_actor", (sensor.id,))
    return [(other[2][1], distance) for _, other, distance in sent]


def test_obstacles_that_only_move_are_seen_and_nothing_else(calls):
    here = place(calls)
    yaw = np.radians(here[1][1])
    ahead = np.array((np.cos(yaw), np.sin(yaw), 0.0))
    spawn(calls, "static.prop.container", [(np.array(here[0]) + 8 * ahead).tolist(), here[1]])
    assert obstacles(calls)[0][0] == "static.prop.container"
    assert obstacles(calls, only_dynamics="True") == []
    car = spawn(calls, "vehicle.tesla.model3", [(np.array(here[0]) + 20 * ahead).tolist(), here[1]])
    radius = 0.5
    ((name, distance),) = obstacles(calls, only_dynamics="true", hit_radius=radius)
    assert (name, distance) == (car.description.id, pytest.approx(20.0 - car.size[0] / 2 - radius, abs=0.02))
    assert obstacles(calls, only_dynamics="1", distance=15) == []
    invoke(calls, "set_actor_transform", (car.id, [(np.array(here[0]) - 20 * ahead).tolist(), here[1]]))
    assert obstacles(calls, only_dynamics="True") == []  # behind


def test_parked_cars_do_not_move(calls):
    """No sensor that is for what moves reports something in a town where nothing does."""
    trace = calls.episode.world.snapshot.trace
    row = next(row for row, name in enumerate(trace.actor.tolist()) if name.startswith("parked"))
    x, y, z = (trace.position[0, row] * (1, -1, 1)).tolist()
    for wanted, reported in (("False", True), ("True", False)):
        attributes = (("only_dynamics", wanted), ("distance", "20"))
        sensor = spawn(calls, "sensor.other.obstacle", [[x - 8.0, y, z + 0.7], [0.0, 0.0, 0.0]], *attributes)
        tick(calls)
        assert bool(list(calls.episode.measure(DT_S, lambda _: True))) == reported
        invoke(calls, "destroy_actor", (sensor.id,))


def test_half_turns_of_a_still_lidar_are_alike(calls):
    """56,000 points a second are 87.5 columns a tick for 32 channels: always as many, in spite of rounded times."""
    here = place(calls)
    still = {"dropoff_general_rate": 0, "dropoff_intensity_limit": 1, "dropoff_zero_intensity": 0}
    told = still | {"rotation_frequency": 10, "lower_fov": -80, "upper_fov": -10}
    attributes = [(name, str(value)) for name, value in told.items()]
    spawn(calls, "sensor.lidar.ray_cast", [[*here[0][:2], here[0][2] + 2.0], here[1]], *attributes)
    sweeps = []
    for _ in range(24):
        tick(calls)
        sweeps += [each.body() for each in calls.episode.measure(DT_S, lambda _: True)]
    assert len({sweep[8 + 4 * 32 :] for sweep in sweeps[::2]}) == 1
    assert len({sweep[8 + 4 * 32 :] for sweep in sweeps[1::2]}) == 1


def test_a_car_leans_on_its_springs(calls):
    """CARLA's pitch is positive upwards, its roll to the right."""
    car = spawn(calls, "vehicle.tesla.model3", place(calls))
    tick(calls)
    assert car.transform.rotation[::2] == (0.0, 0.0)
    drive(calls, car, throttle=1.0)
    tick(calls, 60)
    assert 0.2 < car.transform.rotation[0] < 3.0
    drive(calls, car, throttle=1.0, steer=0.1)
    tick(calls, 10)
    assert -5.0 < car.transform.rotation[2] < -0.2  # to the left in a curve to the right
    drive(calls, car, brake=1.0)
    tick(calls, 3)
    assert -3.0 < car.transform.rotation[0] < -0.5
    tick(calls, 100)
    assert car.transform.rotation[::2] == pytest.approx((0.0, 0.0), abs=1e-3)


@pytest.mark.parametrize("velocity", [(0.0, 0.0, -10.0), (0.0, 0.0, 0.5), (3.0, 0.0, -5.0)])
def test_a_push_into_the_ground_is_no_acceleration(velocity, calls):
    car = spawn(calls, "vehicle.tesla.model3", place(calls))
    tick(calls)
    invoke(calls, "set_actor_target_velocity", (car.id, [*velocity]))
    tick(calls)
    assert abs(car.motion[2][2]) < 1e-6


def test_a_car_that_is_thrown_up_comes_down(calls):
    car = spawn(calls, "vehicle.tesla.model3", place(calls))
    tick(calls)
    invoke(calls, "set_actor_target_velocity", (car.id, [0.0, 0.0, 9.81]))
    heights = []
    for _ in range(45):
        tick(calls)
        heights.append(car.pose[2, 3])
    assert max(heights) == pytest.approx(9.81 / 2, rel=0.1)  # v^2 / 2g
    assert heights.index(max(heights)) * DT_S == pytest.approx(1.0, abs=0.1)
    assert heights[-1] == 0.0


def test_spawn_points_are_as_many_as_carla_has_and_follow_the_road(maps, monkeypatch):
    for town, most_deg in (("suburb", 0.0), ("hilly_ring", 10.0)):
        served = maps.load(town)
        points = served.list_spawn_points(list_obstacles(served.town).boxes)
        rotations = np.array([point.rotation for point in points])
        assert (np.abs(rotations[:, 0]).max() > 0.5) == (most_deg > 0)
        for point in points[::10]:
            ahead = np.array((np.cos(np.radians(point.rotation[1])), np.sin(np.radians(point.rotation[1]))))
            here = np.array(point.location[:2])
            rise = served.town.ground(*((here + ahead) * (1, -1))) - served.town.ground(*((here - ahead) * (1, -1)))
            assert point.rotation[0] == pytest.approx(np.degrees(np.arctan2(rise, 2.0)), abs=1.0)  # upwards is positive
    served = maps.load("suburb")
    standing = list_obstacles(served.town).boxes
    usual = len(served.list_spawn_points(standing))
    for wanted in (usual - 7, usual + 9):
        monkeypatch.setitem(SPAWN_POINTS, "suburb", wanted)
        points = served.list_spawn_points(standing)
        assert len(points) == wanted
        places = np.array([point.location for point in points])
        assert len(np.unique(places.round(2), axis=0)) == wanted


@pytest.mark.slow
@pytest.mark.parametrize("town", ["suburb", "ring", "grid"])
def test_the_longest_and_the_widest_vehicle_fit_at_all_spawn_points_at_once(town, maps):
    """Beside posts, buildings and the parked cars of a seed, which leave no room at some places."""
    calls = Calls(maps, town, seed=0, traffic=0, port=2000)
    sizes = {name: each.size for name, each in list_blueprints().items() if name.startswith("vehicle.")}
    longest, widest = (max(sizes, key=lambda name: sizes[name][side:]) for side in (0, 1))
    for name in (longest, widest):
        for location, rotation in calls.episode.spawn_points:
            spawn(calls, name, [list(location), list(rotation)])
        spawned = [actor for actor in calls.episode.actors.values() if actor.kind == "vehicle"]
        assert len(spawned) == len(calls.episode.spawn_points) > 50
        for actor in spawned:
            calls.episode.destroy(actor)
    calls.episode.close()


TWO_STREETS = '<OpenDRIVE><header revMajor="1" revMinor="4"/>{}{}</OpenDRIVE>'
STREET = """<road id="{}" length="120" junction="-1"><planView><geometry s="0" x="0" y="{}" hdg="0" length="120">
<line/></geometry></planView><lanes><laneSection s="0"><center><lane id="0"/></center><right>
<lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes></road>"""


def test_streets_that_lead_to_no_other_are_built(maps):
    """All that the client has in its map is a street of the town, with spawn points."""
    carla = pytest.importorskip("carla", reason="needs the extra 'carla'")
    pytest.importorskip("sumo", reason="needs the extra 'towns'")
    maps.receive(TWO_STREETS.format(STREET.format(1, 0), STREET.format(2, 300)))
    calls = Calls(maps, OPENDRIVE_MAP, seed=0, traffic=0, port=2000)
    assert {round(point.location[1] / 300) for point in calls.episode.spawn_points} == {0, -1}
    lanes = [LineString(lane.shape) for edge in calls.episode.served.net.streets for lane in edge.lanes]
    waypoints = carla.Map("two", calls.get_map_data()).generate_waypoints(10.0)
    assert len(waypoints) > 20
    for waypoint in waypoints:
        at = waypoint.transform.location
        pose = calls.episode.served.frame.from_transform((at.x, at.y, at.z), (0.0, 0.0, 0.0))
        assert min(lane.distance(Point(pose[:2, 3])) for lane in lanes) < 0.2
    calls.episode.close()


def test_tags_alone_are_those_of_the_colour_image(calls):
    here = place(calls)
    above = [[*here[0][:2], here[0][2] + 2.4], here[1]]
    size = (("image_size_x", "320"), ("image_size_y", "240"))
    camera = spawn(calls, "sensor.camera.semantic_segmentation", above, *size).sensor
    sight = calls.episode.look("images")()
    tags, instance = sight.label(camera)
    picture = sight.photograph(camera)
    assert (tags == SEMANTICS["road_line"]).sum() > 20
    np.testing.assert_array_equal(tags, picture.semantic)
    np.testing.assert_array_equal(instance, picture.instance)


def test_an_imported_map_is_kept_for_the_next_server(maps, tmp_path, monkeypatch):
    """Another map of the same name is imported anew, a damaged copy is not used, and a cache is not needed."""
    town = maps.load("suburb").town
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file = tmp_path / "maps" / "crossing.xodr"
    file.parent.mkdir()
    imported, loaded = [], []

    def import_town(path, out):
        out.mkdir()
        imported.append(path.read_text())
        if imported == ["a"]:
            start("a")  # another server, which begins later and is done first
        (out / "town.yaml").write_text("whole")
        return ImportedTown(town, ())

    def load_town(folder):
        if (folder / "town.yaml").read_text() != "whole":
            raise InputError("damaged")
        loaded.append(folder)
        return town

    monkeypatch.setattr(carla_maps, "import_town", import_town)
    monkeypatch.setattr(carla_maps, "load_town", load_town)

    def start(text):
        file.write_text(text)
        assert Maps(file.parent).load("crossing").town is town

    start("a")
    start("a")
    assert (imported, len(loaded)) == (["a", "a"], 1)
    imported.pop()
    (loaded[0] / "town.yaml").write_text("half")
    start("a")
    start("b")
    assert (imported, len(loaded)) == (["a", "a", "b"], 1)
    start("b")
    assert (imported, len(loaded)) == (["a", "a", "b"], 2)
    assert {folder.name for folder in loaded} == {"crossing"}  # houses are drawn by the town's name
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))  # which is no folder
    start("b")
    assert imported == ["a", "a", "b", "b"]


def test_the_mesh_of_an_imported_map_is_kept_for_the_next_server(maps, tmp_path, monkeypatch):
    """A damaged one is not used, and is written anew."""
    town, built = maps.load("suburb").town, []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(carla_maps, "import_town", lambda path, out: out.mkdir() or ImportedTown(town, ()))
    monkeypatch.setattr(carla_maps, "load_town", lambda folder: town)
    monkeypatch.setattr(static, "_build_world", lambda town, build=static._build_world: built.append(1) or build(town))
    (tmp_path / "crossing.xodr").write_text("a")

    def start():
        monkeypatch.setattr(static, "_WORLDS", static.TownCache())
        served = Maps(tmp_path).load("crossing")
        world = static.build_static_world(town)
        served.keep()
        return world

    first, second = start(), start()
    assert len(built) == 1
    for one, other in zip((*astuple(first.mesh), *first[1:]), (*astuple(second.mesh), *second[1:])):
        np.testing.assert_array_equal(one, other, strict=True)
    (file,) = (tmp_path / "cache").rglob("mesh.npz")
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", whole[:5000] + b"\0" * 99 + whole[5099:]):
        file.write_bytes(damaged)
        start()
        start()
    assert len(built) == 4


def test_low_quality_is_told_and_draws_smaller_pictures_of_the_same_street(maps, calls):
    low = Calls(maps, "suburb", seed=3, traffic=0, port=2000, quality=Quality.LOW)
    try:
        blueprints = {each.id: each.attributes for each in invoke(low, "get_actor_definitions", ())}
        told = {name: [each for each in known if each.id == "quality"] for name, known in blueprints.items()}
        assert {name for name, known in told.items() if known} == {"sensor.camera.rgb"}
        assert [(each.value, set(each.recommended)) for each in told["sensor.camera.rgb"]] == [("low", {"low", "high"})]
        here, size = place(calls), (("image_size_x", "321"), ("image_size_y", "203"))
        above, pictures, drawn = [[*here[0][:2], here[0][2] + 2.4], here[1]], [], []
        for served, quality in ((calls, []), (low, []), (low, [("quality", "high")])):
            camera = spawn(served, "sensor.camera.rgb", above, *size, *quality).sensor
            assert camera is not None
            sight = served.episode.look("images")()
            body = np.frombuffer(sense_rgb(sight, camera), np.uint8, offset=12).reshape(203, 321, 4)
            pictures.append(body[..., :3].astype(float))
            drawn.append(sight.photograph(camera).rgb.shape[:2])
            assert sight.label(camera)[0].shape == (203, 321)
        assert drawn == [(203, 321), (102, 161), (203, 321)]
        np.testing.assert_array_equal(pictures[0], pictures[2])
        smooth = [
            np.asarray(Image.fromarray(each.astype(np.uint8)).resize((40, 25), Image.Resampling.BOX), float)
            for each in pictures
        ]
        assert 0 < np.abs(smooth[0] - smooth[1]).mean() < 3.0
        assert smooth[0].std() > 20.0
        with pytest.raises(CallRefused, match="'quality' = 'medium' is not high or low"):
            check_description(
                wire.Description(0, "sensor.camera.rgb", (wire.Attribute("quality", 2, "medium"),)), Quality.LOW
            )
        assert not {
            each.id for each in check_description(wire.Description(0, "sensor.camera.rgb", ()))[1].attributes
        } & {"quality"}
    finally:
        low.episode.close()


SIGNALS = """<signals><signal id="7" s="60" t="-4" orientation="+" type="206" subtype="-1" value="-1" dynamic="no"/>
<signal id="8" s="30" t="-4" orientation="+" type="274" subtype="50" value="50" unit="km/h" country="DE" dynamic="no"/>
</signals></road>"""


def test_signs_of_a_map_are_actors_that_count_on_their_lane(maps):
    pytest.importorskip("sumo", reason="needs the extra 'towns'")
    maps.receive(f"<OpenDRIVE>{STREET.format(1, 0)}</OpenDRIVE>".replace("</road>", SIGNALS))
    calls = Calls(maps, OPENDRIVE_MAP, seed=0, traffic=0, port=2000)
    signs = {actor.sign: actor for actor in calls.episode.actors.values() if actor.kind == "traffic"}
    assert {number: sign.description.id for number, sign in signs.items()} == {
        "7": "traffic.stop",
        "8": "traffic.speed_limit.50",
    }
    for number, along in (("7", 60.0), ("8", 30.0)):
        sign = signs[number]
        x, y, _ = calls.episode.served.frame.to_location(sign.pose[:3, 3])
        assert (x, y) == pytest.approx((along, 4.0), abs=1e-3)  # to the right, y of CARLA
        middle = sign.pose @ np.append(mirror(np.array(sign.bounding_box().location)), 1.0)
        x, y, _ = calls.episode.served.frame.to_location(middle[:3])
        assert (x, y) == pytest.approx((along - 3.0, 1.75), abs=0.1)
        with pytest.raises(CallRefused, match="cannot be destroyed"):
            invoke(calls, "destroy_actor", (sign.id,))
    still = b"\x00" * 36  # motion of an actor at rest, before what is particular to it: the sign's id
    assert calls.episode.describe_world(0.05).count(still + b"7\x00") == 1
    calls.episode.close()

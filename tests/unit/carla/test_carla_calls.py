"""Calls without a network: what is refused, in which words, and the same images from the same seed."""

from collections.abc import Callable

import numpy as np
import pytest
from carla_calls import describe, invoke, place

from flcav.carla.server import wire
from flcav.carla.server.blueprints import NOT_SERVED, SENSORS, CallRefused, check_description, list_blueprints
from flcav.carla.server.calls import Calls
from flcav.carla.server.episode import Measurement
from flcav.carla.server.sensors import KINDS, SensorClock
from flcav.carla.server.weather import to_weather
from flcav.config import InputError
from flcav.world.shapes import SHAPES

CAMERA = (("image_size_x", "64"), ("image_size_y", "48"))


def test_all_blueprints_of_sensors_are_served_or_refused_by_name(calls):
    for name in (*SENSORS, *NOT_SERVED):
        spawn = (describe(name), [[0.0, 0.0, 10.0], [0.0, 0.0, 0.0]])
        if name in KINDS:
            assert invoke(calls, "spawn_actor", spawn).token
        else:
            with pytest.raises(CallRefused, match=f"{name} is not served"):
                invoke(calls, "spawn_actor", spawn)


@pytest.mark.parametrize("kind", ["walker.pedestrian.0001", "vehicle.audi.tt", "static.prop.barrel"])
@pytest.mark.parametrize("height", [-500.0, -50.0, 50.0, 100.0])
def test_far_above_and_below_an_actor_there_is_room(height, kind, calls):
    here = place(calls)
    invoke(calls, "spawn_actor", (describe("vehicle.tesla.model3"), here))
    with pytest.raises(CallRefused, match="because of collision"):
        invoke(calls, "spawn_actor", (describe(kind), here))
    here[0][2] += height
    number = invoke(calls, "spawn_actor", (describe(kind), here)).id
    assert calls.episode.find(number).transform.location[2] == pytest.approx(here[0][2], abs=1e-6)
    for _ in range(2):
        calls.episode.step(0.05)
    fallen = here[0][2] - calls.episode.find(number).transform.location[2]
    assert fallen == pytest.approx(0.0 if height < 0 else 9.81 * 0.1**2 / 2, abs=0.03)


def test_blueprints_that_scripts_ask_for_by_name(calls):
    """Those of CARLA 0.9.16's documentation; what one does not do is refused when it is used."""
    props = (
        "dirtdebris01 dirtdebris02 dirtdebris03 mesh gnome table trashbag streetsign atm haybale foodcart calibrator"
    )
    known = list_blueprints()
    for name in (*(f"static.prop.{prop}" for prop in props.split()), "walker.pedestrian.0052", "util.actor.empty"):
        here = [[0.0, 0.0, 30.0], [0.0, 0.0, 0.0]]
        if name == "static.prop.mesh":
            with pytest.raises(CallRefused, match=r"static\.prop\.mesh is not served here$"):
                invoke(calls, "spawn_actor", (describe(name), here))
        else:
            invoke(calls, "destroy_actor", (invoke(calls, "spawn_actor", (describe(name), here)).id,))
    for name in ("sensor.other.v2x", "sensor.other.v2x_custom"):
        assert {"path_loss_model", "scenario", "transmit_power"} <= {
            each.id for each in known[name].definition.attributes
        }
    assert {"gen_cam_min", "noise_head_bias"} <= known["sensor.other.v2x"].fields.keys()


@pytest.mark.parametrize(("friction", "share"), [("0.05", 0.05), ("0.0", 0.0), ("3.5", None)])
def test_tyres_hold_by_the_friction_of_the_box_that_they_are_in(friction, share, calls):
    car = invoke(calls, "spawn_actor", (describe("vehicle.tesla.model3"), place(calls))).id
    calls.episode.step(0.05)
    here = [list(part) for part in calls.episode.find(car).transform]
    extents = [(f"extent_{axis}", "5000") for axis in "xyz"]  # 50 m to all sides
    box = invoke(calls, "spawn_actor", (describe("static.trigger.friction", ("friction", friction), *extents), here)).id
    ahead = np.array(calls.episode.find(car).pose[:3, 0]) * (1, -1, 1)  # CARLA's y points the other way
    invoke(calls, "set_actor_target_velocity", (car, (15.0 * ahead).tolist()))
    brake = [0.0, 0.0, 1.0, False, False, False, 0]
    invoke(calls, "apply_control_to_vehicle", (car, brake))
    for _ in range(10):
        calls.episode.step(0.05)
    lost = 15.0 - np.linalg.norm(calls.episode.find(car).motion[0])
    assert lost == pytest.approx(0.5 * (8.0 if share is None else share * 0.9 * 9.81), abs=0.2)
    invoke(calls, "destroy_actor", (box,))
    before = np.linalg.norm(calls.episode.find(car).motion[0])
    for _ in range(10):
        calls.episode.step(0.05)
    assert before - np.linalg.norm(calls.episode.find(car).motion[0]) == pytest.approx(0.5 * 8.0, abs=0.2)


def test_bodies_of_blueprints_are_shapes_of_the_town():
    for blueprint in list_blueprints().values():
        if blueprint.category in SHAPES:
            assert 0 <= blueprint.shape < len(SHAPES[blueprint.category])
            assert min(blueprint.size) > 0.3
        elif not blueprint.category:
            assert blueprint.size == (0.0, 0.0, 0.0)


def test_two_wheelers_are_as_wide_as_their_riders():
    widths = [each.size[1] for each in list_blueprints().values() if each.category in ("bicycle", "motorcycle")]
    assert min(widths) > 0.5


@pytest.mark.parametrize(
    ("name", "attribute", "told"),
    [
        ("sensor.camera.rgb", ("image_size_x", "0"), "'image_size_x' = 0 is not within 16 and 4096"),
        ("sensor.camera.rgb", ("fov", "180"), "'fov' = 180 is not within"),
        ("sensor.camera.rgb", ("fov", "wide"), "'fov' = 'wide' is no number"),
        ("sensor.lidar.ray_cast", ("channels", "1e3"), "'channels' = 1e3 is not within 1 and 512"),
        ("sensor.lidar.ray_cast", ("range", "nan"), "'range' = nan is not within"),
        ("sensor.other.obstacle", ("only_dynamics", "maybe"), "neither true nor false"),
        ("vehicle.audi.tt", ("color", "red"), "'color' = 'red' is no colour, such as 255,0,0"),
        ("vehicle.audi.tt", ("color", "0,0,256"), "is no colour"),
    ],
)
def test_attributes_out_of_range_are_refused(name, attribute, told):
    with pytest.raises(CallRefused, match=told):
        check_description(wire.read(wire.Description, describe(name, attribute)))


def test_unknown_blueprints_are_refused_with_a_suggestion():
    with pytest.raises(CallRefused, match=r"did you mean 'vehicle\.tesla\.model3'"):
        check_description(wire.Description(1, "vehicle.tesla.modl3", ()))


@pytest.mark.parametrize(
    ("method", "arguments", "told"),
    [
        ("fly", (), "'fly' is not served here"),
        ("__init__", (), "is not served here"),
        ("dt_s", (), "is not served here"),
        ("destroy_actor", (99,), "actor 99 not found"),
        ("destroy_actor", (1,), "spectator of the town"),
        ("apply_control_to_vehicle", (1, [0.0, 0.0, 0.0, False, False, False, 0]), "actor 1 is no vehicle"),
        ("set_traffic_light_state", (1, 2), "actor 1 is no traffic light"),
        ("load_new_episode", ("atlantis", True, 0), "no map 'atlantis'; maps here: suburb"),
        ("load_new_episode", ("../../etc", True, 0), "no map 'etc'"),
        ("copy_opendrive_to_file", ("<x/>", []), "cannot be driven"),
        ("set_episode_settings", ([False, False, [True, 19.0], True, 0.01, 10, 0.0, True, 1.0, 1.0, True],), "within"),
    ],
)
def test_refusals(calls, method, arguments, told):
    with pytest.raises((CallRefused, InputError), match=told):
        invoke(calls, method, arguments)


@pytest.mark.parametrize("dt_s", [0.001, 0.05, 10.0])
def test_steps_of_time_within_the_limits_are_taken(dt_s, calls):
    invoke(calls, "set_episode_settings", (wire.EpisodeSettings(fixed_dt_s=dt_s).packed(),))
    assert wire.read(wire.EpisodeSettings, invoke(calls, "get_episode_settings", ())).fixed_dt_s == dt_s


def test_wrong_arguments_name_the_version_that_is_served(calls):
    with pytest.raises(wire.WireError, match=r"destroy_actor: 2 arguments where 1 belong; clients of CARLA 0\.9\.16"):
        invoke(calls, "destroy_actor", (1, 2))
    with pytest.raises(wire.WireError, match=r"0\.9\.16"):
        invoke(calls, "set_episode_settings", ([False, False, [False]],))


def test_a_batch_answers_every_command(calls):
    car = describe("vehicle.audi.tt")
    spawn = [[0, [car, place(calls), [False], 0, "", []]]]
    control = [[2, [0, [1.0, 0.0, 0.0, False, False, False, 0]]]]
    spawned, again, unknown, nothing = invoke(
        calls, "apply_batch", ([[[0, [*spawn[0][1][:5], [control]]]], spawn, [[1, [999]]], [[77, [1]]]], False)
    )
    number = spawned[0][1]
    assert calls.episode.actors[number].control.throttle == 1.0
    assert again == wire.fail("Spawn failed because of collision at spawn position")
    assert unknown == wire.fail("actor 999 not found")
    assert nothing[0][0] == 0


def test_a_car_drives_and_is_where_it_was_put(calls):
    put = place(calls)
    car = invoke(calls, "spawn_actor", (describe("vehicle.tesla.model3"), put))
    calls.episode.step(0.05)
    at = calls.episode.actors[car.id].transform
    assert np.allclose(at.location[:2], put[0][:2], atol=1e-6)
    assert np.allclose(at.rotation, put[1], atol=1e-6)
    invoke(calls, "apply_control_to_vehicle", (car.id, [1.0, 0.0, 0.0, False, False, False, 0]))
    for _ in range(40):
        calls.episode.step(0.05)
    assert calls.episode.speed(calls.episode.actors[car.id]) > 3.0


def look(maps, seed, *, later=False):
    """Return what all sensors on a moving car send in three ticks; `later`: with images drawn after the last."""
    calls = Calls(maps, "suburb", seed=seed, traffic=0, port=2000)
    car = invoke(calls, "spawn_actor", (describe("vehicle.tesla.model3"), place(calls)))
    noisy = (("noise_lat_stddev", "1e-6"), ("noise_accel_stddev_x", "0.1"))
    for name in KINDS:
        told = describe(name, *CAMERA, *noisy)
        invoke(calls, "spawn_actor_with_parent", (told, [[0.0, 0.0, 2.4], [0.0, 0.0, 0.0]], car.id, 0))
    invoke(calls, "set_actor_target_velocity", (car.id, [10.0, 0.0, 0.0]))
    measured: list[tuple[Measurement, bytes | Callable[[], bytes]]] = []
    for _ in range(3):
        calls.episode.step(0.05)
        for each in calls.episode.measure(0.05, lambda stream: True):
            body = each.body
            measured.append((each, body if isinstance(body, bytes) or (each.late and later) else body()))
    sent = [(each.stream, each.header, body if isinstance(body, bytes) else body()) for each, body in measured]
    calls.episode.close()
    return sent


def test_the_same_seed_gives_the_same_bytes_and_another_one_others(maps):
    first, second, other = (look(maps, seed) for seed in (1, 1, 2))
    assert len(first) == 3 * 9
    assert first == second
    assert first != other


def test_an_image_that_is_drawn_after_further_ticks_is_that_of_its_tick(maps):
    at_once = look(maps, 1)
    images = [body for stream, _, body in at_once if stream == at_once[0][0]]
    assert len(set(images)) == 3
    assert look(maps, 1, later=True) == at_once


@pytest.mark.parametrize(("tick_s", "due"), [(0.0, [1, 2, 3, 4, 5, 6]), (0.1, [1, 3, 5]), (0.15, [1, 4])])
def test_sensors_are_due_every_sensor_tick(tick_s, due):
    clock = SensorClock(tick_s)
    taken = {tick: clock.take(tick * 0.05, 0.05) for tick in range(1, 7)}
    assert [tick for tick, elapsed in taken.items() if elapsed is not None] == due
    assert taken[due[-1]] == pytest.approx(max(tick_s, 0.05))


def test_impulses_and_velocities_of_one_tick_add_up(calls):
    """As where a reset stops a car and then its turning, or two bodies push it."""
    car = invoke(calls, "spawn_actor", (describe("vehicle.tesla.model3"), place(calls))).id
    actor = calls.episode.actors[car]
    invoke(calls, "set_actor_target_velocity", (car, [9.0, 3.0, 0.0]))
    calls.episode.step(0.05)
    invoke(calls, "set_actor_target_velocity", (car, [0.0, 0.0, 0.0]))
    invoke(calls, "set_actor_target_angular_velocity", (car, [0.0, 0.0, 0.0]))
    assert calls.episode.motion(actor)[0].tolist() == [0.0, 0.0, 0.0]
    mass = calls.episode.world.bodies.find(actor.name).blueprint.mass_kg
    for _ in range(2):
        invoke(calls, "add_actor_impulse", (car, [3.0 * mass, 0.0, 0.0]))
    assert calls.episode.motion(actor)[0].tolist() == pytest.approx([6.0, 0.0, 0.0])


def test_the_town_s_traffic_is_driven_and_destroyed_as_any_other(maps):
    """It goes on from where it is; who reads of it leaves it to the town."""
    calls = Calls(maps, "grid", seed=3, traffic=6, port=2000)
    try:
        for _ in range(40):
            calls.episode.step(0.05)
        first, second, *others = (each for each in calls.episode.actors.values() if each.kind == "vehicle")
        for read in ("get_physics_control", "get_telemetry_data", "get_vehicle_light_state"):
            invoke(calls, read, (second.id,))
        assert invoke(calls, "get_wheel_steer_angle", (second.id, 0)) == 0
        assert not calls.episode.is_own(second)
        before = first.pose[:3, 3].copy()
        batch = [
            [[wire.COMMANDS.index("apply_control_to_vehicle"), [first.id, [0.0, 0.0, 1.0, False, False, False, 0]]]]
        ]
        assert invoke(calls, "apply_batch", (batch, False)) == [wire.succeed(first.id)]
        assert calls.episode.is_own(first)
        np.testing.assert_allclose(first.pose[:3, 3], before)
        for _ in range(100):
            calls.episode.step(0.05)
        assert calls.episode.actors[first.id] is first
        assert calls.episode.speed(first) == pytest.approx(0.0, abs=0.01)
        for each in (first, second, *others):
            assert invoke(calls, "destroy_actor", (each.id,)) is True
        calls.episode.step(0.05)
        assert not [each for each in calls.episode.actors.values() if each.kind == "vehicle"]
        assert invoke(calls, "get_actor_bounding_box", (second.id,)).extent == (0.0, 0.0, 0.0)
    finally:
        calls.episode.close()


def test_a_walker_whose_ai_is_stopped_stands_and_obeys_its_control(calls):
    walker = invoke(calls, "spawn_actor", (describe("walker.pedestrian.0001"), place(calls))).id
    actor = calls.episode.actors[walker]
    invoke(calls, "set_actor_simulate_physics", (walker, False))
    for _ in range(5):
        invoke(calls, "set_walker_state", (walker, place(calls), 1.4))  # above the ground, as its mesh may be on hills
        calls.episode.step(0.05)
        assert actor.pose[2, 3] - actor.lift == pytest.approx(calls.episode.world.height(*actor.pose[:2, 3]))
        assert np.linalg.norm(actor.motion[0]) == pytest.approx(1.4)
    for _ in range(20):
        calls.episode.step(0.05)
    assert np.linalg.norm(actor.motion[0]) == 0
    begun = actor.pose[:2, 3].copy()
    invoke(calls, "apply_control_to_walker", (walker, [[0.0, 1.0, 0.0], 1.4, False]))
    for _ in range(20):
        calls.episode.step(0.05)
    assert np.linalg.norm(actor.pose[:2, 3] - begun) > 1


def test_cars_have_the_colour_that_they_are_spawned_with(calls):
    shares = {}
    for colour in ("255,0,0", "0,0,255"):
        car = invoke(calls, "spawn_actor", (describe("vehicle.tesla.model3", ("color", colour)), place(calls))).id
        mount = [[-6.0, 0.0, 2.5], [-12.0, 0.0, 0.0]]
        camera = invoke(
            calls, "spawn_actor_with_parent", (describe("sensor.camera.rgb", *CAMERA), mount, car, 0, "")
        ).id
        calls.episode.step(0.05)
        sensor = calls.episode.actors[camera].sensor
        seen = calls.episode.look("images")().photograph(sensor).rgb[28:, 16:48].astype(float).mean((0, 1))
        shares[colour] = seen / seen.sum()
        invoke(calls, "destroy_actor", (camera,))
        invoke(calls, "destroy_actor", (car,))
    assert shares["255,0,0"][0] > 1.2 * shares["0,0,255"][0]
    assert shares["0,0,255"][2] > 1.2 * shares["255,0,0"][2]


def test_rays_that_meet_nothing_are_answered_as_clients_read_them(calls):
    (x, y, z), _ = calls.episode.spawn_points[0]
    assert invoke(calls, "project_point", ([x, y, z], [0.0, 0.0, 1.0], 5.0)) == [False, [(0.0, 0.0, 0.0), 0]]
    hit, (_, tag) = invoke(calls, "project_point", ([x, y, z], [0.0, 0.0, -1.0], 5.0))
    assert (hit, tag) == (True, 1)


def test_weather_is_clear_at_zero_and_thick_at_a_hundred():
    clear = to_weather(wire.WeatherParameters(sun_altitude_angle=45.0))
    thick = to_weather(wire.WeatherParameters(100.0, 100.0, fog_density=100.0, wetness=100.0))
    assert (clear.rain_mm_h, clear.cloud_cover, clear.fog_per_m) == (0.0, 0.0, 0.0)
    assert thick.rain_mm_h > 50
    assert thick.visibility_m < 60
    assert to_weather(wire.WeatherParameters(-5.0, 1e6, fog_density=1e6)).visibility_m == 5.0

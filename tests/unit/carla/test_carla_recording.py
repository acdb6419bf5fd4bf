"""Parts of recordings from CARLA: recipes, attributes, data, occlusion; what a lost sensor is called."""

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.geometry import Boxes, inverse, pose, segments_meet_boxes, transform_points, unit_vectors
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens, compute_pixel_rays
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern
from flcav.sources.recipe import CarlaRecipe, Recipe, parse_recipe

pytest.importorskip("carla")
from flcav.carla.recording.labels import CameraSight, LabelledSweep, annotate_bodies, enter_box
from flcav.carla.recording.sensors import Feed, SemanticSweep, read_depths, read_lidar_points
from flcav.carla.recording.session import Session, _check_version, check_installed
from flcav.carla.recording.source import CarlaSource
from flcav.carla.recording.traffic import State, TrackedBody
from flcav.carla.server.weather import make_weather, to_weather
from flcav.carla.server.wire import WeatherParameters
from flcav.world.weather import WEATHERS

BASE: dict[str, Any] = {"town": "grid", "source": "carla"}
CAMERA: dict[str, Any] = {"cameras": {"eye": {"mount": {"z": 1.5}}}}
BAD: dict[str, tuple[dict[str, Any], str]] = {
    "another source": ({"source": "gazebo"}, "field 'source' = 'gazebo'"),
    "corner cases": ({"rare": {"angled": 0.5}}, "'rare' is of the built-in simulator"),
    "a radar": ({"vehicle_rig": "car"}, "'radar' is a radar with cross-sections, and CARLA has none"),
    "a thermal camera": ({"vehicle_rig": {"infrareds": {"warm": {}}}}, "'warm' is a thermal camera"),
    "uneven beams": ({"vehicle_rig": "kitti_lidar"}, "'velodyne' has uneven channels"),
    "a rolling spin": (
        {"vehicle_rig": {"lidars": {"top": {"settings": {"rolling": True}}}}}, "'top' has a rolling spin"
    ),
    "a distortion": (
        {"pole_rig": {"cameras": {"eye": {"settings": {"k1": -0.1}}}}}, "pole_rig: 'eye' has distortion"
    ),
    "a trigger": ({"vehicle_rig": {"cameras": {"eye": {"trigger_ms": 5}}}}, "'eye' has a trigger time"),
    "a port": ({"port": 70000}, "field 'port' = 70000"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_carla_has_not_is_one_sentence(name: str) -> None:
    fields, told = BAD[name]
    with pytest.raises(InputError) as error:
        parse_recipe(BASE | fields, "r.yaml")
    assert str(error.value).startswith("r.yaml: ")
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def test_a_recipe_without_a_source_is_of_the_built_in_simulator() -> None:
    assert type(parse_recipe({"town": "grid"}, "r.yaml")) is Recipe
    assert type(parse_recipe(BASE, "r.yaml")) is CarlaRecipe


def test_where_the_server_is_does_not_belong_to_the_dataset() -> None:
    one, other = (
        CarlaSource(CarlaRecipe.model_validate({**BASE, "port": port, "timeout_s": port})).describe()
        for port in (2000, 3000)
    )
    assert one == other
    assert {"host", "port", "traffic_port", "timeout_s"}.isdisjoint(one)
    assert (one["town"], one["map"], one["labels"]) == ("grid", "grid", ["objects"])


def test_a_map_that_is_no_town_has_no_poles() -> None:
    source = CarlaSource(CarlaRecipe.model_validate({**BASE, "town": "Town05", "scenes": 2}))
    assert source.scenes() == ["Town05-0-000", "Town05-0-001"]
    assert source.describe()["town"] == ""
    with pytest.raises(InputError, match="field 'poles' = 3: no pole of the map Town05, of which no town is known"):
        CarlaSource(CarlaRecipe.model_validate({**BASE, "town": "Town05", "poles": [3]}))


def test_a_missing_client_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "carla", None)
    with pytest.raises(InputError, match=r"needs CARLA's client, which is not installed: .* pip install"):
        check_installed()


@pytest.mark.parametrize("name", WEATHERS)
def test_weather_comes_back_from_our_server_as_it_was(name: str) -> None:
    sent = make_weather(WEATHERS[name])
    back = to_weather(WeatherParameters(*(getattr(sent, field) for field in WeatherParameters._fields)))
    for field, value in WEATHERS[name].model_dump().items():
        assert getattr(back, field) == pytest.approx(value, rel=1e-4, abs=1e-4)


def test_another_version_is_one_sentence() -> None:
    client = cast(Any, SimpleNamespace(get_server_version=lambda: "0.9.13", get_client_version=lambda: "0.9.16"))
    with pytest.raises(InputError, match=r"CARLA at here:1 is version '0.9.13' and the installed client 0.9.16"):
        _check_version(client, "here:1")


class Late:
    """A sensor that delivers the ticks that it is told to."""

    def listen(self, callback: Any) -> None:
        self.deliver = lambda *frames: [callback(SimpleNamespace(frame=frame)) for frame in frames]


def test_a_sensor_that_delivers_late_or_never_is_named() -> None:
    sensor = Late()
    feed = Feed("lidar' of 'cav0", cast(Any, sensor))
    sensor.deliver(1, 2)
    feed.expect(3)
    sensor.deliver(2, 3)
    assert feed.take(3, 0.01).frame == 3
    feed.expect(5)
    sensor.deliver(4)
    with pytest.raises(OSError, match=r"'lidar' of 'cav0' delivered nothing of tick 5 within 0\.01 s; the same"):
        feed.take(5, 0.01)
    sensor.deliver(6)
    with pytest.raises(OSError, match="'lidar' of 'cav0' left out tick 5"):
        feed.take(5, 0.01)


def test_another_client_that_ticks_is_named() -> None:
    def world(ticked: int, at: int, delta: float) -> Any:
        stamp = SimpleNamespace(delta_seconds=delta)
        snapshot = SimpleNamespace(frame=at, timestamp=stamp)
        return SimpleNamespace(tick=lambda seconds: ticked, get_snapshot=lambda: snapshot)

    for state in (world(5, 6, 0.1), world(5, 5, 0.05)):
        with pytest.raises(OSError, match="another client has taken over"):
            Session("here:1", 1.0, cast(Any, None), state, cast(Any, None)).tick()
    assert Session("here:1", 1.0, cast(Any, None), world(5, 5, 0.1), cast(Any, None)).tick().frame == 5


def test_data_are_decoded_as_carla_documents_them() -> None:
    """Depths by the formula of the documentation, points with y to the right."""
    pixels = np.zeros((1, 3, 4), np.uint8)  # blue, green, red, alpha
    pixels[0, 1], pixels[0, 2] = (1, 2, 3, 255), (255, 255, 255, 255)
    image = cast(Any, SimpleNamespace(raw_data=pixels.tobytes(), height=1, width=3))
    depth = read_depths(image)
    assert depth[0, 1] == pytest.approx((3 + 2 * 256 + 1 * 256**2) / (256**3 - 1) * 1000)
    assert np.isinf(depth[0, 2])
    sweep = cast(Any, SimpleNamespace(raw_data=np.array([(1, 2, 3, 0.5)], np.float32).tobytes()))
    np.testing.assert_array_equal(read_lidar_points(sweep), [(1, -2, 3, 0.5)])


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_rays_enter_a_box_where_segments_first_meet_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin, half = rng.uniform(-9, 9, 3), rng.uniform(0.3, 3, 3)
    lines = unit_vectors(rng.uniform(-np.pi, np.pi, 40), rng.uniform(-1.5, 1.5, 40))
    box = Boxes(np.zeros((1, 3)), 2 * half[None], np.zeros(1), np.array(["car"]))
    meets, enters = enter_box(origin, lines, half)
    starts = np.tile(origin, (40, 1))
    assert (segments_meet_boxes(starts, origin + 99 * lines, box)[:, 0] == meets).all()
    outside = meets & (enters > 0.01)
    assert segments_meet_boxes(starts[outside], (origin + (enters[:, None] + 1e-3) * lines)[outside], box).all()
    assert not segments_meet_boxes(starts[outside], (origin + (enters[:, None] - 1e-3) * lines)[outside], box).any()


# ---- occlusion: a car behind a wall that hides a share of it

LIDAR = Lidar(channels=64, azimuth_steps=1800, up_deg=5.0, down_deg=-15.0)
CAR = TrackedBody(7, "veh0", "car", (4.0, 2.0, 1.6), pose(0, 0, 0.8))
PARKED = TrackedBody(0, "parked0", "car", (4.0, 2.0, 1.6), pose(0, 0, 0.8))
HERE = pose(3.0, 1.0, 1.7, 0.4)  # world_from_sensor


def make_state(body: TrackedBody) -> State:
    boxes = Boxes(np.array([[20.0, 0.0, 0.8]]), np.array([body.size]), np.array([1.2]), np.array(["car"]))
    boxes = boxes.transform(HERE @ pose(0, 0, -1.7))
    return State((body,), boxes, np.zeros((1, 3)), np.zeros((1, 3)))


def cast_rays(state: State, lines: NDArray[np.floating], wall_y: float) -> tuple[NDArray, NDArray]:
    """Return distances (inf: none) and what is met: 0 nothing, 1 the wall, 2 the car, whose body is a smaller box.

    The wall is at x = 10 in the sensor's frame, left of `wall_y`.
    """
    body_from_sensor = inverse(state.boxes.pose(0)) @ HERE
    meets, enters = enter_box(body_from_sensor[:3, 3], lines @ body_from_sensor[:3, :3].T, 0.45 * state.boxes.size[0])
    distance = np.where(meets, enters, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = np.where(lines[:, 0] > 0, 10 / lines[:, 0], np.inf)
    before = (wall * lines[:, 1] > wall_y) & (wall < distance)
    return np.where(before, wall, distance), np.where(before, 1, np.where(meets, 2, 0))


@pytest.mark.parametrize("body", [CAR, PARKED], ids=["actor", "parked"])
@pytest.mark.parametrize(("wall_y", "expected"), [(99.0, 0.0), (0.0, 0.5), (-99.0, 1.0)])
def test_occlusion_is_the_share_that_a_wall_hides(body: TrackedBody, wall_y: float, expected: float) -> None:
    state, lines = make_state(body), build_ray_pattern(LIDAR).astype(np.float64)
    distance, met = cast_rays(state, lines, wall_y)
    back = np.isfinite(distance)
    points = (lines[back] * distance[back, None]).astype(np.float32)
    actor = np.where(met[back] == 2, body.number, 0).astype(np.uint32)
    tag = np.where(met[back] == 2, 14, 4).astype(np.uint32)
    sweep = LabelledSweep(
        LIDAR, HERE, np.column_stack((points, np.ones(len(points), np.float32))), SemanticSweep(points, actor, tag)
    )
    eye = Lens(width=640, height=240, fov_deg=60)
    world_from_camera = HERE @ BODY_FROM_OPTICAL
    rays = compute_pixel_rays(eye).astype(np.float64)
    far, what = cast_rays(state, transform_points(BODY_FROM_OPTICAL, rays), wall_y)
    depth = (far * rays[:, 2]).astype(np.float32).reshape(240, 640)
    classes = np.array([11, 4, 14], np.uint8)[what].reshape(240, 640)
    sight = CameraSight(eye, world_from_camera, depth, classes)
    truth, images = annotate_bodies(state, None, np.array([True]), {"top": sweep}, {"eye": sight})
    assert truth.returns[0] == (met == 2).sum()
    assert truth.occlusion[0] == pytest.approx(expected, abs=0.08)
    assert truth.views["eye"].pixels[0] == (what == 2).sum() == (images["eye"] == 1).sum()
    assert truth.views["eye"].occlusion[0] == pytest.approx(expected, abs=0.08)
    assert math.isclose(truth.views["eye"].truncation[0], 0.0)


def test_the_carrier_is_not_annotated() -> None:
    state = make_state(CAR)
    truth, _ = annotate_bodies(state, 7, np.array([True]), {}, {})
    assert len(truth) == 0

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.config import InputError
from flcav.dataset.frame_checks import check_images
from flcav.geometry import inverse, points_in_boxes, pose
from flcav.sensors.camera import Camera
from flcav.sensors.ground_truth import find_occluded_rays
from flcav.sensors.lens import project_optical
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern, cast, draw_passes
from flcav.sensors.observe import observe
from flcav.sensors.rig import RIGS, CalibrationError, MountedLidar, Rig
from flcav.world.map.town import Signs, Town
from flcav.world.scene import Scene
from flcav.world.shapes import SHAPES
from flcav.world.trace import Trace

EVERY_SHAPE = [(category, index) for category in SHAPES for index in range(len(SHAPES[category]))]
STREET = [
    ("cav0", "car", 3, 0.0, -2.0, 0.0),
    ("veh1", "car", 0, 12.0, -2.0, 0.1),
    ("veh2", "van", 1, 22.0, -2.5, 0.0),
    ("veh3", "truck", 0, -14.0, 2.0, np.pi),
    ("veh4", "car", 4, -23.0, 2.5, np.pi),
    ("veh5", "bicycle", 0, 8.0, 3.0, 2.0),
    ("ped6", "pedestrian", 0, 6.0, 5.0, 1.0),
    ("veh7", "car", 5, 30.0, 40.0, 1.0),
    ("veh8", "bus", 0, 200.0, 0.0, 0.0),
]


@pytest.fixture(scope="module")
def street(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    building = np.array([[25.0, 25.0, 0.0, 60.0, 10.0, 12.0]])
    return Scene(small_town(buildings=building), standing(STREET, instants=2))


def by_track(values: np.ndarray, track: np.ndarray) -> dict[str, float]:
    return {str(name): value for name, value in zip(track, values)}


def test_annotates_everyone_in_range_but_the_carrier(street: Scene):
    frame = observe(street, RIGS["lidar32"], "cav0", 0, scene_name="s", seed=1)
    truth = frame.annotations
    assert list(truth.track) == ["veh1", "veh2", "veh3", "veh4", "veh5", "ped6", "veh7"]
    assert list(truth.boxes.label[:3]) == ["car", "van", "truck"]
    np.testing.assert_allclose(truth.boxes.center[0], (12.0, -2.0, 0.75))
    np.testing.assert_allclose(truth.boxes.size[0], SHAPES["car"][0][1:])
    np.testing.assert_allclose(frame.world_from_agent, pose(0.0, -2.0))
    np.testing.assert_allclose(
        frame.world_from_sensor("lidar")[:3, 3], (0.0, -2.0, RIGS["lidar32"].lidars["lidar"].mount.z)
    )
    returns = by_track(truth.returns, truth.track)
    assert returns["veh1"] > 100 > returns["veh7"] == 0
    assert truth.returns.sum() < len(frame.lidar["lidar"])


def test_a_pole_sees_the_carrier_too(street: Scene):
    frame = observe(street, RIGS["lidar_pole"], "pole4", 0, scene_name="s", seed=1)
    returns = by_track(frame.annotations.returns, frame.annotations.track)
    assert returns["cav0"] > 100
    np.testing.assert_allclose(frame.world_from_agent, pose(5.0, -9.0, 6.0, np.pi / 2), atol=1e-12)


def test_occlusion_is_what_an_empty_world_would_show(
    street: Scene, small_town: Callable[..., Town], standing: Callable[..., Trace]
):
    """The oracle traces the whole sweep in a scene of the carrier and that one actor."""
    rig, lidar = RIGS["lidar32"], RIGS["lidar32"].lidars["lidar"]
    frame = observe(street, rig, "cav0", 0, scene_name="s", seed=1)
    occlusion = by_track(frame.annotations.occlusion, frame.annotations.track)
    at = frame.world_from_sensor("lidar")
    passes = np.ones(lidar.settings.channels * lidar.settings.azimuth_steps, bool)
    visible = np.bincount(cast(street, at, lidar.settings, passes, 0).instance + 1, minlength=len(STREET) + 2)[2:]
    for actor in range(1, 7):
        alone = Scene(small_town(), standing([STREET[0], STREET[actor]]))
        shown = np.count_nonzero(cast(alone, at, lidar.settings, passes, 0).instance == 2)
        expected = 1 - visible[actor] / shown
        assert occlusion[STREET[actor][0]] == pytest.approx(expected, abs=0.08)
    assert occlusion["veh1"] < 0.05
    assert 0.15 < occlusion["veh2"] < 1  # behind veh1
    assert occlusion["veh4"] > 0.6  # behind the truck
    assert occlusion["veh7"] == 1  # behind the building


@given(
    pair=st.sampled_from(EVERY_SHAPE),
    distance=st.floats(5.0, 30.0),
    bearing=st.floats(-np.pi, np.pi),
    yaw=st.floats(-np.pi, np.pi),
)
@settings(max_examples=40, deadline=None)
def test_returns_of_an_actor_lie_in_its_box(
    small_town: Callable[..., Town],
    standing: Callable[..., Trace],
    pair: tuple[str, int],
    distance: float,
    bearing: float,
    yaw: float,
):
    place = (distance * np.cos(bearing), distance * np.sin(bearing), yaw)
    trace = standing([("cav0", "car", 3, 0.0, 0.0, 0.0), ("it", *pair, *place)])
    frame = observe(Scene(small_town(), trace), RIGS["lidar32"], "cav0", 0, scene_name="s", seed=1)
    boxes = frame.annotations.boxes.transform(inverse(frame.world_from_sensor("lidar")))
    inside = points_in_boxes(frame.lidar["lidar"], boxes, margin_m=0.1)[0]
    assert frame.annotations.returns[0] <= np.count_nonzero(inside)
    above_ground = points_in_boxes(frame.lidar["lidar"], boxes, margin_m=-0.0)[0]
    assert (
        np.count_nonzero(above_ground) <= 1.3 * frame.annotations.returns[0] + 40
    )  # the rest is road within the margin


def test_same_arguments_same_bytes_whatever_came_before(street: Scene):
    def frame(seed: int, name: str = "s", index: int = 0) -> bytes:
        return observe(street, RIGS["lidar32"], "cav0", index, scene_name=name, seed=seed).lidar["lidar"].tobytes()

    first = frame(1)
    observe(street, RIGS["lidar_pole"], "pole4", 1, scene_name="s", seed=1)
    assert frame(1) == first
    assert len({first, frame(2), frame(1, name="t"), frame(1, index=1)}) == 4


def test_two_lidars_add_up(street: Scene):
    sides = {name: MountedLidar(settings=Lidar(channels=8, azimuth_steps=200)) for name in ("left", "right")}
    both = observe(street, Rig(lidars=sides), "pole4", 0, scene_name="s", seed=1)
    each = [
        observe(street, Rig(lidars={name: lidar}), "pole4", 0, scene_name="s", seed=1) for name, lidar in sides.items()
    ]
    assert set(both.lidar) == {"left", "right"}
    np.testing.assert_array_equal(both.annotations.returns, sum(one.annotations.returns for one in each))


def test_two_lidars_in_one_place_see_the_occlusion_of_one(street: Scene):
    one = RIGS["lidar32"].lidars["lidar"]
    alone, both = (
        observe(street, Rig(lidars=dict.fromkeys(names, one)), "cav0", 0, scene_name="s", seed=1).annotations
        for names in (("left",), ("left", "right"))
    )
    assert ((alone.occlusion > 0.15) & (alone.occlusion < 0.85)).any()
    np.testing.assert_allclose(both.occlusion, alone.occlusion, atol=0.03)


@pytest.mark.parametrize(
    ("agent", "message"),
    [("cav9", "no such vehicle"), ("pole9", "no such pole; it has pole4"), ("", "no such vehicle")],
)
def test_unknown_agents_are_named(street: Scene, agent: str, message: str):
    with pytest.raises(InputError, match=message):
        observe(street, RIGS["lidar32"], agent, 0, scene_name="s", seed=1)


def test_an_absent_agent_cannot_observe(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    trace = standing(STREET[:2])
    trace.present[0, 0] = False
    with pytest.raises(InputError, match=r"agent 'cav0' is not in town at 0\.0 s"):
        observe(Scene(small_town(), trace), RIGS["lidar32"], "cav0", 0, scene_name="s", seed=1)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_rays_into_a_box_are_found_by_brute_force_too(seed: int):
    rng = np.random.default_rng(seed)
    lidar = Lidar(channels=8, azimuth_steps=60, up_deg=20.0, down_deg=-60.0)
    rays, size = build_ray_pattern(lidar), rng.uniform(0.5, 8.0, 3)
    body_from_sensor = pose(*rng.uniform((-12, -12, -1, -0.3, -0.3, -0.3), (12, 12, 8, 0.3, 0.3, 0.3)))
    body_from_sensor[:3, :3] = pose(0, 0, 0, rng.uniform(-np.pi, np.pi))[:3, :3] @ body_from_sensor[:3, :3]
    found = find_occluded_rays(rays, lidar.azimuth_steps, body_from_sensor, size, 0.0, np.zeros(len(rays), np.float32))
    steps = np.linspace(0, 40, 1001)[:, None, None]
    points = body_from_sensor[:3, 3] + steps * (rays.astype(float) @ body_from_sensor[:3, :3].T)
    low, high = np.array([-size[0] / 2, -size[1] / 2, 0]), np.array([size[0] / 2, size[1] / 2, size[2]])
    through = ((points >= low + 0.05) & (points <= high - 0.05)).all(axis=2).any(axis=0)
    assert set(np.flatnonzero(through)) <= set(found)
    near = ((points >= low - 0.05) & (points <= high + 0.05)).all(axis=2).any(axis=0)
    assert set(found) <= set(np.flatnonzero(near))


def test_passes_are_drawn_as_often_as_asked():
    assert draw_passes(Lidar(glass_pass=0.9), np.random.default_rng(0)).mean() == pytest.approx(0.9, abs=0.01)


EVERYTHING = {
    "lidars": {"lidar": {"mount": {"z": 1.8}, "settings": {"channels": 8, "azimuth_steps": 180}}},
    "cameras": {"front": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 96, "height": 64}, "trigger_ms": 40.0}},
    "infrareds": {"warm": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 64, "height": 48}}},
    "radars": {"radar": {"mount": {"x": 2.0, "z": 0.5}}},
    "gnss": {"gnss": {"mount": {"z": 1.6}}},
    "imus": {"imu": {"mount": {"z": 0.5}, "trigger_ms": -20.0}},
}


@pytest.fixture(scope="module")
def driving(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    """The street with everybody under way at 10 m/s, on a bend."""
    trace = standing(STREET, instants=2)
    heading = np.stack((np.cos(trace.yaw), np.sin(trace.yaw), 0 * trace.yaw), axis=-1)
    return Scene(small_town(), replace(trace, velocity=10.0 * heading, yaw_rate=0.2 + 0 * trace.yaw))


def test_every_sensor_looks_at_its_own_time(driving: Scene):
    frame = observe(driving, Rig.model_validate(EVERYTHING), "cav0", 0, scene_name="s", seed=1)
    assert set(frame.agent_at_trigger) == {"front", "imu"}
    moved = inverse(frame.world_from_agent) @ frame.agent_at_trigger["front"]
    np.testing.assert_allclose(moved[:3, 3], (0.4, 0.0, 0.0), atol=1e-9)
    assert np.arctan2(moved[1, 0], moved[0, 0]) == pytest.approx(0.2 * 0.04)
    np.testing.assert_allclose(frame.world_from_sensor("lidar")[:3, 3], (0.0, -2.0, 1.8))
    np.testing.assert_allclose(
        frame.world_from_sensor("front"), frame.agent_at_trigger["front"] @ frame.agent_from_sensor["front"]
    )
    assert frame.calibration.offset_ms == dict.fromkeys(frame.agent_from_sensor, 0.0) | {"front": 40.0, "imu": -20.0}
    assert driving.offset_s == 0.0


def test_what_the_camera_shows_is_what_is_annotated(driving: Scene):
    frame = observe(driving, Rig.model_validate(EVERYTHING), "cav0", 0, scene_name="s", seed=1)
    truth, image = frame.annotations, frame.images["front"]
    views = truth.views["front"]
    assert image.instance is not None
    np.testing.assert_array_equal(np.bincount(image.instance.ravel(), minlength=len(truth) + 1)[1:], views.pixels)
    assert views.pixels[list(truth.track).index("veh1")] > 30
    assert set(truth.points) == {"lidar", "radar"}
    np.testing.assert_array_equal(truth.points["lidar"], truth.returns)
    assert truth.points["radar"].sum() <= len(frame.radar["radar"])
    assert frame.infrared["warm"].shape == (48, 64)
    assert truth.views["warm"].pixels[list(truth.track).index("veh1")] > 20
    assert frame.gnss["gnss"].shape == (3,)
    assert frame.imu["imu"].shape == (6,)
    assert not list(check_images(frame))


def test_one_sensor_does_not_change_another(driving: Scene):
    alone = Rig.model_validate({"lidars": EVERYTHING["lidars"]})
    rig = Rig.model_validate(EVERYTHING)
    one, all_of_them = (observe(driving, r, "cav0", 0, scene_name="s", seed=1) for r in (alone, rig))
    assert one.lidar["lidar"].tobytes() == all_of_them.lidar["lidar"].tobytes()
    np.testing.assert_array_equal(one.annotations.occlusion[:3], all_of_them.annotations.occlusion[:3])
    error = CalibrationError(position_m=0.5, time_ms=3.0)
    wrong = observe(driving, rig, "cav0", 0, scene_name="s", seed=1, error=error)
    assert wrong.images["front"].rgb.tobytes() == all_of_them.images["front"].rgb.tobytes()
    assert not np.allclose(wrong.assumed_world_from_sensor("front"), wrong.world_from_sensor("front"))
    np.testing.assert_array_equal(wrong.world_from_sensor("front"), all_of_them.world_from_sensor("front"))


def test_an_actor_beyond_the_lidars_range_is_annotated_where_it_shows(
    small_town: Callable[..., Town], standing: Callable[..., Trace]
):
    trace = standing([STREET[0], ("far", "bus", 0, 95.0, -2.0, 0.0), ("behind", "bus", 0, -95.0, -2.0, 0.0)])
    rig = Rig.model_validate(EVERYTHING)
    frame = observe(Scene(small_town(), trace), rig, "cav0", 0, scene_name="s", seed=1)
    assert list(frame.annotations.track) == ["far"]
    assert frame.annotations.returns[0] == 0 < frame.annotations.views["front"].pixels[0]


def test_signs_are_named_where_their_readable_side_shows(
    small_town: Callable[..., Town], standing: Callable[..., Trace]
):
    position = np.array([[14.0, 0.0, 2.2], [14.0, 3.0, 2.2], [300.0, 0.0, 2.2]])
    signs = Signs(position, np.array([np.pi, 0.0, np.pi]), ("stop", "yield", "speed_30"))
    scene = Scene(small_town(signs=signs), standing(STREET[:1]))
    frame = observe(scene, Rig.model_validate(EVERYTHING), "cav0", 0, scene_name="s", seed=1)
    seen = frame.annotations.signs["front"]
    assert seen.kind.tolist() == ["stop"]
    assert seen.state.tolist() == [""]
    assert seen.thing.tolist() == [0]
    assert seen.pixels[0] > 5
    camera = frame.world_from_sensor("front")
    assert seen.distance_m[0] == pytest.approx(np.linalg.norm(position[0] - camera[:3, 3]))
    u, v = project_optical(Camera(width=96, height=64), (position[:1] - camera[:3, 3]) @ camera[:3, :3])[0]
    x1, y1, x2, y2 = seen.box[0]
    assert x1 < u < x2
    assert y1 < v < y2

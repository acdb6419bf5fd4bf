from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.config import InputError
from flcav.geometry import inverse, points_in_boxes, pose
from flcav.sensors.lidar import Lidar, cast, draw_passes, ray_pattern
from flcav.sensors.observe import observe
from flcav.sensors.rig import RIGS, MountedLidar, Rig
from flcav.sensors.visibility import rays_into_box
from flcav.world.scene import Scene
from flcav.world.shapes import SHAPES
from flcav.world.town import Town
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
    frame = observe(street, RIGS["car"], "cav0", 0, scene_name="s", seed=1)
    truth = frame.annotations
    assert list(truth.track) == ["veh1", "veh2", "veh3", "veh4", "veh5", "ped6", "veh7"]
    assert list(truth.boxes.label[:3]) == ["car", "van", "truck"]
    np.testing.assert_allclose(truth.boxes.center[0], (12.0, -2.0, 0.75))
    np.testing.assert_allclose(truth.boxes.size[0], SHAPES["car"][0][1:])
    np.testing.assert_allclose(frame.world_from_agent, pose(0.0, -2.0))
    np.testing.assert_allclose(
        frame.world_from_sensor("lidar")[:3, 3], (0.0, -2.0, RIGS["car"].lidars["lidar"].mount.z)
    )
    returns = by_track(truth.returns, truth.track)
    assert returns["veh1"] > 100 > returns["veh7"] == 0
    assert truth.returns.sum() < len(frame.lidar["lidar"])


def test_a_pole_sees_the_carrier_too(street: Scene):
    frame = observe(street, RIGS["roadside"], "pole4", 0, scene_name="s", seed=1)
    returns = by_track(frame.annotations.returns, frame.annotations.track)
    assert returns["cav0"] > 100
    np.testing.assert_allclose(frame.world_from_agent, pose(5.0, -9.0, 6.0, np.pi / 2), atol=1e-12)


def test_occlusion_is_what_an_empty_world_would_show(
    street: Scene, small_town: Callable[..., Town], standing: Callable[..., Trace]
):
    """The oracle traces the whole sweep in a scene of the carrier and that one actor."""
    rig, lidar = RIGS["car"], RIGS["car"].lidars["lidar"]
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
    frame = observe(Scene(small_town(), trace), RIGS["car"], "cav0", 0, scene_name="s", seed=1)
    boxes = frame.annotations.boxes.transformed(inverse(frame.world_from_sensor("lidar")))
    inside = points_in_boxes(frame.lidar["lidar"], boxes, margin_m=0.1)[0]
    assert frame.annotations.returns[0] <= np.count_nonzero(inside)
    above_ground = points_in_boxes(frame.lidar["lidar"], boxes, margin_m=-0.0)[0]
    assert (
        np.count_nonzero(above_ground) <= 1.3 * frame.annotations.returns[0] + 40
    )  # the rest is road within the margin


def test_same_arguments_same_bytes_whatever_came_before(street: Scene):
    def frame(seed: int, name: str = "s", index: int = 0) -> bytes:
        return observe(street, RIGS["car"], "cav0", index, scene_name=name, seed=seed).lidar["lidar"].tobytes()

    first = frame(1)
    observe(street, RIGS["roadside"], "pole4", 1, scene_name="s", seed=1)
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


@pytest.mark.parametrize(
    ("agent", "message"),
    [("cav9", "no such vehicle"), ("pole9", "no such pole; it has pole4"), ("", "no such vehicle")],
)
def test_unknown_agents_are_named(street: Scene, agent: str, message: str):
    with pytest.raises(InputError, match=message):
        observe(street, RIGS["car"], agent, 0, scene_name="s", seed=1)


def test_an_absent_agent_cannot_observe(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    trace = standing(STREET[:2])
    trace.present[0, 0] = False
    with pytest.raises(InputError, match=r"agent 'cav0' is not in town at 0\.0 s"):
        observe(Scene(small_town(), trace), RIGS["car"], "cav0", 0, scene_name="s", seed=1)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_rays_into_a_box_are_found_by_brute_force_too(seed: int):
    rng = np.random.default_rng(seed)
    lidar = Lidar(channels=8, azimuth_steps=60, up_deg=20.0, down_deg=-60.0)
    rays, size = ray_pattern(lidar), rng.uniform(0.5, 8.0, 3)
    body_from_sensor = pose(*rng.uniform((-12, -12, -1, -0.3, -0.3, -0.3), (12, 12, 8, 0.3, 0.3, 0.3)))
    body_from_sensor[:3, :3] = pose(0, 0, 0, rng.uniform(-np.pi, np.pi))[:3, :3] @ body_from_sensor[:3, :3]
    found = rays_into_box(rays, lidar.azimuth_steps, body_from_sensor, size, 0.0, np.zeros(len(rays), np.float32))
    steps = np.linspace(0, 40, 1001)[:, None, None]
    points = body_from_sensor[:3, 3] + steps * (rays.astype(float) @ body_from_sensor[:3, :3].T)
    low, high = np.array([-size[0] / 2, -size[1] / 2, 0]), np.array([size[0] / 2, size[1] / 2, size[2]])
    through = ((points >= low + 0.05) & (points <= high - 0.05)).all(axis=2).any(axis=0)
    assert set(np.flatnonzero(through)) <= set(found)
    near = ((points >= low - 0.05) & (points <= high + 0.05)).all(axis=2).any(axis=0)
    assert set(found) <= set(np.flatnonzero(near))


def test_passes_are_drawn_as_often_as_asked():
    assert draw_passes(Lidar(glass_pass=0.9), np.random.default_rng(0)).mean() == pytest.approx(0.9, abs=0.01)

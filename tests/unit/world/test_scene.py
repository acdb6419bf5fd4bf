from collections.abc import Callable

import numpy as np
import pytest

from flcav.geometry import pose
from flcav.world.map.town import Town
from flcav.world.materials import PAINT_REFLECTIVITY, Material
from flcav.world.scene import Scene
from flcav.world.trace import Trace

AHEAD = np.array([[1.0, 0.0, 0.0]], np.float32)
EYE = pose(0.0, 0.0, 0.5)


def ahead(scene: Scene, hidden: int | None = None) -> tuple[float, int]:
    hits = scene.cast(EYE, AHEAD, hidden=hidden)
    return float(hits.distance[0]), int(hits.instance[0])


@pytest.fixture
def scene(small_town: Callable[..., Town], standing: Callable[..., Trace]) -> Scene:
    trace = standing([("cav0", "truck", 0, 20.0, 0.0, 0.0), ("veh1", "truck", 0, 40.0, 0.0, 0.0)], instants=3)
    trace.position[1, 0, 0] = 25.0
    trace.present[2, 0] = False
    trace.position[2, 0], trace.yaw[2, 0], trace.velocity[2, 0] = np.nan, np.nan, np.nan
    building = np.array([[60.0, 0.0, 0.0, 10.0, 10.0, 10.0]])
    return Scene(small_town(buildings=building), trace)


def test_actors_are_where_the_trace_says(scene: Scene):
    assert ahead(scene) == (pytest.approx(20.0 - 3.9, abs=0.2), 1)
    scene.move_to(1)
    assert ahead(scene) == (pytest.approx(25.0 - 3.9, abs=0.2), 1)
    scene.move_to(0)
    assert ahead(scene) == (pytest.approx(20.0 - 3.9, abs=0.2), 1)


def test_between_instants_actors_go_on(scene: Scene):
    trace = scene.trace
    trace.velocity[0, 0], trace.acceleration[0, 0], trace.yaw_rate[0, 0] = (10.0, 0, 0), (4.0, 2, 0), 0.5
    scene.move_to(0, 0.1)
    np.testing.assert_allclose(scene.world_from_actor(0), pose(21.02, 0.01, 0.0, 0.05))
    np.testing.assert_allclose(scene.world_from_instance()[1], pose(0, 0, 0, 0.05)[:3, :3])
    assert ahead(scene) == (pytest.approx(21.02 - 3.9, abs=0.2), 1)
    scene.move_to(0, -0.05)
    np.testing.assert_allclose(scene.world_from_actor(0)[0, 3], 20 - 0.5 + 0.005)
    scene.move_to(0)
    np.testing.assert_array_equal(scene.world_from_actor(0), pose(20.0, 0.0))
    with pytest.raises(ValueError, match=r"offset_s = 0\.2"):
        scene.move_to(0, 0.2)


def test_absent_actors_are_nowhere(scene: Scene):
    scene.move_to(2)
    assert ahead(scene) == (pytest.approx(40.0 - 3.9, abs=0.2), 2)


def test_an_actor_can_be_hidden_and_shown(scene: Scene):
    assert ahead(scene, hidden=0)[1] == 2
    assert ahead(scene, hidden=1)[1] == 1
    assert ahead(scene)[1] == 1
    scene.move_to(2)
    assert ahead(scene, hidden=1) == (pytest.approx(55.0, abs=0.2), 0)  # the building


def test_surfaces_tell_face_and_paint(scene: Scene):
    hits = scene.cast(EYE, AHEAD)
    surfaces = scene.surfaces
    row = surfaces.first[hits.instance[0]] + hits.face[0]
    assert abs(surfaces.normal[row] @ AHEAD[0]) > 0.7  # the truck's tail
    assert surfaces.first[1] == surfaces.first[2]  # one mesh, two actors
    assert surfaces.reflectivity.shape == (3, len(Material))
    assert surfaces.reflectivity[1, Material.PAINT] in PAINT_REFLECTIVITY


def test_one_actor_alone_is_seen_in_its_own_frame(scene: Scene):
    frames = np.stack((pose(-10.0, 0.0, 0.5), pose(-20.0, 0.0, 0.5), pose(-10.0, 30.0, 0.5)))
    rays = np.repeat(AHEAD[:1], 4, axis=0)
    hits = scene.cast_each(np.array([1, 0, 1]), frames, np.array([1, 3, 4]), rays)
    assert hits.distance == pytest.approx([10.0 - 3.9, 20.0 - 3.9, 20.0 - 3.9, np.inf], abs=0.2)
    assert hits.instance.tolist() == [0, 1, 1, -1]
    beyond = scene.cast_each(np.array([1]), frames[:1], np.array([1]), rays[:1], near_m=hits.distance[:1] + 1)
    assert beyond.distance[0] > hits.distance[0] + 1


def test_a_town_is_built_once(small_town: Callable[..., Town], standing: Callable[..., Trace]):
    first = Scene(small_town(), standing([]))
    second = Scene(small_town(), standing([]))
    other = Scene(small_town(buildings=np.array([[20.0, 0.0, 0.0, 10.0, 10.0, 10.0]])), standing([]))
    assert first._solids[0] is second._solids[0]
    assert ahead(first)[1] == -1
    assert ahead(other) == (pytest.approx(15.0, abs=0.2), 0)

"""Checks over a whole scene find blocked sensors and actors that jump, and leave good ones alone."""

from dataclasses import replace

import numpy as np
import pytest

from flcav.dataset.frame_checks import check_sweeps
from flcav.dataset.scene_checks import BlockedViews, check_motion
from flcav.geometry import pose
from flcav.sensors.observe import observe
from flcav.sensors.rig import lidar_pole
from flcav.world.map.town import TOWNS, load_town
from flcav.world.scene import Scene
from flcav.world.trace import Trace
from flcav.world.traffic.traffic import simulate


@pytest.fixture(scope="module")
def traffic() -> Trace:
    return simulate(load_town("ring"), seed=1, cavs=1, times_s=30.0 + 0.5 * np.arange(12))


def test_actors_that_move_as_recorded_are_left_alone(traffic: Trace):
    assert list(check_motion("ring-1-000", traffic)) == []


@pytest.mark.parametrize("kind", ["cav", "ped", "parked"])
def test_an_actor_that_jumps_is_named_with_its_speeds(traffic: Trace, kind: str):
    actor = next(i for i, name in enumerate(traffic.actor) if name.startswith(kind) and traffic.present[:, i].all())
    position = traffic.position.copy()
    position[6:, actor, 0] += 8.0
    (problem,) = check_motion("ring-1-000", replace(traffic, position=position))
    assert f"'{traffic.actor[actor]}' moves" in problem
    assert "from 32.5 s to 33 s" in problem


def test_speeds_at_the_ends_of_long_steps_say_nothing(traffic: Trace):
    jumped = replace(traffic, position=traffic.position * 2.0, time_s=traffic.time_s * 4.0)
    assert list(check_motion("ring-1-000", jumped)) == []


@pytest.mark.parametrize("name", TOWNS)
def test_every_pole_of_our_towns_sees(name: str):
    town = load_town(name)
    world = Scene(town, simulate(town, seed=1, cavs=0, times_s=np.array([30.0])))
    sight, seen = BlockedViews(), []
    for pole in town.poles.id:
        frame = observe(world, lidar_pole(), f"pole{pole}", 0, scene_name="scene", seed=1)
        sight.add(frame)
        seen.append((np.linalg.norm(frame.lidar["lidar"][:, :3], axis=1) < 0.5).mean())
    assert list(sight.problems()) == []
    assert max(seen) < 0.12  # its mast and arm alone


def test_a_sensor_behind_something_is_named(traffic: Trace):
    town = load_town("ring")
    lamps = np.append(town.lamps, [[*town.poles.position[0, :2] + 0.02, 7.0]], axis=0)
    world = Scene(replace(town, lamps=lamps), traffic)
    sight = BlockedViews()
    for pole in (1, 2):
        sight.add(observe(world, lidar_pole(), f"pole{pole}", 0, scene_name="scene", seed=1))
    (problem,) = sight.problems()
    assert problem.startswith("pole1: 'lidar' sees almost nothing but its own mount: ")


@pytest.mark.parametrize(("tilt_rad", "missing_deg", "told"), [(0, 60, 1), (0.03, 60, 1), (0.3, 60, 0), (0.3, 200, 1)])
def test_on_steep_ground_half_of_a_sweep_may_be_sky(traffic: Trace, tilt_rad: float, missing_deg: float, told: int):
    frame = observe(Scene(load_town("ring"), traffic), lidar_pole(), "pole1", 0, scene_name="scene", seed=1)
    azimuth = np.radians(np.arange(0.0, 360.0 - missing_deg))
    sweep = np.stack((np.cos(azimuth), np.sin(azimuth), 0 * azimuth, 0.5 + 0 * azimuth), axis=1).astype(np.float32)
    seen = replace(frame, lidar={"lidar": sweep}, world_from_agent=pose(1.0, 2.0, 3.0, pitch=tilt_rad))
    assert len(list(check_sweeps(seen))) == told

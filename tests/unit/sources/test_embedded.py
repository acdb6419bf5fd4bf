import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from flcav.config import InputError
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.map.town import load_town

BURIED, TOO_LOW = ({"lidars": {"low": {"mount": {"z": z}}}} for z in (-0.3, -9.0))


def small(**fields: object) -> EmbeddedSource:
    settings = {"town": "suburb", "seed": 3, "cavs": 2, "warmup_s": 35.0, "spins_per_scene": 2, "scenes": 2}
    return EmbeddedSource(Recipe.model_validate(settings | fields))


def test_scenes_are_named_by_town_seed_and_number():
    assert small().scenes() == ["suburb-3-000", "suburb-3-001"]


def test_a_town_whose_name_is_too_long_for_names_of_frames(tmp_path: Path):
    for count in (64, 65):
        shutil.copytree(load_town("suburb").net.parent, tmp_path / (count * "t"))
    long = {"town": str(tmp_path / (64 * "t")), "seed": 10**18, "spins_per_scene": 200_000, "every_s": 0.1}
    assert len(f"{64 * 't'}-{10**18}-000_199999_cav0") == 100
    assert small(**long).scenes()[0].startswith("ttt")
    with pytest.raises(InputError, match="101 characters where 100 are allowed"):
        small(**long, cavs=11)
    with pytest.raises(InputError, match="letters, digits, - and _, 64 at most"):
        small(town=str(tmp_path / (65 * "t")))


def test_a_number_of_frames_takes_as_many_scenes_as_it_needs():
    source = small(frames=9)
    assert source.scenes() == ["suburb-3-000", "suburb-3-001", "suburb-3-002"]
    assert [source.frame_count(scene) for scene in source.scenes()] == [4, 4, 1]
    assert small(frames=3).scenes() == ["suburb-3-000"]
    assert small(frames=8).describe() == small().describe()


def test_frames_come_spin_by_spin_vehicles_before_poles():
    source = small(poles=[1], scenes=1)
    frames = list(source.frames("suburb-3-000"))
    assert len(frames) == source.frame_count("suburb-3-000") == 6
    assert [(frame.index, frame.agent) for frame in frames[:3]] == [(0, "cav0"), (0, "cav1"), (0, "pole1")]
    assert [frame.time_s for frame in frames[::3]] == [35.0, 36.0]
    assert all(len(frame.lidar["lidar"]) > 100 for frame in frames)


def test_a_window_is_recorded_and_said_where_there_is_one():
    source = small(poles=[1], scenes=1, window_s=0.5, spins_per_scene=1)
    frames = list(source.frames("suburb-3-000"))
    assert len(frames) == source.frame_count("suburb-3-000") == 9
    assert [(frame.index, frame.time_s) for frame in frames[::3]] == [(0, 34.5), (1, 35.0), (2, 35.5)]
    assert source.describe()["window_s"] == 0.5
    assert "window_s" not in small().describe()


def test_windows_are_recorded_of_vehicles_near_a_pole_and_of_no_pole():
    """With a range: whole windows of the vehicles near a recording pole at the spin in the middle, none of others."""
    how = {"poles": [1], "scenes": 1, "cavs": 4, "window_s": 0.4, "window_every_s": 0.2, "spins_per_scene": 2}
    plain = small(**how, every_s=4.0)
    source = small(**how, every_s=4.0, window_range_m=60.0)
    (scene,) = source.scenes()
    trace, pole = source.trace(scene), source.town.poles.position[source.town.poles.id.tolist().index(1), :2]
    assert trace.time_s.tolist() == [34.6, 34.8, 35.0, 35.2, 35.4, 38.6, 38.8, 39.0, 39.2, 39.4]
    kept = {(frame.index, frame.agent) for frame in source.frames(scene)}
    for agent in (*source.agents,):
        for middle in source.recipe.middle_spins:
            wanted = {middle}
            if agent.startswith("cav"):
                place = trace.position[middle, trace.actor.tolist().index(agent), :2]
                if np.linalg.norm(place - pole) <= 60:
                    wanted = set(range(middle - 2, middle + 3))
            assert {index for index, name in kept if name == agent and abs(index - middle) <= 2} == wanted
    assert len(kept) < len([*plain.frames(scene)]) == plain.frame_count(scene) == 50
    same = {(frame.index, frame.agent): frame for frame in plain.frames(scene)}
    for frame in source.frames(scene):
        np.testing.assert_array_equal(frame.lidar["lidar"], same[frame.index, frame.agent].lidar["lidar"])
    nobody = small(**how | {"poles": []}, every_s=4.0, window_range_m=60.0)  # no pole to be near: all of them
    assert len([*nobody.frames(scene)]) == 40


def test_a_scene_is_the_same_whatever_was_asked_before_and_in_a_copy():
    source = small()
    last = next(iter(source.frames("suburb-3-001")))
    list(source.frames("suburb-3-000"))
    again = next(iter(pickle.loads(pickle.dumps(source)).frames("suburb-3-001")))
    np.testing.assert_array_equal(last.lidar["lidar"], again.lidar["lidar"])
    np.testing.assert_array_equal(last.annotations.boxes.array(), again.annotations.boxes.array())


def test_scenes_differ_in_traffic_and_in_parked_cars():
    source = small()
    first, second = (source.trace(scene) for scene in source.scenes())
    for kind in ("veh", "parked"):
        places = [
            {tuple(row.round(2)) for row in trace.position[0, np.char.startswith(trace.actor, kind)]}
            for trace in (first, second)
        ]
        assert places[0] != places[1], kind


def test_each_scene_draws_its_own_warm_up_from_a_range():
    source = small(warmup_s=[35.0, 95.0], scenes=4)
    starts = [float(source.trace(scene).time_s[0]) for scene in source.scenes()]
    assert len(set(starts)) == 4
    assert 35.0 <= min(starts) < max(starts) <= 95.0
    again = source.scenes()[0]
    assert small(warmup_s=[35.0, 95.0], scenes=4).trace(again).time_s[0] == starts[0]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"town": "atlantis"}, "unknown town 'atlantis'"),
        ({"poles": [99]}, "field 'poles' = 99: no pole of suburb"),
        ({"vehicle_rig": BURIED}, r"field 'vehicle_rig': sensor 'low' at z = -0.3 m .* above the ground on a vehicle"),
        ({"poles": [1], "pole_rig": TOO_LOW}, r"field 'pole_rig': sensor 'low' at z = -9.0 m .* on pole 1, .* m up"),
        ({"cavs": 0}, "nobody observes"),
    ],
)
def test_what_the_town_does_not_have(fields: dict, message: str):
    with pytest.raises(InputError, match=message):
        small(**fields)

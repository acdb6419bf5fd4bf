"""That each corner case truly happens, read off the trace alone."""

from pathlib import Path

import numpy as np
import pytest
import shapely
from pydantic import ValidationError
from shapely.geometry import LineString, Point, Polygon

from flcav.config import InputError, read_config
from flcav.geometry import wrap_angle
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.map.roads import read_net
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import Town, load_town
from flcav.world.scenarios.director import SCRIPTS
from flcav.world.scenarios.scenario import Scenario
from flcav.world.shapes import SHAPES
from flcav.world.trace import Event, Trace
from flcav.world.traffic.traffic import simulate

RECIPES = Path(__file__).parents[3] / "recipes"
STEP_S = 0.1
FROM_S, UNTIL_S, AT_S = 44.0, 80.0, 45.0


def run(town: Town, kind: str, seed: int, until_s: float = UNTIL_S, **fields: object) -> tuple[Trace, Event, int]:
    """Return the trace, the event, and the index of the instant at which it begins."""
    scenario = Scenario.model_validate({"kind": kind, "at_s": AT_S, **fields})
    times_s = np.round(np.arange(FROM_S, until_s, STEP_S), 1)
    trace = simulate(town, seed=seed, cavs=3, times_s=times_s, scenarios=[scenario])
    assert [event.kind for event in trace.events] == [kind]
    return trace, trace.events[0], round((trace.events[0].begins_s - FROM_S) / STEP_S)


def box(trace: Trace, instant: int, actor: int | np.intp) -> Polygon:
    x, y, _ = trace.position[instant, actor]
    return make_footprint(x, y, trace.yaw[instant, actor], *trace.size[actor, :2])


def index(trace: Trace, name: str) -> int:
    return trace.actor.tolist().index(name)


def speed(trace: Trace, actor: int) -> np.ndarray:
    return np.linalg.norm(trace.velocity[:, actor], axis=1)


def in_frame(trace: Trace, instant: int, actor: int, point: np.ndarray) -> tuple[float, float]:
    """Return how far ahead and to the left of an actor's centre a point is."""
    dx, dy = point[:2] - trace.position[instant, actor, :2]
    yaw = trace.yaw[instant, actor]
    return dx * np.cos(yaw) + dy * np.sin(yaw), -dx * np.sin(yaw) + dy * np.cos(yaw)


@pytest.mark.parametrize(("town", "seed"), [("ring", 1), pytest.param("grid", 0, marks=pytest.mark.slow)])
def test_somebody_pushes_in_close_ahead(town: str, seed: int) -> None:
    trace, event, begins = run(load_town(town), "cut_in", seed)
    ego, other = (index(trace, name) for name in event.actors)
    before = in_frame(trace, begins, ego, trace.position[begins, other])
    assert abs(before[1]) > 2.0  # beside the lane
    gaps = []
    for instant in range(begins, begins + 40):
        ahead, left = in_frame(trace, instant, ego, trace.position[instant, other])
        assert not box(trace, instant, ego).intersects(box(trace, instant, other))
        if abs(left) < 1.0:
            gaps.append(ahead - (trace.size[ego, 0] + trace.size[other, 0]) / 2)
    assert gaps
    assert 0.3 < gaps[0] < 10.0
    assert speed(trace, ego)[begins : begins + 40].min() < speed(trace, ego)[begins] - 1.0  # it had to brake


@pytest.mark.parametrize(("town", "seed"), [("suburb", 2), pytest.param("ring", 6, marks=pytest.mark.slow)])
def test_an_oncoming_car_overtakes_in_the_lane_of_those_it_meets(town: str, seed: int) -> None:
    loaded = load_town(town)
    trace, event, begins = run(loaded, "overtaking", seed)
    slow, fast = (index(trace, name) for name in event.actors)
    end = begins + 70
    behind = in_frame(trace, begins, slow, trace.position[begins, fast])
    assert behind[0] < -5.0
    assert abs(behind[1]) < 1.0
    passing = [in_frame(trace, i, slow, trace.position[i, fast]) for i in range(begins, end)]
    beside = [left for ahead, left in passing if abs(ahead) < 2.0]
    assert beside
    assert min(beside) > 2.2
    assert max(ahead for ahead, _ in passing) > 5.0
    wrong_way = 0
    opposite = [lane for edge in read_net(loaded.net).streets for lane in edge.lanes_of("driving")]
    for i in range(begins, end):
        at = Point(trace.position[i, fast, :2])
        nearest = min(opposite, key=lambda lane: LineString(lane.shape).distance(at))
        line = LineString(nearest.shape)
        a, b = (line.interpolate(line.project(at) + off) for off in (-0.5, 0.5))
        along = np.arctan2(b.y - a.y, b.x - a.x)
        wrong_way += abs(wrap_angle(along - trace.yaw[i, fast])) > np.pi / 2
        for other in np.flatnonzero(trace.present[i] & ~np.char.startswith(trace.actor, "p")):
            if other != fast:
                assert box(trace, i, fast).intersection(box(trace, i, other)).area < 0.05, (trace.actor[other], i)
    assert wrong_way * STEP_S > 1.0


@pytest.mark.parametrize(("town", "seed"), [("suburb", 0), pytest.param("grid", 1, marks=pytest.mark.slow)])
def test_a_pedestrian_hidden_by_the_van_runs_before_the_vehicle(town: str, seed: int) -> None:
    loaded = load_town(town)
    trace, event, begins = run(loaded, "pedestrian_behind_van", seed, actors={"pedestrian": "pedestrian.child"})
    ego, van, child = (index(trace, name) for name in event.actors)
    assert SHAPES["pedestrian"][trace.shape[child]].name == "child"
    assert (trace.velocity[:, van] == 0).all()
    assert not any(
        box(trace, begins, van).intersects(box(trace, begins, other))
        for other in np.flatnonzero(np.char.startswith(trace.actor, "parked"))
    )
    roads = shapely.union_all([Polygon(outline) for outline in loaded.roads])
    before_it = []
    for i in range(begins, begins + 150):
        ahead, left = in_frame(trace, i, ego, trace.position[i, child])
        if 0 < ahead < 25 and abs(left) < 1.2 and roads.contains(Point(trace.position[i, child, :2])):
            before_it.append(i)
    assert before_it
    hidden = before_it[0] - round(2.0 / STEP_S)
    sight = LineString([trace.position[hidden, ego, :2], trace.position[hidden, child, :2]])
    assert sight.intersects(box(trace, hidden, van))
    assert speed(trace, ego)[begins : before_it[-1] + 10].min() < 0.75 * speed(trace, ego)[begins]  # it brakes
    for i in range(begins, begins + 150):
        assert not box(trace, i, ego).intersects(box(trace, i, child))


@pytest.mark.parametrize(("town", "seed"), [("grid", 1), pytest.param("ring", 2, marks=pytest.mark.slow)])
def test_somebody_crosses_the_stop_line_on_red(town: str, seed: int) -> None:
    loaded = load_town(town)
    trace, event, begins = run(loaded, "red_light_runner", seed)
    runner = index(trace, event.actors[0])
    net = read_net(loaded.net)
    crossed = []
    for connection in net.connections:
        edge = net.edges[connection.start.rpartition("_")[0]]
        if not connection.light or edge.function != "normal":
            continue
        lane = next(lane for lane in edge.lanes if lane.id == connection.start)
        (ax, ay), (bx, by) = lane.shape[-2], lane.shape[-1]
        heading = np.arctan2(by - ay, bx - ax)
        normal = np.array([-np.sin(heading), np.cos(heading)]) * lane.width / 2
        stop_line = LineString(np.array([bx, by]) + np.array([-normal, normal]))
        front = (
            trace.position[:, runner, :2]
            + trace.size[runner, 0] / 2 * np.c_[np.cos(trace.yaw[:, runner]), np.sin(trace.yaw[:, runner])]
        )
        for i in range(begins, min(begins + 100, len(front) - 1)):
            same_way = abs(wrap_angle(trace.yaw[i, runner] - heading)) < 0.3
            if same_way and LineString(front[i : i + 2]).intersects(stop_line):
                crossed.append(trace.light_state[i, trace.light.tolist().index(connection.light)])
    assert "r" in crossed


def test_a_vehicle_breaks_down_and_drives_on_when_it_may() -> None:
    town = load_town("suburb")
    trace, event, begins = run(town, "stalled_vehicle", 1)
    victim = speed(trace, index(trace, event.actors[0]))
    assert victim[begins] > 2.5
    assert victim[begins + 40 :].max() < 0.05
    at = trace.position[begins, :, :2]
    distance = np.linalg.norm(at[np.char.startswith(trace.actor, "cav")] - at[index(trace, event.actors[0])], axis=1)
    assert distance.min() < 60.0
    trace, event, begins = run(town, "stalled_vehicle", 1, lasts_s=5.0)
    victim = speed(trace, index(trace, event.actors[0]))
    assert victim[begins + 40] < 0.05
    assert victim[begins + 80 :].max() > 2.0


@pytest.mark.parametrize(("town", "seed"), [("suburb", 1), pytest.param("ring", 0, marks=pytest.mark.slow)])
def test_two_vehicles_crash_and_stay(town: str, seed: int) -> None:
    trace, event, begins = run(load_town(town), "crash", seed)
    behind, ahead = (index(trace, name) for name in event.actors)
    touching = [
        i
        for i in range(begins, len(trace.time_s))
        if box(trace, i, behind).intersects(box(trace, i, ahead).buffer(0.05))
    ]
    assert touching
    assert speed(trace, behind)[touching[0] - 10] > 4.0  # it did not brake
    for i in range(touching[0] + 15, len(trace.time_s)):
        shared = box(trace, i, behind).intersection(box(trace, i, ahead)).area
        assert i in touching
        assert shared < 1.0
        assert speed(trace, behind)[i] < 0.05
        assert speed(trace, ahead)[i] < 0.05


@pytest.mark.slow
def test_near_a_position_only() -> None:
    town = load_town("suburb")
    trace, event, begins = run(town, "pedestrian_behind_van", 2, position=(0.0, 5.0), until_s=110.0)
    ego = trace.position[begins, index(trace, event.actors[0]), :2]
    assert np.hypot(*(ego - (0.0, 5.0))) < 53.0


def test_the_same_seed_the_same_accident_and_traffic_before_it_untouched() -> None:
    town = load_town("suburb")
    times_s = np.array([40.0, 44.0, 60.0])
    calm = simulate(town, seed=1, cavs=3, times_s=times_s)
    scenario = Scenario(kind="crash", at_s=45.0)
    one, other = (simulate(town, seed=1, cavs=3, times_s=times_s, scenarios=[scenario]) for _ in range(2))
    np.testing.assert_array_equal(one.position, other.position)
    assert one.events
    assert one.events == other.events
    np.testing.assert_array_equal(one.position[:2], calm.position[:2])
    assert not np.array_equal(one.position[2], calm.position[2], equal_nan=True)


@pytest.mark.slow
def test_every_kind_happens_in_every_scene_of_the_recipe() -> None:
    recipe = read_config(Recipe, RECIPES / "corner_cases.yaml")
    assert {scenario.kind for scenario in recipe.scenarios} == set(SCRIPTS)
    source = EmbeddedSource(recipe)
    for scene in source.scenes():
        assert {event.kind for event in source.trace(scene).events} == set(SCRIPTS), scene


def test_what_cannot_happen_is_named() -> None:
    with pytest.raises(InputError, match="suburb has no traffic lights"):
        run(load_town("suburb"), "red_light_runner", 0)
    with pytest.raises(ValidationError, match=r"unknown 'van\.lorry'"):
        Scenario(kind="pedestrian_behind_van", at_s=1.0, actors={"van": "van.lorry"})
    with pytest.raises(ValidationError, match="unknown role 'dog'"):
        Scenario(kind="pedestrian_behind_van", at_s=1.0, actors={"dog": "pedestrian.child"})

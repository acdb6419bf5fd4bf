"""A live world: vehicles under control among the traffic of SUMO."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields

import numpy as np
import pytest
import shapely

from flcav.config import InputError
from flcav.geometry import heading_vectors
from flcav.sensors.observe import observe
from flcav.sensors.rig import lidar32
from flcav.world.commands import (
    Command,
    Controls,
    Drive,
    FreezeLights,
    Place,
    Push,
    Remove,
    SetLight,
    Simulate,
    Spawn,
    Walk,
)
from flcav.world.live import LiveStep, LiveWorld, Obstructed, Settings, replay
from flcav.world.map.relief import Deck, Relief
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import Town, load_town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot, join_snapshots
from flcav.world.traffic.live import read_light_programs
from flcav.world.traffic.traffic import simulate

EMPTY = Settings()
BUSY = Settings(seed=3, traffic=12, pedestrians=4, dt_s=0.1)


def content(snapshot: Snapshot) -> tuple[bytes, ...]:
    """Return all bytes of a snapshot's trace, and its other fields."""
    arrays = [getattr(snapshot.trace, field.name) for field in fields(snapshot.trace)]
    raw = tuple(a.tobytes() if isinstance(a, np.ndarray) else repr(a).encode() for a in arrays)
    return (*raw, repr((snapshot.step, snapshot.time_s, dict(snapshot.controls), snapshot.collisions)).encode())


def place(snapshot: Snapshot, name: str) -> np.ndarray:
    return snapshot.trace.position[0, snapshot.row(name)]


def speed(snapshot: Snapshot, name: str) -> float:
    return float(np.linalg.norm(snapshot.trace.velocity[0, snapshot.row(name)]))


def run(world: LiveWorld, steps: int, controls: Controls | None = None, dt_s: float | None = None) -> Snapshot:
    """Return a world after so many steps, in which "ego" has these controls."""
    for _ in range(steps):
        world.step({} if controls is None else {"ego": controls}, dt_s=dt_s)
    return world.snapshot


@pytest.fixture
def road(small_town: Callable[..., Town]) -> Iterator[LiveWorld]:
    """A straight road along x with a wall across it at x = 40 m, and one lamp."""
    wall = np.array([[45.0, 0.0, 0.0, 10.0, 20.0, 5.0]])
    with LiveWorld(small_town(buildings=wall, lamps=np.array([[-20.0, 5.0, 6.0]])), EMPTY) as world:
        yield world


def test_a_vehicle_drives_and_keeps_its_controls(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
    assert place(road.snapshot, "ego").tolist() == [0, 0, 0]
    first = road.step({"ego": Controls(throttle=1.0)})
    last = run(road, 19)
    assert last.controls["ego"] == Controls(throttle=1.0)
    assert (last.step, last.time_s) == (20, 1.0)
    pull = road.bodies.find("ego").blueprint
    assert speed(last, "ego") == pytest.approx(pull.engine_n / pull.mass_kg - 0.147, rel=0.01)
    assert last.trace.acceleration[0, 0, 0] == pytest.approx(speed(last, "ego"), rel=0.01)
    assert place(first, "ego")[0] < 0.01 < 1.5 < place(last, "ego")[0]  # the first snapshot is as it was


def test_snapshots_cannot_be_written(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
    snapshot = road.step()
    with pytest.raises(ValueError, match="read-only"):
        snapshot.trace.position[0, 0, 0] = 1.0
    with pytest.raises(AttributeError):
        snapshot.step = 3  # type: ignore[misc]
    with pytest.raises(KeyError):
        snapshot.row("nobody")


def test_a_wall_stops_a_vehicle_and_is_named(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 30.0, 0.0))
    road.apply(Push("ego", (12.0, 0.0, 0.0)))
    hits = [hit for _ in range(40) for hit in road.step().collisions]
    assert {(hit.name, hit.other) for hit in hits} == {("ego", "building:0")}
    mass = road.bodies.find("ego").blueprint.mass_kg
    assert hits[0].impulse == (pytest.approx(-1.1 * 12 * mass, rel=0.02), pytest.approx(0, abs=1e-6))
    assert hits[0].point[0] == pytest.approx(40.0, abs=0.7)
    assert place(road.snapshot, "ego")[0] <= 40.0 - 4.7 / 2


def test_a_car_hits_a_walker_and_drives_on(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
    road.apply(Spawn("walker", "pedestrian", 0, 6.0, 0.0))
    road.apply(Push("ego", (15.0, 0.0, 0.0)))
    hits = [hit for _ in range(20) for hit in road.step().collisions]
    assert {(hit.name, hit.other) for hit in hits} == {("ego", "walker")}
    assert -1400 < hits[0].impulse[0] < -1000  # 75 kg times somewhat more than 15 m/s
    assert speed(road.snapshot, "ego") > 12
    assert place(road.snapshot, "walker")[0] > place(road.snapshot, "ego")[0] + 4.7 / 2


def test_a_car_pushes_another_one(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
    road.apply(Spawn("other", "car", 3, 10.0, 0.3))
    road.apply(Push("ego", (10.0, 0.0, 0.0)))
    hits = [hit for _ in range(20) for hit in road.step().collisions]
    assert {(hit.name, hit.other) for hit in hits} == {("ego", "other")}
    assert place(road.snapshot, "other")[0] > 12
    assert 2 < speed(road.snapshot, "other") < 6


@pytest.mark.parametrize("speed_mps", [5.0, 20.0, 25.0, 50.0, 90.0])
@pytest.mark.parametrize("aside", [0.0, 1.0])
def test_fast_cars_do_not_pass_through_each_other(speed_mps: float, aside: float, road: LiveWorld):
    """Of equal cars that meet head-on the impulse is mass times speed, and a tenth of the speed is left."""
    gap = 30.0
    for name, x, y, yaw, way in (("a", 0.0, 0.0, 0.0, 1.0), ("b", gap, aside, np.pi, -1.0)):
        road.apply(Spawn(name, "car", 3, x, y, yaw, anywhere=True))
        road.apply(Push(name, (way * speed_mps, 0.0, 0.0)))
    mass = road.bodies.find("a").blueprint.mass_kg
    impulse, snapshot = 0.0, road.snapshot
    for _ in range(int(gap / 2 / speed_mps / 0.05) + 4):
        snapshot = road.step()
        impulse += sum(abs(each.impulse[0]) for each in snapshot.collisions)
    assert place(snapshot, "a")[0] < place(snapshot, "b")[0]
    met = speed_mps - 0.5 * gap / speed_mps * 0.3  # about; less by drag and rolling
    if aside == 0:
        assert impulse == pytest.approx(1.1 * mass * met, rel=0.2)
        assert speed(snapshot, "a") < 0.2 * speed_mps
    assert impulse > 0.4 * mass * speed_mps  # they turn where they do not meet in the middle


def test_a_car_drives_over_what_is_low(road: LiveWorld):
    for name, height, stops in (("debris", 0.1, False), ("block", 0.3, True)):
        road.apply(Spawn(name, "prop", 6, 15.0, 0.0, 0.0, 0.0, (1.6, 1.2, height), anywhere=True))
        road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
        road.apply(Push("ego", (10.0, 0.0, 0.0)))
        snapshot = run(road, 40, Controls(throttle=0.5))
        assert (place(snapshot, "ego")[0] < 15.0) == stops
        for each in ("ego", name):
            road.apply(Remove(each))


def test_a_walker_who_is_hit_falls_and_slides_to_rest(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
    road.apply(Spawn("walker", "pedestrian", 0, 8.0, 0.0))
    road.apply(Push("ego", (15.0, 0.0, 0.0)))
    hit = next(snapshot for snapshot in (road.step() for _ in range(20)) if snapshot.collisions)
    road.apply(Remove("ego"))
    thrown, begun = speed(hit, "walker"), place(hit, "walker")[0]
    assert 10.0 < thrown < 20.0
    snapshot = run(road, 100)
    row = snapshot.row("walker")
    assert speed(snapshot, "walker") == 0.0
    assert place(snapshot, "walker")[0] - begun == pytest.approx(thrown**2 / 2 / (0.7 * 9.81), rel=0.1)
    assert snapshot.trace.tilts(0)[row] == pytest.approx((np.pi / 2, 0.0))
    assert snapshot.trace.yaw[0, row] == pytest.approx(0.0, abs=0.1)
    assert snapshot.trace.position[0, row, 2] == pytest.approx(snapshot.trace.size[row, 0] / 2)
    road.apply(Place("walker", 30.0, 0.0, 0.0))
    assert not run(road, 2).trace.tilts(0)[0].any()


def test_walkers_walk_and_turn(road: LiveWorld):
    road.apply(Spawn("walker", "pedestrian", 0, 0.0, 5.0))
    road.apply(Walk("walker", (0.0, 1.5)))
    snapshot = run(road, 40)
    np.testing.assert_allclose(place(snapshot, "walker"), (0.0, 7.925, 0.12), atol=1e-6)  # up on the sidewalk
    assert snapshot.trace.yaw[0, 0] == pytest.approx(np.pi / 2)
    assert speed(snapshot, "walker") == pytest.approx(1.5)


def test_puppets_stay_where_they_are_placed_and_are_hit(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
    road.apply(Spawn("puppet", "bus", 0, 20.0, 0.0))
    road.apply(Simulate("puppet", physics=False))
    road.apply(Place("puppet", 21.0, 0.0, 0.1, z=0.5, pitch=0.02, roll=-0.01))
    road.apply(Push("puppet", (3.0, 0.0, 0.0), yaw_rate=0.2))
    road.apply(Push("ego", (15.0, 0.0, 0.0)))
    hits = [hit for _ in range(40) for hit in road.step().collisions]
    assert {(hit.name, hit.other) for hit in hits} == {("ego", "puppet")}
    snapshot = road.snapshot
    row = snapshot.row("puppet")
    assert place(snapshot, "puppet").tolist() == [21.0, 0.0, 0.5]
    assert snapshot.trace.tilts(0)[row].tolist() == [0.02, -0.01]
    assert snapshot.trace.velocity[0, row].tolist() == [3.0, 0.0, 0.0]
    assert snapshot.trace.yaw_rate[0, row] == 0.2


def test_a_place_that_is_taken_is_refused(road: LiveWorld):
    road.apply(Spawn("ego", "car", 3, 0.0, 0.0))
    for spawn, taken in (
        (Spawn("b", "car", 0, 3.0, 0.5), "ego"),
        (Spawn("c", "bus", 0, 38.0, 0.0), "building:0"),
        (Spawn("d", "prop", 0, -20.0, 5.0), "lamp:0"),
    ):
        assert road.find_obstruction(spawn) == taken
        with pytest.raises(Obstructed, match=taken):
            road.apply(spawn)
    road.apply(Spawn("b", "car", 0, 3.0, 0.5, anywhere=True))
    road.apply(Remove("ego"))
    assert road.snapshot.trace.actor.tolist() == ["b"]
    assert road.history == [Spawn("ego", "car", 3, 0, 0), Spawn("b", "car", 0, 3.0, 0.5, anywhere=True), Remove("ego")]


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (Spawn("veh3", "car", 3, 0, 0), "name 'veh3': must not be empty, nor begin with veh, ped, parked"),
        (Spawn("a", "tank", 0, 0, 0), "category 'tank': must be one of car, van"),
        (Spawn("a", "car", 99, 0, 0), "shape 99: category 'car' has the shapes 0 to 11"),
        (Spawn("a", "car", 3, float("nan"), 0), "nan: must be a number"),
        (Spawn("a", "car", 3, 0, 0, size=(0.0, 1.0, 1.0)), "size 0.0, 1.0, 1.0: must be between"),
        (Spawn("walker", "car", 3, 9, 9), "name 'walker': another actor has it"),
        (Remove("nobody"), "actor 'nobody': there is none of this name"),
        (Drive("walker", Controls()), "actor 'walker': is no vehicle, but a pedestrian"),
        (SetLight("x", "GG"), "light 'x': the town has no such junction"),
        (Push("walker", (np.inf, 0, 0)), "inf: must be a number"),
    ],
)
def test_bad_commands_are_refused_and_change_nothing(road: LiveWorld, command: Command, told: str):
    road.apply(Spawn("walker", "pedestrian", 0, 0.0, 5.0))
    before = content(road.snapshot)
    with pytest.raises(InputError) as refused:
        road.apply(command)
    assert told in str(refused.value)
    assert content(road.snapshot) == before
    assert len(road.history) == 1


def test_bad_settings_are_refused():
    with pytest.raises(InputError, match="dt_s = 0"):
        LiveWorld(load_town("suburb"), Settings(dt_s=0))
    with pytest.raises(InputError, match="traffic = -1"):
        LiveWorld(load_town("suburb"), Settings(traffic=-1))


def test_no_two_boxes_interpenetrate(small_town: Callable[..., Town]):
    random = np.random.default_rng(0)
    walls = np.array([[0, 20.0, 0, 50, 2, 3], [0, -20, 0, 50, 2, 3], [20, 0, 0, 2, 50, 3], [-20, 0, 0, 2, 50, 3]])
    kinds = ("car", "truck", "motorcycle", "pedestrian", "van", "bicycle", "prop")
    with LiveWorld(small_town(buildings=walls), EMPTY) as world:
        for number in range(60):
            x, y, yaw = random.uniform((-18, -18, -3), (18, 18, 3)).tolist()
            spawn = Spawn(f"a{number}", kinds[number % 7], 0, x, y, yaw)
            if not world.find_obstruction(spawn):
                world.apply(spawn)
        for step in range(300):
            for body in world.bodies.members:
                if step % 30 == 0 and body.category == "pedestrian":
                    world.apply(Walk(body.name, tuple(random.uniform(-3, 3, 2))))
                elif step % 30 == 0 and body.category != "prop":
                    world.apply(
                        Drive(body.name, Controls(1.0, random.uniform(-1, 1), reverse=bool(random.random() < 0.4)))
                    )
            trace = world.step().trace
            shapes = [
                make_footprint(*at, *size)
                for at, size in zip(np.c_[trace.position[0, :, :2], trace.yaw[0]], trace.size[:, :2])
            ]
            shapes = np.array([*shapes, *(make_footprint(*wall[:5]) for wall in walls)])
            first, second = shapely.STRtree(shapes).query(shapes, "intersects")
            rows = (first < second) & (first < len(trace.actor))
            assert (
                not rows.any() or shapely.area(shapely.intersection(shapes[first], shapes[second]))[rows].max() < 1e-9
            )
        assert len(world.bodies.members) > 30


def test_a_longer_step_is_several_short_ones(road: LiveWorld, small_town: Callable[..., Town]):
    with LiveWorld(road.town, EMPTY) as other:
        for world, dt_s, steps in ((road, 0.05, 20), (other, 0.5, 2)):
            world.apply(Spawn("ego", "car", 3, 0.0, 0.0))
            assert run(world, steps, Controls(0.5, 0.1), dt_s).time_s == 1.0
        np.testing.assert_allclose(place(other.snapshot, "ego"), place(road.snapshot, "ego"), atol=1e-9)


def test_a_vehicle_stands_on_slopes():
    town = load_town("hilly_suburb")
    assert town.relief is not None
    with LiveWorld(town, Settings(parked=False)) as world:
        steep = max(np.linspace(-100, 100, 41), key=lambda x: abs(town.ground(x + 1, 0) - town.ground(x - 1, 0)))
        world.apply(Spawn("ego", "car", 3, float(steep), 0.0, anywhere=True))
        trace = world.step({"ego": Controls(brake=1.0)}).trace
        assert trace.tilt is not None
        assert trace.position[0, 0, 2] == pytest.approx(town.ground(steep, 0), abs=0.1)
        rise = (town.ground(steep + 1.4, 0) - town.ground(steep - 1.4, 0)) / 2.8
        assert trace.tilt[0, 0, 0] == pytest.approx(-rise, abs=0.01)
        assert abs(trace.tilt[0, 0, 0]) > 0.02


def test_who_is_placed_above_the_ground_falls_and_who_is_below_it_stays(road: LiveWorld):
    for name, z in {"up": 50.0, "under": -500.0, "low": 2.0}.items():
        road.apply(Spawn(name, "car", 0, 0.0, 0.0, 0.0, z))
    assert road.bodies.find_grounded().tolist() == [False, False, True]  # whom traffic sees
    snapshot = run(road, 40)
    fallen = 9.81 * 2.0**2 / 2
    assert abs(place(snapshot, "up")[2] - (50.0 - fallen)) < 0.05 * 9.81 * 2.0  # a step's worth of speed
    assert place(snapshot, "under")[2] == -500.0
    assert place(snapshot, "low")[2] == 0.0
    road.apply(Remove("low"))
    snapshot = run(road, 40)
    assert place(snapshot, "up")[2] == 0.0
    assert not snapshot.trace.velocity[0, snapshot.row("up")].any()


def test_a_hidden_puppet_comes_back_when_it_is_placed_on_the_road(road: LiveWorld):
    road.apply(Spawn("ego", "car", 0, 0.0, 0.0, 0.0, -500.0))
    road.apply(Simulate("ego", physics=False))
    assert place(run(road, 5), "ego")[2] == -500.0
    road.apply(Simulate("ego"))
    assert place(run(road, 5), "ego")[2] == -500.0
    road.apply(Place("ego", 10.0, 0.0, 0.0, 0.3))
    assert speed(run(road, 20, Controls(throttle=1.0)), "ego") > 3.0


def test_a_world_may_have_no_history(small_town: Callable[..., Town]):
    with LiveWorld(small_town(), Settings(remembers=False)) as world:
        world.apply(Spawn("ego", "car", 3, 0.0, 0.0))
        run(world, 5, Controls(0.5))
        assert not world.history


def test_a_vehicle_on_a_bridge_stays_on_it_and_one_below_below(small_town: Callable[..., Town]):
    ground = np.array([(x, y, 0.0) for x in (-60, 60) for y in (-60, 60)], np.float64)
    deck = Deck([np.array([(x, -4.0, 6.0), (x, 4.0, 6.0)]) for x in np.linspace(-30.0, 30.0, 7)])
    with LiveWorld(small_town(relief=Relief(ground, [deck])), EMPTY) as world:
        world.apply(Spawn("over", "car", 3, -20.0, 0.0, z=5.0))
        world.apply(Spawn("under", "car", 3, 0.0, -10.0, np.pi / 2, z=0.0))
        for name, velocity in (("over", (8.0, 0.0, 0.0)), ("under", (0.0, 8.0, 0.0))):
            world.apply(Push(name, velocity))
        for _ in range(40):
            now = world.step({"over": Controls(0.2), "under": Controls(0.2)})
            assert not now.collisions
            assert place(now, "over")[2] == pytest.approx(6.0)
            assert place(now, "under")[2] == pytest.approx(0.0)
        assert place(world.snapshot, "under")[1] > 4.0
        assert (world.height(0.0, 0.0), world.height(0.0, 0.0, 4.0)) == (0.0, pytest.approx(6.0))


def drive_along(world: LiveWorld, steps: int, random: np.random.Generator) -> list[Snapshot]:
    out = []
    for step in range(steps):
        out.append(world.step({"ego": Controls(random.uniform(0, 1), random.uniform(-0.1, 0.1))}))
        if step == 20:
            world.apply(Spawn("walker", "pedestrian", 1, *place(out[-1], "ego")[:2] + 8.0, anywhere=True))
            world.apply(Walk("walker", (1.0, 0.5)))
    return out


def test_the_same_commands_give_the_same_bytes_and_a_fork_goes_on_alike():
    town = load_town("grid")
    with LiveWorld(town, BUSY) as world:
        world.apply(Spawn("ego", "car", 3, -60.0, -120.0, 0.4, anywhere=True))
        whole = drive_along(world, 40, np.random.default_rng(1))
        history, end = list(world.history), drive_along(world, 10, np.random.default_rng(2))
    with replay(town, BUSY, history) as fork:
        assert content(fork.snapshot) == content(whole[-1])
        assert [content(each) for each in drive_along(fork, 10, np.random.default_rng(2))] == [content(e) for e in end]
    with replay(town, Settings(seed=4, traffic=12, pedestrians=4, dt_s=0.1), history) as other:
        assert content(other.snapshot) != content(whole[-1])
    assert sum(isinstance(entry, LiveStep) for entry in history) == 40


def test_traffic_brakes_for_what_stands_in_its_way():
    with LiveWorld(load_town("grid"), Settings(seed=3, traffic=40)) as world:
        trace, found = world.snapshot.trace, np.zeros(0, np.int64)
        while not len(found):
            trace = world.step().trace
            fast = np.linalg.norm(trace.velocity[0], axis=1) > 8
            found = np.flatnonzero((trace.category == "car") & fast & (np.abs(trace.yaw_rate[0]) < 0.01))
        row, name = found[0], str(trace.actor[found[0]])
        ahead = heading_vectors(trace.yaw[0, row])
        x, y = trace.position[0, row, :2] + 35 * ahead
        world.apply(Spawn("walker", "pedestrian", 0, x, y, anywhere=True))
        distances = []
        for _ in range(160):
            snapshot = world.step()
            distances.append((place(snapshot, "walker") - place(snapshot, name))[:2] @ ahead)
            assert not snapshot.collisions
        assert speed(world.snapshot, name) < 0.3
        assert 2.3 < min(distances) < 12
        world.apply(Remove("walker"))
        assert speed(run(world, 60), name) > 2


def test_traffic_that_is_removed_is_gone_and_nobody_sets_out_in_its_place():
    with LiveWorld(load_town("grid"), BUSY) as world:
        before = [name for name in run(world, 5).trace.actor.tolist() if not name.startswith("parked")]
        gone = [next(name for name in before if name.startswith(kind)) for kind in ("veh", "ped")]
        for name in gone:
            world.apply(Remove(name))
            assert name not in world.snapshot.trace.actor
        moved = {name: place(world.snapshot, name) for name in before if name not in gone}
        after = run(world, 40)
        left = [name for name in after.trace.actor.tolist() if not name.startswith("parked")]
        assert sorted(left) == sorted(moved)
        assert max(float(np.linalg.norm(place(after, name) - begun)) for name, begun in moved.items()) > 3
        with replay(world.town, BUSY, world.history) as again:
            assert content(again.snapshot) == content(after)
        with pytest.raises(InputError, match="there is none of this name"):
            world.apply(Remove(gone[0]))


def test_lights_are_those_of_sumo():
    town = load_town("grid")
    times = np.arange(1, 1200, 7) / 10
    trace = simulate(town, seed=1, cavs=0, times_s=times)
    programs = read_light_programs(town.net)
    own = [[letter for each in programs for letter in each.at(time_s - 0.1)] for time_s in times]
    names = [f"{each.junction}:{i}" for each in programs for i in range(len(each.states[0]))]
    order = [names.index(name) for name in trace.light.tolist()]
    np.testing.assert_array_equal(np.array(own)[:, order], trace.light_state)


def test_lights_can_be_set_and_frozen():
    with LiveWorld(load_town("grid"), EMPTY) as world:
        before = world.snapshot.trace
        junction = str(before.light[0]).partition(":")[0]
        count = sum(str(name).startswith(f"{junction}:") for name in before.light)
        world.apply(SetLight(junction, "y" * count))
        world.apply(FreezeLights(True))
        after = run(world, 100, dt_s=1.0).trace
        rest = [not str(name).startswith(f"{junction}:") for name in before.light]
        assert (after.light_state[0, rest] == before.light_state[0, rest]).all()
        assert after.light_state[0, np.invert(rest)].tolist() == ["y"] * count
        with pytest.raises(InputError, match=rf"must be {count} of the letters"):
            world.apply(SetLight(junction, "GG?"))
        world.apply(FreezeLights(False))
        world.apply(SetLight(junction, None))
        seen = {world.step(dt_s=1.0).trace.light_state[0].tobytes() for _ in range(90)}
        assert len(seen) > 4


def test_a_scene_follows_snapshots_and_frames_are_those_of_a_recording():
    town = load_town("suburb")
    with LiveWorld(town, BUSY) as world:
        world.apply(Spawn("ego", "car", 3, 0.0, 0.0, anywhere=True))
        scene, snapshots, live = Scene(town, world.snapshot.trace), [], []
        for step in range(6):
            snapshots.append(world.step({"ego": Controls(0.5)}))
            if step == 3:
                world.apply(Spawn("wall", "prop", 9, 15.0, 0.0, 1.5, anywhere=True))
                world.apply(Spawn("bus", "bus", 0, -12.0, 1.0, anywhere=True))
            scene.follow(snapshots[-1].trace)
            number = snapshots[-1].step
            live.append(observe(scene, lidar32(), "ego", 0, scene_name="live", seed=1, number=number))
    trace = join_snapshots(snapshots)
    assert trace.present[:, -2:].any(axis=1).tolist() == [False] * 4 + [True] * 2
    recorded = Scene(town, trace)
    for index, frame in enumerate(live):
        again = observe(recorded, lidar32(), "ego", index, scene_name="live", seed=1, number=index + 1)
        np.testing.assert_array_equal(frame.lidar["lidar"], again.lidar["lidar"])
        np.testing.assert_array_equal(frame.world_from_agent, again.world_from_agent)
        assert sorted(frame.annotations.track.tolist()) == sorted(again.annotations.track.tolist())
        assert frame.key == again.key
        assert "wall" not in frame.annotations.track
    assert len(live[-1].lidar["lidar"]) > 1000


@pytest.mark.slow
def test_the_sumo_process_ends_with_the_one_that_started_it():
    code = (
        "from flcav import load_town\n"
        "from flcav.world.live import LiveWorld, Settings\n"
        "world = LiveWorld(load_town('suburb'), Settings(traffic=2))\n"
        "world.step()\n"
        "print(world._traffic._sumo._process.pid, flush=True)\n"
        "import time; time.sleep(600)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    child = int(process.stdout.readline())
    assert _runs(child)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    until = time.monotonic() + 20
    while _runs(child) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _runs(child)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_closed_world_makes_no_steps_and_worlds_can_be_open_together():
    town = load_town("suburb")
    with LiveWorld(town, BUSY) as first, LiveWorld(town, BUSY) as second:
        for _ in range(5):
            assert content(first.step()) == content(second.step())
    for _ in range(2):
        with pytest.raises(RuntimeError, match="closed"):
            first.step()
    with LiveWorld(town, BUSY) as third:
        assert content(third.snapshot) != content(first.snapshot)


def test_a_failure_of_sumo_is_told(monkeypatch: pytest.MonkeyPatch):
    world = LiveWorld(load_town("suburb"), BUSY)
    traffic = world._traffic
    assert traffic is not None
    traffic._lights = {}
    monkeypatch.setattr(world.lights, "states", lambda: {"nowhere": "GG"})
    with pytest.raises(RuntimeError, match=r"SUMO failed: .*nowhere"):
        world.step(dt_s=0.2)
    world.close()

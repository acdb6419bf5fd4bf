"""Closed-loop driving: the driver, the corridor, who is at fault, and what is left without a task."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.affinity import rotate as turn
from shapely.affinity import translate

from flcav.config import InputError
from flcav.driving.driver import (
    EMERGENCY_MPS2,
    GAIN_MPS2,
    DriverSettings,
    EgoMotion,
    _cover,
    decide_controls,
    find_meeting,
    find_occupied,
)
from flcav.driving.jobs import DriveJob, Sensed, run_job
from flcav.driving.loop import LOOP
from flcav.driving.measures import (
    DriveResult,
    Hit,
    describe_drives,
    judge_collision,
    list_penalties,
    name_cause,
    score_drive,
)
from flcav.driving.scenarios import find_scenarios, list_scenarios, spread_scenarios
from flcav.driving.seen import TASKS, TIMES_S, Perception, Seen, leave_out, predict_motion
from flcav.driving.studies.importance import compare_drives, kendall, weigh
from flcav.geometry import Boxes
from flcav.world.dynamics.vehicle import make_blueprint
from flcav.world.map.roads import Route
from flcav.world.snapshot import Collision, Snapshot
from flcav.world.trace import empty_trace

CAR = make_blueprint("car", 3)
HALF_M = CAR.size[0] / 2


def straight(stop: tuple[tuple[float, str], ...] = ()) -> Route:
    along = np.linspace(0.0, 300.0, 301)
    return Route(np.stack((along, np.zeros_like(along)), axis=1), along, np.full(301, 13.9), stop, np.full(301, 3.5))


def see(*rows: tuple[float, float, float, float, float], closed: str = "", amber: bool = False) -> Seen:
    """Return road users x, y, yaw, velocity x, y [m, rad, m/s], all of a car's size."""
    array = np.array(rows, np.float64).reshape(-1, 5)
    boxes = Boxes.from_array(np.c_[array[:, :2], np.full((len(array), 4), (0.8, 4.5, 1.8, 1.6)), array[:, 2]], "Car")
    path, yaw = predict_motion(boxes, array[:, 3:])
    links = frozenset((closed,)) if closed else frozenset[str]()
    return Seen(boxes, array[:, 3:], path, yaw, np.zeros(yaw.shape), links, links if amber else frozenset())


def at(along: float, speed: float) -> EgoMotion:
    return EgoMotion(along, 0.0, 0.0, speed, along)


def test_free_road_is_driven_at_the_limit() -> None:
    assert decide_controls(straight(), at(20.0, 0.0), see(), CAR).acceleration > 1.5
    assert abs(decide_controls(straight(), at(20.0, 13.9), see(), CAR).acceleration) < 0.1
    slower = replace(see(), speed_share=0.6)
    assert decide_controls(straight(), at(20.0, 13.9), slower, CAR).acceleration < -1.0


def test_a_leader_is_followed_at_the_equilibrium_of_the_model() -> None:
    speed, wanted = 10.0, 13.9
    gap = (2.0 + 1.2 * speed) / np.sqrt(1 - (speed / wanted) ** 4)  # of the paper, eq. 7
    ahead = see((50.0 + gap + HALF_M + 4.5 / 2, 0.0, 0.0, speed, 0.0))
    told = decide_controls(straight(), at(50.0, speed), ahead, CAR, DriverSettings(margin_m=0.0)).acceleration
    assert told == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("speed", [0.0, 6.0, 13.9, 16.0])
def test_a_start_covers_the_integral_of_its_speed(speed: float) -> None:
    time = np.linspace(0.0, TIMES_S[-1], 40_001)
    driven = np.minimum(speed + GAIN_MPS2 * time, max(13.9, speed))
    covered = np.concatenate(([0.0], np.cumsum((driven[1:] + driven[:-1]) / 2 * np.diff(time))))
    np.testing.assert_allclose(_cover(speed, 13.9, GAIN_MPS2), np.interp(TIMES_S, time, covered), atol=1e-4)


@pytest.mark.parametrize("aside", [-1.5, 0.4])
@pytest.mark.parametrize("speed", [3.0, 10.0])
def test_the_wheels_follow_the_circle_through_the_point_that_is_aimed_at(aside: float, speed: float) -> None:
    told = decide_controls(straight(), EgoMotion(50.0, aside, 0.0, speed, 50.0), see(), CAR).controls.steer
    ahead, left = 3.5 + 0.35 * speed, -aside
    radius = (ahead**2 + left**2) / (2 * left)  # of the circle that leaves along the x axis and meets the point
    assert ahead**2 + (left - radius) ** 2 == pytest.approx(radius**2)
    assert np.tan(told * CAR.steer_limit_rad) == pytest.approx(CAR.wheelbase_m / radius)


def test_red_and_yellow_lights() -> None:
    route = straight(((100.0, "x:1"),))
    for along, amber, brakes in ((60.0, False, True), (60.0, True, True), (90.0, True, False), (70.0, False, True)):
        told = decide_controls(route, at(along, 10.0), see(closed="x:1", amber=amber), CAR)
        assert (told.acceleration < -0.5) == brakes, (along, amber)
    assert decide_controls(route, at(60.0, 10.0), see(closed="other:1"), CAR).acceleration > 0


def test_who_crosses_is_let_pass_and_an_emergency_is_one() -> None:
    crossing = see((75.0, -20.0, np.pi / 2, 0.0, 7.0))  # at the corridor when the vehicle is
    told = decide_controls(straight(), at(40.0, 12.0), crossing, CAR)
    assert told.acceleration < -0.5
    near = decide_controls(straight(), at(61.0, 12.0), see((75.0, -6.0, np.pi / 2, 0.0, 7.0)), CAR)
    assert near.emergency
    assert near.controls.brake == 1.0
    assert near.acceleration < -EMERGENCY_MPS2
    gone = decide_controls(straight(), at(40.0, 12.0), see((75.0, 20.0, np.pi / 2, 0.0, 7.0)), CAR)
    assert gone.acceleration > 0


def test_a_wider_margin_and_uncertainty_brake_for_who_is_beside() -> None:
    beside = see((60.0, 2.6, 0.0, 0.0, 0.0))  # 0.8 m from the side of the vehicle
    narrow, wide = (decide_controls(straight(), at(40.0, 10.0), beside, CAR, DriverSettings(m)) for m in (0.2, 1.2))
    assert narrow.acceleration > 0 > wide.acceleration
    unsure = replace(beside, spread=np.full(beside.spread.shape, 0.6))
    assert decide_controls(straight(), at(40.0, 10.0), unsure, CAR, DriverSettings(0.0, 2.0)).acceleration < 0
    assert decide_controls(straight(), at(40.0, 10.0), unsure, CAR, DriverSettings(0.0, 0.5)).acceleration > 0


def test_the_corridor_agrees_with_polygons() -> None:
    random = np.random.default_rng(3)
    rows = np.c_[random.uniform(0, 70, 200), random.uniform(-5, 5, 200), random.uniform(-3, 3, 200)]
    boxes = Boxes.from_array(np.c_[rows[:, :2], np.full((200, 4), (0.8, 4.5, 1.8, 1.6)), rows[:, 2]], "Car")
    path, yaw = predict_motion(boxes, np.zeros((200, 2)))
    found = find_occupied(straight(), 10.0, boxes, path, yaw, 0.9, np.zeros(yaw.shape))
    strip = shapely.box(4.0, -0.9, 89.0, 0.9)
    off = []
    for row, (x, y, angle) in enumerate(rows):
        body = translate(turn(shapely.box(-2.25, -0.9, 2.25, 0.9), angle, use_radians=True, origin=(0, 0)), x, y)
        shared = body.intersection(strip)
        if shared.area > 0.3 and x > 13:
            assert np.isfinite(found.low[row, 0]), (x, y, angle)
            off.append(found.low[row, 0] - (shared.bounds[0] - 10.0))
        if shared.is_empty and body.distance(strip) > 0.05:
            assert not np.isfinite(found.low[row, 0]), (x, y, angle)
    assert len(off) > 40
    assert np.max(np.abs(off)) < 1.3  # the spacing of the points of a footprint


@pytest.mark.parametrize(("ahead", "within"), [(-4.0, True), (-12.0, False), (76.0, True), (85.0, False)])
def test_the_corridor_reaches_from_6_m_behind_to_80_m_ahead(ahead: float, within: bool) -> None:
    there = see((100.0 + ahead, 0.0, 0.0, 0.0, 0.0))
    found = find_occupied(straight(), 100.0, there.boxes, there.path, there.yaw, 0.9, np.zeros(there.yaw.shape))
    assert np.isfinite(found.low[0, 0]) == within
    if within:
        assert found.low[0, 0] == pytest.approx(max(ahead - 4.5 / 2, -6.0), abs=1.0)


def test_meeting_needs_the_same_place_at_the_same_time() -> None:
    crossing = see((40.0, -7.0 * 2, np.pi / 2, 0.0, 7.0))
    zero = np.zeros(crossing.yaw.shape)
    occupied = find_occupied(straight(), 20.0, crossing.boxes, crossing.path, crossing.yaw, 0.9, zero)
    assert find_meeting(occupied, 10.0 * TIMES_S, 2.0).any()  # both at 2 s
    assert not find_meeting(occupied, 2.0 * TIMES_S, 2.0).any()


@pytest.mark.parametrize("task", TASKS)
def test_what_is_left_without_a_task(task: str) -> None:
    whole = replace(see((50.0, 0.0, 0.0, 5.0, 0.0), closed="x:1"), speed_share=0.6)
    bare, cautious = (leave_out(whole, task, c) for c in ("bare", "cautious"))
    assert (len(bare.boxes) == 0) == (task == "objects")
    assert (not bare.closed) == (task == "signs")
    assert (bare.speed_share == 1.0) == (task == "weather")
    if task == "trajectory":
        assert (bare.path == bare.path[:, :1]).all()
        assert not (cautious.path == cautious.path[:, :1]).all()
    assert cautious.speed_share <= 0.6


def test_score_and_faults() -> None:
    hit = Hit(1.0, "tree:3", "obstacle", 5.0, True)
    assert score_drive(0.8, [hit], 1) == pytest.approx(0.8 * 0.5 * 0.7)
    assert score_drive(0.8, [replace(hit, kind="pedestrian")], 0) == 0.0
    assert score_drive(0.8, [replace(hit, at_fault=False)], 0) == pytest.approx(0.8)


def test_every_infraction_is_in_the_line_in_the_summary_and_in_the_score() -> None:
    walker = Hit(9.0, "walker", "pedestrian", 5.0, True)
    tree, rammed = Hit(3.0, "tree:3", "obstacle", 5.0, True), Hit(4.0, "veh1", "vehicle", 5.0, False)
    hits = (tree, rammed)
    own = DriveResult("s", 2, 20.0, 0.65, 5.0, 4.0, 0.0, 1, 2, hits, 0.65 * 0.5 * 0.49, list_penalties(hits, 2))
    assert own.penalties == pytest.approx({"1 obstacle": 0.5, "2 red lights": 0.49})
    assert own.line() == (
        "s, seed 2: progress 0.65, 5.0 m/s, least time to collision 4.00 s, 1 hard brake, 2 red lights passed, hits "
        "tree:3, is hit by veh1, score 0.16 = 0.65 x 0.5 (1 obstacle) x 0.49 (2 red lights)"
    )
    assert list_penalties([walker], 0) == {"1 pedestrian": 0.0}
    stood = replace(own, red_lights=1, hits=(), stood_s={"a red light": 4.0, "an open road": 0.1})
    assert describe_drives([own, stood]) == (
        "2 drives: 1 collision at fault, 1 other, 3 red lights passed, 2 hard brakes; stood 4.1 of 40.0 s: "
        "4.0 s before a red light, 0.1 s before an open road"
    )
    assert "stood" not in replace(own, stood_s={"an open road": 0.9}).line()


@pytest.mark.parametrize(
    ("row", "light", "told"),
    [
        (0, "", "a car"),  # 2 m from where it is
        (1, "", "a false car of objects (small)"),
        (2, "", "a parked van"),
        (None, "x:1", "a red light"),
        (None, "x:0", "a green light taken for red"),
        (None, "", "an open road"),
    ],
)
def test_what_a_vehicle_stands_before_is_named_by_the_truth(row: int | None, light: str, told: str) -> None:
    names, places = ["ego", "veh1", "parked4"], [(0.0, 0.0), (12.0, 0.0), (30.0, 3.0)]
    count = len(names)
    trace = replace(
        empty_trace("grid"),
        actor=np.array(names),
        category=np.array(["car", "car", "van"]),
        position=np.pad(np.array(places), ((0, 0), (0, 1)))[None],
        velocity=np.zeros((1, count, 3)),
        light=np.array(["x:0", "x:1"]),
        light_state=np.array([["G", "r"]]),
    )
    seen = replace(see((14.0, 0, 0, 0, 0), (20.0, 0, 0, 0, 0), (30, 3, 0, 0, 0)), found_by="objects (small)")
    snapshot = Snapshot(0, 0.0, trace, {}, ())
    assert name_cause(light or row, seen, snapshot) == told


@pytest.mark.parametrize("closed", ["", "x:1"])
def test_a_decision_names_what_it_slows_for(closed: str) -> None:
    route = straight(((100.0, "x:1"),))
    near, far = (42.0, 0.0, 0.0, 0.0, 0.0), (70.0, 0.0, 0.0, 0.0, 0.0)
    assert decide_controls(route, at(20.0, 6.0), see(far, near, closed=closed), CAR).cause == 1
    assert decide_controls(route, at(84.0, 6.0), see(far, closed=closed), CAR).cause == (closed or None)


def test_unknown_scenarios_are_refused() -> None:
    assert len({each.name for each in spread_scenarios(32)}) == 32 == len(list_scenarios())
    with pytest.raises(InputError, match="flcav drive --list"):
        find_scenarios(["nowhere"])


def test_weights_are_the_scores_lost() -> None:
    def run(score: float) -> DriveResult:
        return DriveResult("s", 1, 10.0, score, 5.0, 4.0, 0.0, 0, 0, (), score)

    whole = [run(0.8), run(0.6)]
    tasks = [
        compare_drives(task, whole, [run(0.8 - lost), run(0.6 - lost)], ["a", "b"])
        for task, lost in (("objects", 0.3), ("signs", 0.1), ("weather", -0.2))
    ]
    assert [each.weight for each in weigh(tasks)] == pytest.approx([0.75, 0.25, 0.0])
    assert tasks[0].differences["score"].low == pytest.approx(-0.3)
    assert kendall([1, 2, 3, 4], [4, 3, 2, 1]) == -1.0
    assert kendall([1, 2, 3, 4], [1, 2, 4, 3]) == pytest.approx(2 / 3)


class Blind:
    """Perception that sees nobody."""

    def __init__(self, whole: Perception) -> None:
        self._whole = whole

    def look(self, snapshot: Snapshot) -> Seen:
        return leave_out(self._whole.look(snapshot), "objects", "bare")


def test_a_loop_that_sees_stops_behind_a_standing_car_and_a_blind_one_hits_it() -> None:
    """The same scenario and seed, driven by ground truth and blindly; collisions and their faults are of the world."""
    (scenario,) = find_scenarios(["suburb-stalled-clear"])
    scenario = replace(scenario, traffic=0, pedestrians=0)
    job = DriveJob(scenario, 1, loop=replace(LOOP, lasts_s=13.0))
    seeing, blind = (run_job(j, Sensed("truth")) for j in (job, replace(job, task="objects")))
    assert seeing.faults == 0
    assert blind.faults == 1
    assert blind.hits[0].other == "lead"
    assert blind.hits[0].kind == "vehicle"
    assert blind.score < seeing.score


def test_who_is_run_into_is_not_at_fault() -> None:
    from flcav.world.commands import Controls, Push, Spawn
    from flcav.world.live import LiveWorld
    from flcav.world.live import Settings as World
    from flcav.world.map.town import load_town

    def ram(own_mps: float, other_mps: float) -> Hit:
        with LiveWorld(load_town("suburb"), World(parked=False, dt_s=0.1)) as world:
            x, y, yaw = 0.0, 0.0, 0.0
            world.apply(Spawn("ego", "car", 3, x, y, yaw, anywhere=True))
            world.apply(Spawn("other", "car", 3, x + 6.0, y, yaw, anywhere=True))
            world.apply(Push("ego", (own_mps, 0.0, 0.0)))
            world.apply(Push("other", (other_mps, 0.0, 0.0)))
            before = world.snapshot
            for _ in range(40):
                now = world.step({"ego": Controls(), "other": Controls()})
                hits: list[Collision] = [c for c in now.collisions if {c.name, c.other} == {"ego", "other"}]
                if hits:
                    return judge_collision(hits[0], before, {"other": "car"}, now.time_s)
                before = now
        raise AssertionError("they do not meet")

    assert ram(8.0, 0.0).at_fault
    assert not ram(0.0, -8.0).at_fault

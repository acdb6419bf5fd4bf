"""Closed-loop simulation of perception, driver and world, in steps of 0.1 s."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flcav.driving.driver import DEFAULT, Decision, DriverSettings, EgoMotion, decide_controls
from flcav.driving.lines.passing import join_lanes
from flcav.driving.measures import (
    HARD_MPS2,
    NEAR_S,
    STANDS_MPS,
    DriveResult,
    Hit,
    judge_collision,
    list_penalties,
    measure_ttc,
    name_cause,
    score_drive,
)
from flcav.driving.scenarios import DT_S, DrivingScenario, StagedScenario
from flcav.driving.seen import EGO, Perception, Seen, TruePerception, read_lights
from flcav.geometry import heading_vectors
from flcav.world.map.roads import Route
from flcav.world.snapshot import Snapshot

LASTS_S = 30.0  # time limit of a drive
ENDS_M = 15.0  # a drive ends so far before the end of its route

Sensing = Callable[[StagedScenario, int], Perception]  # makes the perception of a drive, by its scenario and seed


@dataclass(frozen=True)
class Loop:
    """Settings of the closed loop."""

    driver: DriverSettings = DEFAULT
    lasts_s: float = LASTS_S  # time limit of a drive


LOOP = Loop()


def sense_truth(staged: StagedScenario, seed: int) -> Perception:
    """Return ground-truth perception."""
    return TruePerception(staged.scenario.weather)


Watch = Callable[[Snapshot, Seen, EgoMotion, Decision], None]  # called at every step


def drive_scenario(
    scenario: DrivingScenario,
    seed: int,
    sense: Sensing = sense_truth,
    loop: Loop = LOOP,
) -> DriveResult:
    """Run a closed-loop drive of a scenario and seed, with the perception that `sense` makes, and return its measures.

    The drive ends with a collision at fault, near the end of the route, or at its time limit. Raises `InputError` where
    the town has no room for the ego vehicle, and what the perception raises.
    """
    staged = StagedScenario(scenario, seed)
    try:
        return drive_staged(staged, seed, sense(staged, seed), loop)
    finally:
        staged.world.close()


def drive_staged(
    staged: StagedScenario, seed: int, perception: Perception, loop: Loop, watch: Watch | None = None
) -> DriveResult:
    """Run a drive through a staged scenario and return its measures; the caller closes the scenario's world."""
    world, route = staged.world, staged.route
    truth = TruePerception(staged.scenario.weather)
    body = world.bodies.find(EGO).blueprint
    size = (body.size[0], body.size[1])
    now, along = world.snapshot, staged.start_m
    lanes = join_lanes(staged.town)
    hits: list[Hit] = []
    ttc, speeds = [], []
    hard, braking, reds = 0, False, 0
    stood: Counter[str] = Counter()  # steps at standstill, by their cause
    for _ in range(round(loop.lasts_s / DT_S)):
        ego = find_motion(now, route, along)
        staged.act(ego.along, ego.speed)
        now = world.snapshot
        seen = perception.look(now)
        decision = decide_controls(route, ego, seen, body, loop.driver, lanes)
        if watch is not None:
            watch(now, seen, ego, decision)
        ttc.append(measure_ttc(route, ego, truth.look(now), size))
        before, now = now, world.step({EGO: decision.controls})
        after = find_motion(now, route, ego.along)
        slowing = (ego.speed - after.speed) / DT_S > HARD_MPS2
        hard, braking = hard + (slowing and not braking), slowing
        reds += _pass_red(route, ego, after, size[0], now)
        along = after.along
        speeds.append(after.speed)
        if after.speed < STANDS_MPS:
            stood[name_cause(decision.cause, seen, before)] += 1
        kinds = dict(zip(now.trace.actor.tolist(), now.trace.category.tolist()))
        known = {hit.other for hit in hits}
        new = [
            judge_collision(collision, before, kinds, now.time_s)
            for collision in now.collisions
            if EGO in (collision.name, collision.other)
        ]
        hits += [hit for hit in new if hit.other not in known]
        if any(hit.at_fault for hit in hits) or along > route.length_m - ENDS_M:
            break
    allowed = _allowed(route, staged.start_m, loop.lasts_s if along <= route.length_m - ENDS_M else now.time_s)
    progress = min((along - staged.start_m) / allowed, 1.0)
    times_to_collision = np.array(ttc)
    return DriveResult(
        scenario=staged.scenario.name,
        seed=seed,
        time_s=now.time_s,
        progress=progress,
        mean_speed=float(np.mean(speeds)),
        least_ttc_s=float(times_to_collision.min()),
        near_share=float((times_to_collision < NEAR_S).mean()),
        hard_brakes=hard,
        red_lights=reds,
        hits=tuple(hits),
        score=score_drive(progress, hits, reds),
        penalties=list_penalties(hits, reds),
        stood_s={cause: round(steps * DT_S, 1) for cause, steps in stood.most_common()},
    )


def find_motion(snapshot: Snapshot, route: Route, near: float) -> EgoMotion:
    """Return the motion of the ego vehicle, projected on the route near the distance `near` [m]."""
    trace, row = snapshot.trace, snapshot.row(EGO)
    x, y = trace.position[0, row, :2].tolist()
    yaw = float(trace.yaw[0, row])
    along, _ = route.project(x, y, near)
    return EgoMotion(x, y, yaw, float(trace.velocity[0, row, :2] @ heading_vectors(yaw)), along)


def _pass_red(route: Route, before: EgoMotion, after: EgoMotion, length_m: float, snapshot: Snapshot) -> int:
    """Return the number of stop lines that the vehicle's front has passed at red between two steps."""
    closed, amber = read_lights(snapshot)
    front, next_front = before.along + length_m / 2, after.along + length_m / 2
    passed = [link for stop, link in route.stops if front <= stop < next_front and after.speed > STANDS_MPS]
    return sum(link in closed - amber for link in passed)


def _allowed(route: Route, start_m: float, time_s: float) -> float:
    """Return the distance [m] that is driven at the speed limit from `start_m` in `time_s`, up to the route's end."""
    at = start_m
    for _ in range(round(time_s / DT_S)):
        at += route.limit(at) * DT_S
    return max(min(at, route.length_m) - start_m, 1.0)

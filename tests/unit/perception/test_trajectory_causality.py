"""The trajectory task's inputs against SUMO's states altered after the present, and their filter against closed forms.

`pytest tests/unit/perception/test_trajectory_causality.py -k error -s` prints what the filter costs.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flcav.dataset.layout import FrameKey
from flcav.dataset.store import Dataset
from flcav.geometry import heading_vectors, wrap_angle
from flcav.perception.trajectory import samples, tracks
from flcav.perception.trajectory.config import PAST, CrossView, Patch, TrajectoryConfig
from flcav.perception.trajectory.rasters import RoadMap, road_map
from flcav.perception.trajectory.samples import extract_columns, find_near, find_pictured, surround_vehicle
from flcav.perception.trajectory.tracks import OFFSETS_S, extrapolate, tracks_around, tracks_at
from flcav.world.map.town import load_town
from flcav.world.scenarios.stage import STEP_S
from flcav.world.trace import Trace
from flcav.world.traffic import traffic
from flcav.world.traffic.traffic import REACH_S, simulate

AHEAD_S = np.array([0.1, 0.25, 0.5, 0.8])
PRESENT_S = 65.0
EVERY_S = (0.1, 0.2, 0.5)


def one_actor(yaw: float, speed: float, gain: float, turn: float, category: str = "car") -> Trace:
    """Return a trace of one instant, at (3, -2), of an actor with this acceleration ahead and this turn rate."""
    ahead = np.array([[[np.cos(yaw), np.sin(yaw), 0.0]]])
    across = np.array([[[-np.sin(yaw), np.cos(yaw), 0.0]]])
    return Trace(
        town="grid",
        time_s=np.array([5.0]),
        actor=np.array(["veh0"]),
        category=np.array([category]),
        shape=np.zeros(1, np.int64),
        size=np.array([[4.4, 1.8, 1.6]]),
        present=np.ones((1, 1), np.bool_),
        position=np.array([[[3.0, -2.0, 0.0]]]),
        yaw=np.array([[yaw]]),
        velocity=speed * ahead,
        acceleration=gain * ahead + speed * turn * across,
        yaw_rate=np.array([[turn]]),
        light=np.zeros(0, np.str_),
        light_state=np.zeros((1, 0), "<U1"),
    )


@pytest.mark.parametrize("turn", [-0.9, 0.4])
def test_a_circle_is_followed(turn):
    found = extrapolate(one_actor(0.7, 8.0, 0.0, turn), 0, AHEAD_S)
    radius = 8.0 / turn
    centre = np.array([3.0 - radius * np.sin(0.7), -2.0 + radius * np.cos(0.7)])
    angle = 0.7 + turn * AHEAD_S
    expected = centre + radius * np.stack((np.sin(angle), -np.cos(angle)), axis=1)
    assert np.allclose(found.position[:, 0], expected, atol=1e-12)
    assert np.allclose(found.yaw[:, 0], angle)
    assert np.allclose(found.speed, 8.0)


@pytest.mark.parametrize(
    ("speed", "gain", "metres", "speeds"),
    [
        (8.0, 0.0, [0.8, 2.0, 4.0, 6.4], [8, 8, 8, 8]),
        (8.0, 2.0, [0.81, 2.0625, 4.25, 7.04], [8.2, 8.5, 9, 9.6]),
        (1.0, -4.0, [0.08, 0.125, 0.125, 0.125], [0.6, 0, 0, 0]),  # it stands after 0.25 s
        (0.0, 2.0, [0.01, 0.0625, 0.25, 0.64], [0.2, 0.5, 1, 1.6]),
        (0.0, -1.0, [0, 0, 0, 0], [0, 0, 0, 0]),
    ],
)
def test_a_straight_line_is_followed(speed, gain, metres, speeds):
    found = extrapolate(one_actor(2.5, speed, gain, 0.0), 0, AHEAD_S)
    expected = np.array([3.0, -2.0]) + np.array(metres)[:, None] * [np.cos(2.5), np.sin(2.5)]
    assert np.allclose(found.position[:, 0], expected, atol=1e-9)
    assert np.allclose(found.yaw, 2.5)
    assert np.allclose(found.speed[:, 0], speeds)


def test_a_braked_turn_is_that_of_the_differential_equation():
    speed, gain, turn = 9.0, -3.0, 0.6
    found = extrapolate(one_actor(-3.0, speed, gain, turn), 0, AHEAD_S)

    def motion(_, state):
        _, _, yaw, speed = state
        return [speed * np.cos(yaw), speed * np.sin(yaw), turn, gain]

    exact = solve_ivp(motion, (0, 1), [3.0, -2.0, -3.0, speed], t_eval=AHEAD_S, rtol=1e-9, atol=1e-9).y.T
    off = np.linalg.norm(found.position[:, 0] - exact[:, :2], axis=1)
    assert (off < 1.05 * abs(gain * turn) * AHEAD_S**3 / 12).all()  # of the arc: 2 cm after 0.5 s
    assert np.allclose(wrap_angle(found.yaw[:, 0] - exact[:, 2]), 0, atol=1e-7)
    assert np.allclose(found.speed[:, 0], exact[:, 3], atol=1e-7)


def test_a_pedestrian_goes_on_as_it_went():
    found = extrapolate(one_actor(0.5, 1.4, 0.8, 2.0, "pedestrian"), 0, AHEAD_S)
    expected = np.array([3.0, -2.0]) + 1.4 * AHEAD_S[:, None] * [np.cos(0.5), np.sin(0.5)]
    assert np.allclose(found.position[:, 0], expected)
    assert np.allclose(found.yaw, 0.5)
    assert np.allclose(found.speed, 1.4)


@dataclass(frozen=True)
class Runs:
    """Traces of the same traffic with SUMO's own states after `PRESENT_S`, and with altered ones."""

    plain: Trace
    altered: Trace


@pytest.fixture(scope="module", params=EVERY_S)
def runs(request: pytest.FixtureRequest) -> Runs:
    """Smooth the same states of SUMO twice, the second time moved, turned and faster after `PRESENT_S`."""
    times_s = np.arange(60.0, 70.01, request.param).round(1)
    run = traffic._run

    def altered(net, demand, seed, steps, scenarios):
        raw = run(net, demand, seed, steps, scenarios)
        later = steps * STEP_S > PRESENT_S + 1e-6
        raw.state[later] = raw.state[later] * [1, 1, 1, 1.7] + [9.0, -6.0, 70.0, 3.0]
        raw.state[later, :10] = np.nan  # and some of those from the start are no longer there
        raw.light_state[later] = np.char.replace(raw.light_state[later], "r", "G")
        return raw

    town = load_town("grid")
    with pytest.MonkeyPatch.context() as patch:
        plain = simulate(town, seed=7, cavs=0, times_s=times_s)
        patch.setattr(traffic, "_run", altered)
        return Runs(plain, simulate(town, seed=7, cavs=0, times_s=times_s))


@lru_cache
def roads() -> RoadMap:
    return road_map(load_town("grid"))


def inputs_at(trace: Trace, time_s: float) -> tuple[np.ndarray, ...]:
    """Return all that a network may see at `time_s`: tracks, who is near, and the samples' columns but the future."""
    key = FrameKey("scene", 0, str(trace.actor[trace.category != "pedestrian"][0]), time_s)
    around = tracks_around(trace, time_s)
    everyone = np.ones(len(trace.actor), np.bool_)
    found = extract_columns(trace, around, key, 0, roads(), Patch(), everyone, complete=False)
    past = (*(part[: PAST + 1] for part in around), find_near(trace, around, key))
    return (*past, *(column for name, column in found._asdict().items() if name != "future"))


def same_bits(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> list[bool]:
    return [a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in zip(one, other, strict=True)]


def test_inputs_do_not_change_with_what_happens_later(runs):
    one, other = inputs_at(runs.plain, PRESENT_S), inputs_at(runs.altered, PRESENT_S)
    assert all(same_bits(one, other))
    assert len(one[-1]) > 20
    futures = [tracks_around(trace, PRESENT_S).position[PAST + 1 :] for trace in (runs.plain, runs.altered)]
    assert futures[0].tobytes() != futures[1].tobytes()


def test_inputs_of_the_smoothed_present_would_change(runs, monkeypatch):
    """The altered traffic is seen by whatever takes the present from the trace, so the test above would fail."""
    assert not any(same_bits(*(tracks_at(trace, np.array([PRESENT_S])) for trace in (runs.plain, runs.altered))))
    monkeypatch.setattr(tracks, "REACH_S", 0.0)
    one, other = inputs_at(runs.plain, PRESENT_S), inputs_at(runs.altered, PRESENT_S)
    assert not any(same_bits(one[:3], other[:3]))
    assert not any(same_bits(one[4:6], other[4:6]))  # past and raster


def test_a_trace_reaches_as_far_as_is_said(runs):
    """Up to `REACH_S` before the alteration a trace is unaltered in all fields; one step later it is not."""
    last = int(np.searchsorted(runs.plain.time_s, PRESENT_S - REACH_S + 1e-6, side="right"))
    for name in ("present", "position", "yaw", "velocity", "acceleration", "yaw_rate"):
        plain, altered = getattr(runs.plain, name), getattr(runs.altered, name)
        assert plain[:last].tobytes() == altered[:last].tobytes(), name
    if runs.plain.time_s[1] - runs.plain.time_s[0] < 0.15:
        assert runs.plain.yaw_rate[last].tobytes() != runs.altered.yaw_rate[last].tobytes()


@pytest.mark.parametrize(("town", "centimetres", "degrees"), [("grid", 6, 0.6), ("suburb", 7, 1.0), ("ring", 9, 1.0)])
def test_the_error_of_the_rebuilt_present_is_small(town, centimetres, degrees):
    trace = simulate(load_town(town), seed=999, cavs=1, times_s=np.arange(60.0, 100.01, 0.5).round(1))
    driving = (trace.category != "pedestrian") & ~np.char.startswith(trace.actor, "parked")
    off, turned, held = [], [], []
    for time_s in trace.time_s[4:]:
        rebuilt, smoothed = tracks_around(trace, time_s), tracks_at(trace, time_s + OFFSETS_S)
        there = driving & np.isfinite(rebuilt.yaw[: PAST + 1]).all(axis=0)
        off.append(np.linalg.norm((rebuilt.position - smoothed.position)[PAST, there], axis=1))
        turned.append(np.abs(wrap_angle(rebuilt.yaw - smoothed.yaw)[PAST, there]))
        earlier = smoothed.position[PAST - 2] + REACH_S * smoothed.speed[PAST - 2, :, None] * heading_vectors(
            smoothed.yaw[PAST - 2]
        )
        held.append(np.linalg.norm((earlier - smoothed.position[PAST])[there], axis=1))
    apart, angle, straight = 100 * np.concatenate(off), np.degrees(np.concatenate(turned)), 100 * np.concatenate(held)
    shares = [f"mean {values.mean():.2f}, 95 % below {np.quantile(values, 0.95):.2f}" for values in (apart, angle)]
    print(f"\n{town}, {len(apart)} vehicles: {shares[0]} cm; {shares[1]} degrees; straight on {straight.mean():.2f} cm")
    assert apart.mean() < centimetres
    assert angle.mean() < degrees
    assert apart.mean() < 0.6 * straight.mean()


class Keys(list):
    """Keys of a dataset's frames, as `Dataset.keys`."""

    @property
    def keys(self) -> list[FrameKey]:
        return self

    def __hash__(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return id(self)


def spins(*times_s: float) -> Dataset:
    """Return a stand-in for a dataset of two agents in two scenes at these times."""
    found = Keys(
        FrameKey(scene, index, agent, time_s)
        for scene in "ab"
        for index, time_s in enumerate(times_s)
        for agent in ("cav0", "cav1")
    )
    return cast("Dataset", found)


def test_pictures_are_as_old_as_a_trace_reaches():
    data = spins(*(60 + 0.5 * np.arange(4)).tolist())
    assert [find_pictured(data, i) for i in range(8)] == [None, None, 0, 1, 2, 3, 4, 5]
    assert find_pictured(data, 8) is None  # another scene
    dense = spins(*(60 + 0.1 * np.arange(11)).tolist())
    assert [find_pictured(dense, 2 * i) for i in range(11)] == [None] * 5 + [0, 2, 4, 6, 8, 10]
    assert find_pictured(spins(60.0, 62.0), 2) is None  # 2 s old


def test_the_network_with_cameras_sees_earlier_pictures(monkeypatch):
    asked = []

    def read(_, number):
        asked.append(number)
        return np.zeros((1, 48, 96, 3), np.uint8), np.eye(3)[None], np.eye(4)[None]

    monkeypatch.setattr(samples, "_kept", lambda _: read)
    surround_vehicle(spins(60.0, 60.5, 61.0), 4, np.zeros(3), CrossView())
    assert asked == [2]


def test_pictures_cross_a_link_once_a_frame_with_the_views_of_all_its_road_users(monkeypatch):
    rng = np.random.default_rng(2)
    data, settings = spins(60.0, 60.5, 61.0), TrajectoryConfig(cameras=CrossView(width_px=32, height_px=32))
    seen = rng.integers(0, 255, (2, 32, 32, 3), np.uint8), rng.normal(size=(2, 3, 3)), rng.normal(size=(2, 4, 4))
    monkeypatch.setattr(samples, "_kept", lambda _: lambda data, number: seen)
    count, frame = 5, np.array([4, 4, 5, 5, 5])
    columns = samples.Columns(
        past=rng.normal(size=(count, 21, 4)).astype(np.float32),
        future=rng.normal(size=(count, 30, 2)).astype(np.float32),
        raster=rng.integers(0, 255, (count, 3, 8, 1), np.uint8),
        pose=rng.normal(size=(count, 3)),
        actor=np.arange(count),
        at_junction=rng.random(count) < 0.5,
        scene=np.full(count, "a"),
        frame=frame,
    )
    asked = samples.Samples(data, columns, settings.cameras)
    monkeypatch.setattr(samples, "samples_of", lambda data, config, frames: asked)
    sent = list(samples.pack_frames(data, settings, [4, 5]))
    assert abs(len(sent[1]) - len(sent[0])) < 1500  # a road user more, and the same pictures
    received = samples.unpack_frames(sent)
    assert len(received) == count
    for one, other in zip(received, asked, strict=True):
        assert all(np.array_equal(getattr(one, name), getattr(other, name)) for name in samples.Columns._fields)
        assert one.surround is not None
        assert other.surround is not None
        assert all(np.array_equal(*each) for each in zip(one.surround, other.surround, strict=True))

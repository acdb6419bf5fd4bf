"""Kept drives, who is hidden, messages of poles, weights in problems and recipes: driving without a loop."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flcav.cli.domains.importance import set_weights
from flcav.cli.main import run
from flcav.config import InputError
from flcav.driving import jobs as driven
from flcav.driving.errors import CLASSES, load_error_model
from flcav.driving.following import CERTAIN, Following
from flcav.driving.jobs import DriveJob, Sensed, run_jobs
from flcav.driving.measures import DriveResult, Hit
from flcav.driving.networks import load_road_map
from flcav.driving.obstacles import OBSTACLE
from flcav.driving.road import merge_detections, pack_tracks
from flcav.driving.scenarios import list_scenarios
from flcav.driving.seen import TIMES_S
from flcav.driving.studies import importance
from flcav.driving.studies.error_measurement import Tally, summarise_tally
from flcav.driving.studies.pole_gain import (
    ClosedLoopGain,
    FusionTally,
    Hidden,
    Precision,
    find_hidden,
    measure_precision,
    summarise_hidden,
)
from flcav.geometry import Boxes, left_vectors
from flcav.network.ledger import unpack_arrays
from flcav.optimization.problem import Problem
from flcav.perception.networks import resolve_network
from flcav.perception.tracking import Tracker
from flcav.perception.trajectory.config import FUTURE
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.statistics.estimates import Estimate
from flcav.storage.kept import read_kept
from flcav.world.map.roads import draw_route, read_net
from flcav.world.map.town import load_town
from flcav.world.scene import Scene
from flcav.world.trace import Trace, empty_trace

DRIVE = DriveResult("s", 1, 10.0, 0.5, 5.0, 4.0, 0.0, 0, 0, (), 0.5)


def cars(*places: tuple[float, float]) -> Boxes:
    rows = [(x, y, 0.8, 4.5, 1.8, 1.6, 0.0) for x, y in places]
    return Boxes.from_array(np.array(rows).reshape(-1, 7), "Car", np.full(len(rows), 0.9))


def test_kept_drives_are_not_driven_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (DriveJob(list_scenarios()[0], seed) for seed in (1, 2))
    sensed, kept = Sensed("truth"), tmp_path / "drives.jsonl"
    lines = [
        json.dumps({"key": job.key(sensed), "drive": replace(DRIVE, seed=job.seed).as_json()})
        for job in (first, second)
    ]
    kept.write_text(lines[0] + "\n" + lines[1][:40], encoding="utf-8")  # the last line was cut off
    assert list(read_kept(kept, "drive")) == [first.key(sensed)]
    monkeypatch.setattr(driven, "process_pool", lambda *_: pytest.fail("nothing is to be driven"))
    assert run_jobs([first, first], sensed, kept=kept) == [DRIVE, DRIVE]
    with pytest.raises(pytest.fail.Exception):
        run_jobs([first, second], sensed, kept=kept)
    assert first.key(sensed) != first.key(Sensed("networks")) != replace(first, task="signs").key(sensed)


@pytest.mark.parametrize(
    "command", [["drive", "--scenario", "grid-none-clear"], ["odd", "importance", "--scenarios", "1"]]
)
def test_seeds_begin_with_the_first(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    def drive_none(jobs: Sequence[DriveJob], *_: object) -> list[DriveResult]:
        asked.extend(job.seed for job in jobs)
        return [replace(DRIVE, seed=job.seed) for job in jobs]

    for module in (driven, importance):
        monkeypatch.setattr(module, "run_jobs", drive_none)
    with pytest.raises(SystemExit) as ended:
        run([*command, "--seeds", "2", "--first-seed", "5"])
    assert ended.value.code == 0, capsys.readouterr().err
    assert list(dict.fromkeys(asked)) == [5, 6]


def test_weights_go_into_problems_and_recipes() -> None:
    weights = {"objects": 0.7, "signs": 0.3}
    problem = {"budgets_mb": {}, "tasks": [{"name": "objects", "weight": 1}, {"name": "lanes", "weight": 2}]}
    assert set_weights(problem, weights, "p") == {
        "budgets_mb": {},
        "tasks": [{"name": "objects", "weight": 0.7}, {"name": "lanes", "weight": 2}],
    }
    recipe = {"seed": 1, "tasks": {"objects": {"network": "tiny"}, "weather": None}}
    assert set_weights(recipe, weights, "r") == {
        "seed": 1,
        "tasks": {"objects": {"network": "tiny", "weight": 0.7}, "weather": {}},
    }
    for bad in ([], {"tasks": []}, {"tasks": [{"weight": 1}]}, {"seed": 1}):
        with pytest.raises(InputError, match=r"no tasks|no name"):
            set_weights(bad, weights, "bad.yaml")


def test_the_weights_are_those_that_allocate_takes() -> None:
    from flcav.config import parse_config, read_yaml

    path = Path(__file__).parents[3] / "recipes" / "allocation" / "three_tasks.yaml"
    weighed = set_weights(read_yaml(path), {"objects": 0.9, "signs": 0.001, "weather": 0.099}, str(path))
    assert [task.weight for task in parse_config(Problem, weighed, "weighed").tasks] == [0.099, 0.001, 0.9]


def test_the_packaged_error_model() -> None:
    model = load_error_model()
    assert set(model.detected) == set(CLASSES)
    assert model.detected["Car"][0] > model.detected["Car"][-1]
    assert len(model.spread.growth["drives"]) == len(TIMES_S)
    assert np.allclose([sum(row.values()) for row in model.weather.values()], 1)


def test_the_error_model_is_calibrated() -> None:
    """Errors drawn with known deviations give these back, whatever the variances that the tracker claims."""
    random, tally = np.random.default_rng(1), Tally()
    horizon = len(TIMES_S[::2])
    true = 0.5 * np.sqrt(1 + np.arange(horizon))
    tally.tracks = [("drives", 0.0625, random.normal(size=(horizon, 2)) * true[:, None]) for _ in range(4000)]
    tally.pairs = [("Car", 10.0, i % 4 > 0, *random.normal(size=3).tolist()) for i in range(4000)]
    model = summarise_tally(tally)
    assert model.spread_factor == pytest.approx(4.0, rel=0.1)
    whole = np.sqrt(np.array(model.growth["drives"])[::2] ** 2 + model.spread_factor * 0.0625)
    assert whole == pytest.approx(true, rel=0.08)
    assert model.detected["Car"][0] == pytest.approx(0.75, abs=0.01)
    assert model.sd["Car"] == pytest.approx((1.0, 1.0, 1.0), rel=0.05)


def test_tracks_are_followed_kept_and_forget() -> None:
    following = Following(None, None, CERTAIN)
    *_, told = [following.step(cars((10.0 + 0.5 * tick, 3.0)), tick / 10, frozenset()) for tick in range(20)]
    assert told.velocity[0] == pytest.approx((5.0, 0.0), abs=0.3)
    assert told.path[0, 4] == pytest.approx((19.5 + 5.0, 3.0), abs=0.5)
    late = following.step(cars(), 2.1, frozenset())
    assert late.path[0, 0] == pytest.approx((20.5, 3.0), abs=0.3)  # moved on without a detection
    assert not len(following.step(cars(), 2.2, frozenset()).boxes)  # two of the last five sweeps have it


def test_a_heading_the_wrong_way_round_changes_no_forecast() -> None:
    """A detector that takes the back of a car for its front, always or at times, leaves its path as it was."""
    network, roads = resolve_network(TRAJECTORY, None), load_road_map("ring")
    route = draw_route(read_net(load_town("ring").net), np.random.default_rng(5), 200.0)
    poses = [route.at(20.0 + 0.8 * tick) for tick in range(26)]
    told = []
    for turned in (lambda tick: False, lambda tick: True, lambda tick: tick % 3 == 0):
        following = Following(network, roads, CERTAIN)
        steps = [
            following.step(replace(cars((x, y)), yaw=np.full(1, yaw + np.pi * turned(tick))), tick / 10, frozenset())
            for tick, (x, y, yaw) in enumerate(poses)
        ]
        assert steps[-1].motion == ("forecast",)
        told.append(steps[-1])
    ahead = route.at(20.0 + 0.8 * 25 + 16.0)[:2]  # in two seconds
    for other in told:
        assert other.path[0] == pytest.approx(told[0].path[0], abs=0.5)
        assert other.yaw[0] == pytest.approx(told[0].yaw[0], abs=0.1)
        assert np.hypot(*(other.path[0, 8] - ahead)) < 6.0


def test_a_forecast_moves_on_with_its_track_and_keeps_its_last_velocity() -> None:
    network, roads = resolve_network(TRAJECTORY, None), load_road_map("ring")
    route = draw_route(read_net(load_town("ring").net), np.random.default_rng(5), 200.0)
    following = Following(network, roads, CERTAIN)
    poses = [route.at(20.0 + 0.8 * tick) for tick in range(26)]
    *_, last = [
        following.step(replace(cars((x, y)), yaw=np.full(1, yaw)), tick / 10, frozenset())
        for tick, (x, y, yaw) in enumerate(poses)
    ]
    late = following.step(cars(), 2.7, frozenset())  # without a detection for 0.2 s
    assert last.motion == late.motion == ("forecast",)
    moved = late.path[0, 0] - last.boxes.center[0, :2]
    assert moved == pytest.approx(0.2 * last.velocity[0], abs=1e-6)
    steps = np.diff(last.path[0], axis=0)
    beyond = steps[FUTURE:]
    assert len(beyond) >= 2
    assert beyond == pytest.approx(np.broadcast_to(steps[FUTURE - 1], beyond.shape), abs=1e-6)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    assert np.cos(last.yaw[0, :-1] - heading) == pytest.approx(1.0, abs=1e-6)


def test_an_error_model_without_a_kind_of_motion_is_refused(tmp_path: Path) -> None:
    model = load_error_model()
    path = tmp_path / "errors.json"
    path.write_text(json.dumps(replace(model, growth={"drives": model.growth["drives"]}).as_json()))
    with pytest.raises(InputError, match="no growth of 'stands'"):
        load_error_model(path)


def test_an_error_model_without_a_class_is_refused(tmp_path: Path) -> None:
    model = load_error_model()
    known = {name: rates for name, rates in model.detected.items() if name != OBSTACLE}
    path = tmp_path / "errors.json"
    path.write_text(json.dumps(replace(model, detected=known).as_json()))
    with pytest.raises(InputError, match="no errors of 'Obstacle'"):
        load_error_model(path)


def test_the_gain_of_poles_is_told_with_paired_differences() -> None:
    def driven(name: str, ttc: float, hits: int = 0) -> DriveResult:
        hit = Hit(1.0, "veh0", "vehicle", 5.0, at_fault=True)
        return DriveResult(name, 1, 10.0, 0.5, 5.0, ttc, 0.0, 0, 0, (hit,) * hits, 0.5)

    without, with_poles = [driven("a", 1.0, 1), driven("b", 2.0)], [driven("a", 1.5), driven("b", 2.5)]
    precision = Precision(Estimate(0.5, None, None), Estimate(0.75, None, None), Estimate(0.25, 0.1, 0.4))
    gain = ClosedLoopGain((1, 3), Hidden(0, None, None, None), precision, 0.1, tuple(without), tuple(with_poles))
    told = gain.lines()
    assert told[1].endswith(" 0.500, with the poles 0.750, with less without +0.250 (+0.100 to +0.400)")
    assert "without poles: least time to collision 1.50 s" in told[2]
    assert "1 collision at fault, 0 red lights passed" in told[2]
    assert "least time to collision [s] +0.500 (+0.500 to +0.500)" in told[4]
    assert "collisions at fault -0.500 (-1.000 to +0.000)" in told[4]
    assert len(replace(gain, without=tuple(without[:1]), with_poles=tuple(with_poles[:1])).lines()) == len(told) - 1


def test_precision_with_poles_is_of_the_same_looks_with_intervals_over_scenarios() -> None:
    """In `a` poles add a car that the vehicle misses; in `b`, which has twice the looks, they add nothing."""
    both, one = scored(cars((10, 0), (20, 0))), scored(cars((10, 0)))
    tally = FusionTally(["a", "b", "b"], [one, both, both], [both, both, both], [cars((10, 0), (20, 0))] * 3)
    found = measure_precision(tally)
    assert found is not None
    recalls = np.floor(40 * 5 / 6) / 40  # AP|R40 of detections without a false positive: the recalls that are reached
    assert found.vehicle.mean == pytest.approx(recalls)
    assert (found.fused.mean, found.gain.mean) == pytest.approx((1.0, 1.0 - recalls))
    assert (found.gain.low, found.gain.high) == pytest.approx((0.0, 0.5))  # of b alone, and of a alone
    alone = measure_precision(FusionTally(["a"], [one], [both], [cars((10, 0), (20, 0))]))
    assert alone is not None
    assert (alone.gain.mean, alone.gain.low) == (pytest.approx(0.5), None)
    assert measure_precision(FusionTally(["a"], [one], [one], [Boxes.empty()])) is None


def scored(boxes: Boxes) -> Boxes:
    return replace(boxes, score=np.full(len(boxes), 0.8))


def standing(places: list[tuple[float, float, float]]) -> Trace:
    """Return the trace of one instant with cars at x, y, yaw in the town `grid`."""
    n = len(places)
    array = np.array(places)
    return replace(
        empty_trace("grid"),
        actor=np.array([f"car{i}" for i in range(n)]),
        category=np.full(n, "car"),
        shape=np.full(n, 3),
        size=np.tile((4.7, 1.84, 1.45), (n, 1)),
        present=np.ones((1, n), np.bool_),
        position=np.c_[array[:, :2], np.zeros(n)][None],
        yaw=array[None, :, 2],
        velocity=np.zeros((1, n, 3)),
        acceleration=np.zeros((1, n, 3)),
        yaw_rate=np.zeros((1, n)),
    )


def test_who_is_behind_a_car_is_hidden_from_the_vehicle_and_seen_from_above() -> None:
    town = load_town("grid")
    route = draw_route(read_net(town.net), np.random.default_rng(5), 200.0)
    own, _, behind = route.at([20.0, 28.0, 33.0]).tolist()
    wall = [(*(route.at(28.0)[:2] + side * left_vectors(own[2])), own[2] + np.pi / 2) for side in (-4.7, 0.0, 4.7)]
    scene = Scene(town, standing([tuple(own), *wall, tuple(behind)]))
    boxes, hidden = find_hidden(scene, 0, [np.array((*behind[:2], 8.0))], 40.0)
    assert len(boxes) == 4
    assert not hidden[:3, 0].any()
    assert not hidden[3, 1]
    _, alone = find_hidden(scene, 0, [], 40.0)
    assert alone[:, 1].all()
    shares = summarise_hidden([hidden, hidden])
    assert shares.cars == 8
    assert shares.both is not None
    assert shares.vehicle is not None
    assert shares.both.mean <= shares.vehicle.mean
    assert summarise_hidden([]).vehicle is None


def test_boxes_of_the_road_join_those_of_the_vehicle_once() -> None:
    both = merge_detections(cars((10.0, 0.0)), cars((11.0, 0.5), (30.0, 0.0)))
    assert both.center[:, 0].tolist() == [10.0, 30.0]
    assert len(merge_detections(cars(), cars((1.0, 1.0)))) == 1
    tracked = Tracker().step(cars((1.0, 1.0)), 0.0)
    assert unpack_arrays(pack_tracks(tracked))["boxes"].shape == (1, 7)

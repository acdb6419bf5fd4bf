"""From a gap to a drive: recipes, recordings, files of one's own and OpenSCENARIO as driving scenarios."""

import csv
import json
import math
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.driving import jobs
from flcav.driving.driver import DriverSettings
from flcav.driving.jobs import DriveJob, Sensed, film_job
from flcav.driving.loop import Loop
from flcav.driving.scenario_files import read_scenarios
from flcav.driving.scenarios import DrivingScenario, StagedScenario, find_scenarios, find_start, list_scenarios
from flcav.driving.scripts import BEGINS_S, LANE_M, PREFIX, Script, ScriptPlayer, Speed, write_script
from flcav.driving.seen import EGO, WEATHER_SPEED
from flcav.odd.domain import Domain
from flcav.odd.openscenario import to_openscenario
from flcav.odd.sampling import CASES, SampledScenario, Space, make_recipe, sample_domain
from flcav.odd.scenery import Scenery
from flcav.world.commands import Spawn
from flcav.world.live import LiveWorld
from flcav.world.live import Settings as World
from flcav.world.map.roads import Route
from flcav.world.map.town import load_town
from flcav.world.weather import WEATHERS, Weather

ALL = sorted({case for cases in CASES.values() for case in cases})


@pytest.fixture(scope="module")
def samples(urban: Domain, ring: Scenery) -> dict[str, SampledScenario]:
    drawn = sample_domain(Space(urban, [ring]), 200, "sobol").samples
    return {case: next(each for each in drawn if each.case == case) for case in ALL}


def written(samples: dict[str, SampledScenario], case: str, folder: Path) -> Path:
    path = folder / f"{case}.xosc"
    path.write_bytes(to_openscenario(samples[case], "maps/ring.xodr"))
    return path


def one(*names: object) -> DrivingScenario:
    (found,) = read_scenarios([str(each) for each in names])
    return found


@pytest.mark.parametrize("case", ALL)
def test_a_recipe_of_a_sample_is_a_scenario_at_its_place_in_its_weather(
    case: str, samples: dict[str, SampledScenario], ring: Scenery, tmp_path: Path
) -> None:
    sample, path = samples[case], tmp_path / "gap.yaml"
    path.write_text(yaml.safe_dump(make_recipe(sample, ring, 3)))
    found = one(path)
    assert (found.town, found.case, found.event) == ("ring", case, "none")
    assert found.place == pytest.approx((sample.place.x, sample.place.y), abs=0.06)
    assert found.sky is not None
    for name in Weather.model_fields:
        assert getattr(found.sky, name) == pytest.approx(getattr(sample.weather, name), abs=1e-4)
    assert found.name == f"{tmp_path.name}/gap"
    assert case in found.line()


@pytest.mark.parametrize("case", ALL)
def test_openscenario_is_read_as_it_was_written(case: str, samples: dict[str, SampledScenario], tmp_path: Path) -> None:
    sample = samples[case]
    limit = max(sample.limit_kmh / 3.6, 1.0)
    script, found = write_script(sample.case, limit), one(written(samples, case, tmp_path))
    assert found.start == pytest.approx(sample.place.start, abs=1e-3)
    assert found.speed == pytest.approx(limit, rel=1e-5)
    (read,) = found.scripts
    assert (read.near, read.within_m) == (script.near, script.within_m)
    for own, other in zip(read.actors, script.actors, strict=True):
        assert (own.name, own.category, own.shape) == (other.name, other.category, other.shape)
        assert own.start[:2] == pytest.approx(other.start[:2], abs=2e-3)
        assert math.cos(own.start[2] - other.start[2]) == pytest.approx(1.0)
        assert own.speed == pytest.approx(other.speed, rel=1e-5)
    assert [replace(each, actor="") if hasattr(each, "lanes") else each.actor for each in read.actions] == [
        replace(each, actor="") if hasattr(each, "lanes") else each.actor for each in script.actions
    ]
    assert found.sky is not None
    assert found.sky.rain_mm_h == pytest.approx(sample.weather.rain_mm_h, rel=1e-4)
    assert found.sky.sun_elevation_deg == pytest.approx(sample.weather.sun_elevation_deg, rel=1e-4)


def test_a_recording_is_driven_in_its_town_and_weather(drive: Dataset) -> None:
    found = one(drive.folder)
    assert (found.town, found.case) == ("ring", None)
    assert found.sky is not None


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("{town: ring, event: walker, weather: {preset: fog, visibility_m: 90}, traffic: 3, pedestrians: 1}")
    found = one(path)
    assert (found.town, found.event, found.traffic, found.pedestrians, found.weather) == ("ring", "walker", 3, 1, "fog")
    assert found.sky == WEATHERS["fog"].model_copy(update={"visibility_m": 90.0})
    assert next(each.name for each in read_scenarios(["grid-none-clear", str(path)])) == "grid-none-clear"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.yaml", "[]", "a mapping"),
        ("a.yaml", "{town: nowhere, event: none}", "nowhere"),
        ("a.yaml", "{town: grid, event: jump}", "event"),
        ("a.yaml", "{town: grid, event: none, traffic: -1}", "traffic"),
        ("a.yaml", "{town: ring, source: carla}", "CARLA"),
        ("a.txt", "town: grid", "a scenario is a YAML file"),
        ("a.xosc", "<OpenDRIVE/>", "no OpenSCENARIO"),
        ("a.xosc", "<OpenSCENARIO/>", "names no map"),
        ("missing.yaml", None, "missing.yaml"),
        ("nothing-there", None, "flcav drive --list"),
    ],
)
def test_bad_files_are_refused_in_a_sentence(name: str, text: str | None, said: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        read_scenarios([str(tmp_path / name)])


def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no recording"):
        read_scenarios([str(tmp_path)])
    with pytest.raises(InputError, match="given twice"):
        read_scenarios(["grid-none-clear", "grid-none-clear"])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("maps/ring.xodr", "maps/elsewhere.xodr", "'elsewhere' is no town of flcav"),
        ("<WorldPosition", "<LanePosition", "<LanePosition>, and flcav reads <WorldPosition>"),
        ("RelativeTargetLane", "AbsoluteTargetLane", "relative lanes"),
        ("SimulationTimeCondition", "TimeOfDayCondition", "TimeOfDayCondition"),
        ('vehicleCategory="car"', 'vehicleCategory="tram"', "a 'tram', of which flcav has none"),
        ('length="', 'length="-', "no extent"),
        ('x="', 'x="a', "is no number"),
        ('x="', 'x="nan', "no number|out of reach"),
        ("TeleportAction", "VisibilityAction", "has no <TeleportAction>"),
        ('<EntityRef entityRef="neighbour"', '<EntityRef entityRef="ghost"', "'ghost', which is no entity"),
        ('<EntityRef entityRef="neighbour"', '<EntityRef entityRef="ego"', "drives itself"),
    ],
)
def test_what_openscenario_has_beyond_is_refused(
    old: str, new: str, said: str, samples: dict[str, SampledScenario], tmp_path: Path
) -> None:
    path = written(samples, "cut_in", tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=said):
        read_scenarios([str(path)])


def test_parameters_and_speeds_by_time_are_read(samples: dict[str, SampledScenario], tmp_path: Path) -> None:
    path = written(samples, "stalled_vehicle", tmp_path)
    speed = next(iter(write_script("stalled_vehicle", samples["stalled_vehicle"].limit_kmh / 3.6).actors)).speed
    text = path.read_text().replace(
        "<CatalogLocations />",
        '<ParameterDeclarations><ParameterDeclaration name="rest" parameterType="double" value="0.5"/>'
        "</ParameterDeclarations><CatalogLocations />",
    )
    text = text.replace('<AbsoluteTargetSpeed value="0" />', '<AbsoluteTargetSpeed value="$rest" />')
    text = text.replace('dynamicsDimension="rate" value="4"', 'dynamicsDimension="time" value="2"')
    path.write_text(text)
    ((action,),) = (each.actions for each in one(path).scripts)
    assert isinstance(action, Speed)
    assert action.target == 0.5
    assert action.rate == pytest.approx((speed - 0.5) / 2, rel=1e-4)


def play(script: Script, seconds: float, ego: tuple[float, float] = (0.0, 0.0)) -> dict[str, np.ndarray]:
    """Return the poses (T, 3) of a script's actors on a straight route along x from 100 m on."""
    along = np.linspace(0.0, 400.0, 401)
    route = Route(np.c_[along - 200.0, np.zeros(401)], along, np.full(401, 10.0), (), np.full(401, 3.5))
    with LiveWorld(load_town("suburb"), World(parked=False, dt_s=0.1, remembers=False)) as world:
        world.apply(Spawn(EGO, "car", 3, *ego, anywhere=True))
        player, rows = ScriptPlayer(world, [script], route, 200.0), []
        for _ in range(round(seconds * 10)):
            trace = world.snapshot.trace
            rows.append(np.c_[trace.position[0, :, :2], trace.yaw[0]])
            player.act(ego, 0.1)
            world.step({})
        names = world.snapshot.trace.actor.tolist()
        return {name.removeprefix(PREFIX): np.array(rows)[:, i] for i, name in enumerate(names)}


def test_a_stalled_vehicle_drives_and_brakes_to_a_stop() -> None:
    poses = play(write_script("stalled_vehicle", 8.0), 6.0)["stalled"]
    assert poses[0] == pytest.approx((25.0, 0.0, 0.0), abs=1e-6)
    driven = 8.0 * BEGINS_S + 8.0**2 / (2 * 4.0)
    assert poses[-1] == pytest.approx((25.0 + driven, 0.0, 0.0), abs=0.05)


def test_cut_in_changes_by_one_lane_to_the_right_and_oncoming_overtakes_to_its_own_left() -> None:
    cut = play(write_script("cut_in", 8.0), 6.0)["neighbour"]
    assert (cut[0, 1], cut[-1, 1]) == pytest.approx((LANE_M, 0.0), abs=1e-6)
    fast = play(write_script("overtaking", 8.0), 6.0)["overtaking"]
    assert (np.diff(fast[:, 0]) < 0).all()
    assert (fast[0, 1], fast[-1, 1]) == pytest.approx((LANE_M, 0.0), abs=1e-6)  # into the lane of the ego vehicle


@pytest.mark.parametrize(("x", "runs"), [(0.0, False), (8.0, True)])
def test_a_child_runs_when_the_vehicle_is_near(x: float, runs: bool) -> None:
    walker = play(write_script("pedestrian_behind_van", 8.0), 3.0, (x, 0.0))["walker"]
    assert walker[0, :2] == pytest.approx((28.5, -3.2))
    assert (walker[-1, 1] > 0) == runs
    assert np.ptp(walker[:, 0]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("wanted", [(150.0, 2.0), (110.0, 1.0, 0.3)])
def test_a_drive_begins_at_a_pose_or_before_a_place(wanted: tuple[float, ...]) -> None:
    along = np.linspace(0.0, 400.0, 401)
    route = Route(np.c_[along, np.zeros(401)], along, np.full(401, 10.0), (), np.full(401, 3.5))
    assert find_start(route, wanted, 3.0) == pytest.approx(110.0)
    assert find_start(route, wanted, 0.5) is None
    assert find_start(route, (150.0, 0.0, 3.0), 3.0) is None  # against the route


def test_a_staged_recipe_passes_its_place_and_has_its_actors(
    samples: dict[str, SampledScenario], ring: Scenery, tmp_path: Path
) -> None:
    path = tmp_path / "gap.yaml"
    path.write_text(yaml.safe_dump(make_recipe(samples["crash"], ring, 0)))
    found = one(path)
    staged = StagedScenario(replace(found, traffic=0, pedestrians=0), 4)
    try:
        ahead = staged.route.at(staged.start_m + np.arange(0.0, 80.0, 0.5))[:, :2]
        assert found.place is not None
        assert np.hypot(*(ahead - found.place).T).min() < 35.0
        assert {f"{PREFIX}car_1", f"{PREFIX}car_2"} <= set(staged.world.snapshot.trace.actor.tolist())
    finally:
        staged.world.close()


@pytest.mark.parametrize("scenario", list_scenarios()[:4], ids=lambda each: each.name)
def test_at_night_rain_and_sight_stay_and_nobody_drives_faster(scenario: DrivingScenario) -> None:
    dark = scenario.at_night()
    assert dark.sky is not None
    assert dark.sky.night
    day = WEATHERS[scenario.weather]
    assert (dark.sky.rain_mm_h, dark.sky.visibility_m) == (day.rain_mm_h, day.visibility_m)
    assert WEATHER_SPEED[dark.weather] == min(WEATHER_SPEED[scenario.weather], WEATHER_SPEED["night"])
    assert dark.name == f"{scenario.name}-night"


def test_a_film_has_who_is_there_and_what_the_driver_is_told() -> None:
    (scenario,) = find_scenarios(["suburb-stalled-clear"])
    scenario = replace(scenario, traffic=0, pedestrians=0)
    own, film = film_job(DriveJob(scenario, 1, loop=Loop(DriverSettings(), 1.0)), Sensed("truth"))
    assert [each.time_s for each in film.instants] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])
    assert (film.scenario, film.seed) == (own.scenario, own.seed)
    first = film.instants[0]
    near = [each for each in first.actors if np.hypot(each[0] - first.ego[0], each[1] - first.ego[1]) <= 55.0]
    assert near == list(first.actors) == list(first.seen)
    assert film.lanes


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        run(["drive", *arguments])
    told = capsys.readouterr()
    assert ended.value.code == 0, told.err
    return told.out


def test_the_scenarios_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    lines = answer(capsys, "--list").splitlines()
    assert [line.split(":")[0] for line in lines] == [each.name for each in list_scenarios()]
    (dark,) = answer(capsys, "--list", "--night", "--scenario", "ring-none-fog").splitlines()
    assert dark.startswith("ring-none-fog-night: ring, no event, fog (sun -25 deg")


def test_a_drive_is_reported_with_film_table_and_intervals(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "process_pool", lambda *_: nullcontext(SimpleNamespace(map=map)))
    out, path = tmp_path / "report", tmp_path / "own.yaml"
    path.write_text("{town: suburb, event: none, traffic: 0, pedestrians: 0}")
    told = answer(capsys, "--scenario", str(path), "--seeds", "2", "--lasts", "1", "--jobs", "1", "--out", str(out))
    assert told.startswith("perception: ground truth\n")
    with (out / "drives.csv").open() as file:
        rows = list(csv.DictReader(file))
    results = json.loads((out / "results.json").read_text())["drives"]
    assert [float(row["progress"]) for row in rows] == pytest.approx([each["progress"] for each in results])
    page = (out / "report.html").read_text()
    mean = np.mean([each["progress"] for each in results])
    assert re.search(rf"<td>progress</td><td>{mean:.3f} \(", page)
    films = json.loads(page.split('id="films">')[1].split("</script>")[0])
    assert [film["seed"] for film in films] == [1, 2]
    assert all(len(film["instants"]) == 5 for film in films)


def test_a_report_beside_other_measurements_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        run(["drive", "--perception", "networks", "--measure", str(tmp_path / "e.json"), "--out", str(tmp_path / "r")])
    assert (ended.value.code, capsys.readouterr().err.count("--out")) == (2, 1)

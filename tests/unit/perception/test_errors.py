"""The error registry of signs and trajectories on a drive: misses in their place, inventions where their rays meet."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.errors import (
    FALSE_POSITIVE,
    FINAL_ERROR,
    MISS,
    PerceptionError,
    Registry,
    is_among,
    keep_first,
    load_errors,
    pack_errors,
    save_errors,
    unpack_errors,
)
from flcav.perception.signs import errors as sign_errors
from flcav.perception.signs.model import CONFIGURATIONS, SignDetector, SignsConfig
from flcav.perception.signs.predict import SignDetections
from flcav.perception.signs.samples import label_picture
from flcav.perception.trajectory import evaluate as path_errors
from flcav.perception.trajectory.config import CONFIGURATIONS as PATHS
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.samples import samples_of
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.map.town import load_town
from flcav.world.static import list_signs_and_signals

CAMERA = {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 480, "height": 288, "fov_deg": 90.0}}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("drive") / "data"
    fields = {"town": "grid", "seed": 3, "cavs": 2, "spins_per_scene": 12, "every_s": 0.5, "warmup_s": 40.0}
    record(EmbeddedSource(Recipe.model_validate({**fields, "vehicle_rig": {"cameras": {"front": CAMERA}}})), out)
    return Dataset.open(out)


@pytest.fixture(scope="module")
def network() -> SignDetector:
    return SignDetector(CONFIGURATIONS["n"])


def seen(data: Dataset, config: SignsConfig) -> list[SignDetections]:
    """Return what a perfect detector finds in each frame's picture."""
    out = []
    for number in range(len(data)):
        frame = data.frame(number)
        sample = label_picture(frame, "front", data.plane(number, "front", "rgb"), config)
        out.append(SignDetections(sample.boxes, sample.label, np.ones(len(sample.label))))
    return out


def registered(data: Dataset, network: SignDetector, found: list[SignDetections], monkeypatch: pytest.MonkeyPatch):
    answers = iter(found)
    monkeypatch.setattr(sign_errors, "detect_in_picture", lambda *_, **__: next(answers))
    return sign_errors.register_sign_errors(network, data, range(len(data)), 0.3)


def test_a_perfect_sign_detector_makes_no_mistakes(drive, network, monkeypatch):
    found = seen(drive, network.config)
    assert sum(map(len, found)) > 3
    assert registered(drive, network, found, monkeypatch).errors == ()


def test_signs_that_were_missed_stand_where_they_stand_in_town_and_count_once(drive, network, monkeypatch):
    nothing = SignDetections(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros(0))
    result = registered(drive, network, [nothing] * len(drive), monkeypatch)
    town = drive.town()
    assert town is not None
    things = list_signs_and_signals(town)
    places = {tuple(np.round(place, 6)) for place in things.position}
    assert {error.kind for error in result.errors} == {MISS}
    assert all(tuple(np.round((error.x, error.y, error.z), 6)) in places for error in result.errors)
    assert len({error.track for error in result.errors}) == len(result.errors) > 0
    assert sum(len(one) for one in seen(drive, network.config)) >= len(result.errors)


def test_an_invented_sign_is_where_its_ray_meets_the_town_or_is_dropped(drive, network, monkeypatch):
    image = drive.frame(0).images["front"]
    still = (image.instance == 0) & np.isfinite(image.depth_m) & (image.depth_m < 60.0)
    ground = np.argwhere(still)[-1]  # low in the picture: on the road
    sky = np.argwhere(np.isinf(image.depth_m))[0]
    middles = np.array([ground, sky])[:, ::-1] + 0.5  # x, y from the corner [px]
    middles[1] = np.clip(middles[1], 9, None)
    assert np.isinf(image.depth_m[int(middles[1, 1]), int(middles[1, 0])])
    boxes = np.concatenate((middles - 8, middles + 8), axis=1)
    nothing = SignDetections(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros(0))
    invented = SignDetections(boxes, np.zeros(2, np.int64), np.ones(2))
    found = [invented, *[nothing] * (len(drive) - 1)]
    result = registered(drive, network, found, monkeypatch)
    (error,) = (error for error in result.errors if error.kind == FALSE_POSITIVE)
    assert result.dropped == 1
    frame = drive.frame(0)
    camera_from_world = np.linalg.inv(frame.world_from_sensor("front"))
    x, y, z = camera_from_world[:3, :3] @ (error.x, error.y, error.z) + camera_from_world[:3, 3]
    assert error.distance_m == pytest.approx(np.linalg.norm(frame.world_from_agent[:2, 3] - (error.x, error.y)))
    assert z == pytest.approx(image.depth_m[tuple(ground)], rel=0.02)
    assert frame.calibration.intrinsics["front"] @ (x / z, y / z, 1) == pytest.approx((*(ground[::-1]), 1), abs=0.01)


def test_a_path_that_ends_elsewhere_is_registered_at_the_present(drive, monkeypatch):
    config = PATHS["tiny"]
    samples = samples_of(drive, config)
    future = samples.columns.future.astype(float)
    paths = np.repeat(future[:, None], config.modes, axis=1)
    paths[0, :, -1] += (2.5, 0.0)
    paths[1, :, -1] += (0.0, 1.5)
    chances = np.full(paths.shape[:2], 1 / config.modes)
    monkeypatch.setattr(path_errors, "predict_paths", lambda *_: (paths, chances))
    result = path_errors.register_path_errors(TrajectoryNetwork(config), drive, samples)
    (error,) = result.errors
    assert error.kind == FINAL_ERROR
    assert (error.x, error.y) == pytest.approx(tuple(samples.columns.pose[0, :2]))
    vehicle = drive.frame(int(samples.columns.frame[0])).world_from_agent[:2, 3]
    assert error.distance_m == pytest.approx(np.linalg.norm(vehicle - (error.x, error.y)))
    trace = drive.trace(error.scene)
    assert trace is not None
    assert error.track == trace.actor[samples.columns.actor[0]]
    assert error.z == 0
    hills = load_town("hilly_grid")
    monkeypatch.setattr(Dataset, "town", lambda _: hills)
    (raised,) = path_errors.register_path_errors(TrajectoryNetwork(config), drive, samples).errors
    assert (raised.x, raised.y, raised.z) == (error.x, error.y, hills.ground(error.x, error.y))
    assert abs(raised.z) > 0.1


def made(kind: str, track: str, x: float = 0.0, scene: str = "a") -> PerceptionError:
    return PerceptionError(x, 0.0, 0.0, 1.0, kind, "Car", 3, 0.5, scene, track, 12.5)


def test_each_mistake_is_kept_once():
    errors = [made(MISS, "veh1"), made(MISS, "veh1", 9.0), made(MISS, "veh1", scene="b")]
    errors += [made(FALSE_POSITIVE, "", x) for x in (0.0, 1.5, 5.0)]
    kept = keep_first(errors)
    assert [(error.track, error.x, error.scene) for error in kept] == [
        ("veh1", 0.0, "a"), ("veh1", 0.0, "b"), ("false_positive0", 0.0, "a"), ("false_positive1", 5.0, "a"),
    ]  # fmt: skip


def test_a_server_registers_what_vehicles_report_as_if_it_had_seen_it():
    frames = {
        4: [made(MISS, "veh1"), made(FALSE_POSITIVE, "", 0.0)],
        5: [made(FALSE_POSITIVE, "", 1.5), made(MISS, "veh1", 9.0)],
        9: [made(FALSE_POSITIVE, "", 3.0), made(MISS, "veh1", 2.0, scene="b")],
    }
    received = {frame: unpack_errors(pack_errors(errors)) for frame, errors in frames.items()}
    assert [list(errors) for errors in received.values()] == list(frames.values())
    every = [error for errors in frames.values() for error in errors]
    assert Registry.of(received).errors == keep_first(every)
    standing = Registry.of(received, dropped=2, standing=True)  # signs: the same one in every scene
    assert [(error.track, error.scene) for error in standing if error.kind == MISS] == [("veh1", "a")]
    assert (len(standing), standing.dropped) == (3, 2)
    assert unpack_errors(pack_errors([])) == ()


def test_a_table_of_an_earlier_version_has_no_distances(tmp_path: Path):
    path = tmp_path / "errors.parquet"
    save_errors([made(MISS, "veh1")], path)
    assert load_errors(path) == (made(MISS, "veh1"),)
    pq.write_table(pq.read_table(path).drop_columns("distance_m"), path)
    (error,) = load_errors(path)
    assert np.isnan(error.distance_m)
    assert replace(error, distance_m=12.5) == made(MISS, "veh1")


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_tables_of_errors_are_what_place_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str], ending: str):
    path = tmp_path / f"errors{ending}"
    save_errors([made(MISS, "veh1"), made(MISS, "veh2", 30.0), made(MISS, "veh3", 31.0)], path)
    table = pq.read_table(path) if ending == ".parquet" else pyarrow.csv.read_csv(path)
    assert table.column_names[:6] == ["x", "y", "z", "weight", "kind", "class"]
    (tmp_path / "poles.csv").write_text("id,x,y,z\n4,30,0,6\n5,0,0,6\n")
    with pytest.raises(SystemExit) as stopped:
        run(["place", "--errors", str(path), "--poles", str(tmp_path / "poles.csv"), "--range", "10", "--count", "1"])
    assert not stopped.value.code
    assert "poles 4" in capsys.readouterr().out


def test_a_table_of_another_ending_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="end the name with"):
        save_errors([], tmp_path / "errors.txt")


def test_errors_need_a_task_with_places(drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        run(["errors", "weather", "--data", str(drive.folder), "--out", str(tmp_path / "errors.csv")])
    assert stopped.value.code == 2
    assert "no place in a town" in capsys.readouterr().err


def test_the_same_mistake_is_one_of_the_same_object_or_a_false_box_nearby_in_the_same_scene() -> None:
    def mistake(kind: str, scene: str, track: str, x: float = 0.0) -> PerceptionError:
        return PerceptionError(x, 0.0, 0.0, 1.0, kind, "Car", 0, 0.0, scene, track)

    others = [mistake(MISS, "one", "car3"), mistake(FALSE_POSITIVE, "one", "false_positive0", 10.0)]
    assert is_among(mistake(MISS, "one", "car3", 50.0), others)
    assert not is_among(mistake(MISS, "two", "car3"), others)
    assert is_among(mistake(MISS, "two", "car3"), others, standing=True)
    assert not is_among(mistake(MISS, "one", "car4"), others)
    assert not is_among(mistake(FINAL_ERROR, "one", "car3"), others)
    assert is_among(mistake(FALSE_POSITIVE, "one", "false_positive7", 11.9), others)
    assert not is_among(mistake(FALSE_POSITIVE, "one", "false_positive0", 12.1), others)
    assert not is_among(mistake(FALSE_POSITIVE, "two", "false_positive0", 10.0), others, standing=True)

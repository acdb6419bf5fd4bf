"""`flcav record` and `flcav birdseye` as a user runs them."""

import hashlib
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from waiting import LONGEST_S

from flcav.cli.main import run
from flcav.config import read_config
from flcav.dataset.recording import jobs
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

FLCAV = (sys.executable, "-c", "from flcav.cli.main import run; run()")
RECIPES = Path(__file__).parents[2] / "recipes"
COARSE = {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 16, "azimuth_steps": 360}}}}
SMALL = {
    "town": "suburb",
    "seed": 4,
    "cavs": 2,
    "warmup_s": 35.0,
    "spins_per_scene": 2,
    "scenes": 2,
    "vehicle_rig": COARSE,
}


def flcav(*arguments: object) -> int:
    """Return the exit code of the command."""
    with pytest.raises(SystemExit) as ended:
        run([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def digests(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(SMALL))
    return tmp_path / "recipe.yaml"


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("reference") / "data"
    record(EmbeddedSource(Recipe.model_validate(SMALL)), out)
    return out


@pytest.mark.slow
def test_two_processes_record_the_same_bytes_as_one(recipe: Path, reference: Path, tmp_path: Path):
    command = [*FLCAV, "record", recipe, "--out", tmp_path / "data", "--jobs", "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "recorded 8 frames of 2 scenes" in done.stdout
    assert digests(tmp_path / "data") == digests(reference)


@pytest.mark.slow
def test_a_scene_s_frames_are_recorded_by_several_processes(recipe: Path, tmp_path: Path):
    """Two frames to a part: the traffic of the one scene is simulated once and replayed by whoever is free."""
    long = {**SMALL, "scenes": 1, "spins_per_scene": 20, "every_s": 0.1}
    one, two = tmp_path / "one", tmp_path / "two"
    record(EmbeddedSource(Recipe.model_validate(long)), one)
    recipe.write_text(yaml.safe_dump(long))
    process = subprocess.Popen([*FLCAV, "record", recipe, "--out", two, "--jobs", "2"])
    traffic = two / ".recording" / "suburb-4-000" / "traffic.parquet"
    while not list(traffic.parent.glob("0000[0-9]")):
        assert process.poll() is None
        time.sleep(0.002)
    process.kill()
    process.wait(LONGEST_S)
    simulated = traffic.stat().st_mtime_ns
    record(EmbeddedSource(Recipe.model_validate(long)), two, jobs=1)
    assert digests(one) == digests(two)
    assert (two / "traces" / "suburb-4-000.parquet").stat().st_mtime_ns == simulated


@pytest.mark.slow
def test_a_ray_cluster_records_the_same_bytes(recipe: Path, reference: Path, tmp_path: Path):
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    command = [*FLCAV, "record", recipe, "--out", tmp_path / "data", "--engine", "ray", "--jobs", "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert digests(tmp_path / "data") == digests(reference)


def test_an_unknown_engine_exits_2(recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert flcav("record", recipe, "--out", tmp_path / "data", "--engine", "steam") == 2
    assert "'steam' is not one of 'processes', 'ray'" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_interrupted_then_finished(recipe: Path, reference: Path, tmp_path: Path, number: int):
    out = tmp_path / "data"
    command = [*FLCAV, "record", recipe, "--out", out]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not (out / ".recording" / "suburb-4-000").is_dir():
        assert process.poll() is None
        time.sleep(0.002)
    process.send_signal(number)
    _, said = process.communicate(timeout=LONGEST_S)
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert "Traceback" not in said
    assert not (out / "manifest.json").exists()
    assert flcav("validate", out) == 2
    assert flcav("record", recipe, "--out", out) == 0
    assert digests(out) == digests(reference)


def test_recording_again_does_nothing_and_says_so(recipe: Path, reference: Path, capsys: pytest.CaptureFixture[str]):
    before = digests(reference)
    assert flcav("record", recipe, "--out", reference) == 0
    assert "already recorded, nothing to do" in capsys.readouterr().out
    assert digests(reference) == before


def test_a_number_of_frames_and_a_seed_from_the_command_line(recipe: Path, reference: Path, tmp_path: Path):
    assert flcav("record", recipe, "--out", tmp_path / "data", "--frames", 3) == 0
    few, all_of_them = Dataset.open(tmp_path / "data"), Dataset.open(reference)
    assert few.keys == all_of_them.keys[:3]
    np.testing.assert_array_equal(few.frame(2).lidar["lidar"], all_of_them.frame(2).lidar["lidar"])
    assert flcav("record", recipe, "--out", tmp_path / "other", "--frames", 1, "--seed", 9) == 0
    assert Dataset.open(tmp_path / "other").keys[0].scene == "suburb-9-000"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"colour": "red"}, "unknown field 'colour'"),
        ({"town": "atlantis"}, "unknown town 'atlantis'"),
        ({"poles": [99]}, "field 'poles' = 99"),
        ({"vehicle_rig": {"lidars": {"lidar": {"settings": {"range_m": -1}}}}}, "range_m' = -1"),
    ],
)
def test_bad_recipes_exit_2_with_one_sentence(
    recipe: Path, tmp_path: Path, change: dict, sentence: str, capsys: pytest.CaptureFixture[str]
):
    recipe.write_text(yaml.safe_dump(SMALL | change))
    assert flcav("record", recipe, "--out", tmp_path / "data") == 2
    said = capsys.readouterr().err.strip()
    assert sentence in said
    assert "\n" not in said
    assert not (tmp_path / "data").exists()


def test_another_recipes_folder_exits_2(recipe: Path, reference: Path, capsys: pytest.CaptureFixture[str]):
    assert flcav("record", recipe, "--out", reference, "--seed", 5) == 2
    assert "holds another dataset (different: seed)" in capsys.readouterr().err


def test_a_missing_recipe_exits_2(tmp_path: Path):
    assert flcav("record", tmp_path / "no.yaml", "--out", tmp_path / "data") == 2


def test_output_that_cannot_be_written_exits_1(recipe: Path, capsys: pytest.CaptureFixture[str]):
    assert flcav("record", recipe, "--out", "/proc/flcav/data") == 1
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert "/proc/flcav" in said


def test_a_full_disk_exits_1_and_leaves_no_dataset(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def full(path: Path, data: memoryview) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(jobs, "write_in_pieces", full)
    assert flcav("record", recipe, "--out", tmp_path / "data") == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"flcav: {tmp_path / 'data'}")
    assert said.endswith(": No space left on device")
    monkeypatch.undo()
    assert flcav("validate", tmp_path / "data") == 2


def test_validate_counts_or_complains(reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert flcav("validate", reference) == 0
    assert capsys.readouterr().out == "8 frames, no problems\n"
    other = {**SMALL, "split": "test", "frames": 1}
    record(EmbeddedSource(Recipe.model_validate(other)), tmp_path / "test")
    assert flcav("validate", reference, tmp_path / "test") == 1
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 1
    assert "leakage, they share 1 scene, the first is 'suburb-4-000'" in said[0]


def test_damaged_files_are_recorded_again_from_their_traffic(
    reference: Path, recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data = tmp_path / "data"
    shutil.copytree(reference, data)
    (data / "traces/suburb-4-000.parquet").unlink()
    (data / "lidar/suburb-4-001_0001_cav1.bin").write_bytes(b"")
    assert flcav("record", recipe, "--out", data) == 0
    said = capsys.readouterr()
    first = data / "lidar/suburb-4-001_0001_cav1.bin"
    assert said.err == f"record {data}: {first} is damaged (and 1 more), recorded anew\n"
    assert "recorded 8 frames" in said.out
    assert digests(data) == digests(reference)


def test_damaged_files_of_windows_are_recorded_again(tmp_path: Path):
    """Where windows are recorded near poles alone, no file tells which part of the recording it is of."""
    near = {"poles": [2], "scenes": 1, "window_s": 0.4, "window_every_s": 0.2, "window_range_m": 50.0}
    source, data = EmbeddedSource(Recipe.model_validate(SMALL | near)), tmp_path / "data"
    record(source, data)
    whole = digests(data)
    frames = Dataset.open(data).keys
    assert 6 < len(frames) < source.frame_count(source.scenes()[0])
    (data / f"lidar/{Dataset.open(data).name(len(frames) - 1)}.bin").unlink()
    assert record(source, data)
    assert digests(data) == whole


def test_birdseye_draws_the_frame_asked_for(reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "view.png"
    assert flcav("birdseye", reference, "--frame", "suburb-4-001_0001_cav1", "--out", out) == 0
    assert "suburb-4-001_0001_cav1" in capsys.readouterr().out
    assert min(Image.open(out).size) > 1000
    assert flcav("birdseye", reference, "--frame", "nothing", "--out", tmp_path / "no.png") == 2
    assert not (tmp_path / "no.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["suburb", "grid", "ring", "kitti", "weather", "signs", "signs_suburb", "cooperative"])
def test_the_recipes_we_ship_run_at_toy_scale(name: str, tmp_path: Path):
    recipe = read_config(Recipe, RECIPES / f"{name}.yaml")
    frames = recipe.cavs + 1
    toy = recipe.model_copy(update={"warmup_s": 30.1, "frames": frames})
    record(EmbeddedSource(toy), tmp_path / "data")
    dataset = Dataset.open(tmp_path / "data")
    assert len(dataset) == frames
    assert dataset.manifest.counts.images >= frames * bool(recipe.vehicle_rig.cameras)
    assert flcav("validate", tmp_path / "data") == 0

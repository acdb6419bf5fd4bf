"""What a user can get wrong, or the machine: one sentence on stderr, the right exit code, nothing half-written."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from safetensors import safe_open
from safetensors.torch import save_file

from flcav.cli.main import run
from flcav.dataset.recording.recorder import record
from flcav.perception.objects.model import second_paper, second_tiny
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import config_key, save_network
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.map.town import load_town

COMMAND = (sys.executable, "-c", "from flcav.cli.main import run; run()")
COARSE = {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 16, "azimuth_steps": 360}}}}
RECIPE = {"town": "suburb", "cavs": 2, "warmup_s": 30.0, "spins_per_scene": 1, "vehicle_rig": COARSE}
BUDGET_B = 200_000  # bytes that a file may have where the disk is said to be full
PROBLEM = {
    "budgets_mb": {"wireless": 50, "wireline": 500},
    "tasks": [
        {
            "name": "objects",
            "sample_mb": 1.0,
            "model_mb": 5.0,
            "edge_groups": [2, 2],
            "limits": {"samples": [40, 400], "edge_rounds": [1, 9], "cloud_rounds": [1, 9]},
            "curve": {"model": "additive", "pretrain": {"a": 1.0, "b": 0.3}},
        }
    ],
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recorded") / "data"
    record(EmbeddedSource(Recipe.model_validate(RECIPE)), out)
    return out


@pytest.fixture
def data(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "data"))


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    save_network(OBJECTS, second_tiny(), tmp_path / "tiny.safetensors")
    return tmp_path / "tiny.safetensors"


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that is to fail; return its sentence."""

    def call(*arguments: object, code: int = 2, out: str = "") -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            run([str(argument) for argument in arguments])
        told = capsys.readouterr()
        assert (ended.value.code, told.out) == (code, out)
        return one_sentence(told.err)

    return call


def one_sentence(said: str) -> str:
    """Return the only sentence on stderr."""
    (line,) = said.splitlines()
    assert line.startswith("flcav: ")
    return line.removeprefix("flcav: ")


def shell(*arguments: object, file_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own, whose files may have `file_bytes` at most."""

    def limit() -> None:
        if file_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))

    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=limit, env=environment)


def left_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_a_negative_range_and_an_unknown_town_from_the_shell(tmp_path: Path) -> None:
    backwards = {"lidars": {"lidar": {"settings": {"range_m": -1}}}}
    for change, named in (({"vehicle_rig": backwards}, "range_m' = -1"), ({"town": "atlantis"}, "atlantis")):
        (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(RECIPE | change))
        done = shell("record", tmp_path / "recipe.yaml", "--out", tmp_path / "data")
        assert (done.returncode, done.stdout) == (2, "")
        assert named in one_sentence(done.stderr)
    assert left_in(tmp_path) == ["recipe.yaml"]


@pytest.mark.parametrize("text", ["town: [", "- a list\n", "", b"\xff\xfe"])
def test_a_recipe_that_is_no_mapping(text: str | bytes, tmp_path: Path, refused: Callable[..., str]) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert str(path) in refused("record", path, "--out", tmp_path / "data")
    assert str(tmp_path) in refused("record", tmp_path, "--out", tmp_path / "data")


@pytest.mark.parametrize("command", ["train", "evaluate", "infer", "birdseye"])
def test_a_truncated_point_cloud_in_a_dataset(
    command: str, data: Path, weights: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    cloud = sorted(data.rglob("*.bin"))[0]
    os.truncate(cloud, cloud.stat().st_size - 6)
    out = tmp_path / "out"
    sentence = {
        "train": lambda: refused(
            *("train", "objects", "--data", data, "--out", out, "--epochs", 1), out=f"{data}: 2 vehicle frames\n"
        ),
        "evaluate": lambda: refused("evaluate", "objects", "--data", data, "--weights", weights),
        "infer": lambda: refused("infer", "objects", data, "--weights", weights),
        "birdseye": lambda: refused("birdseye", data, "--out", out / "frame.png"),
    }[command]()
    assert str(cloud) in sentence
    assert "bytes where" in sentence
    assert not out.exists()


def test_a_truncated_cloud(weights: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "cloud.bin").write_bytes(bytes(33))
    assert "truncated" in refused("infer", "objects", tmp_path / "cloud.bin", "--weights", weights, "--json")


def test_an_empty_dataset(data: Path, weights: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    for path in data.glob("*.parquet"):
        pq.write_table(pq.read_table(path).slice(0, 0), path)
    commands = {
        "train": ("--data", data, "--out", tmp_path / "out"),
        "evaluate": ("--data", data, "--weights", weights),
        "infer": (data, "--weights", weights),
    }
    for command, options in commands.items():
        assert "the dataset is empty, it holds no frames" in refused(command, "objects", *options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("table", "column"), [("annotations", "track"), ("annotations", "category"), ("frames", "agent"), ("files", "path")]
)
def test_names_that_are_no_utf8(
    table: str, column: str, data: Path, tmp_path: Path, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = data / f"{table}.parquet"
    rows = pq.read_table(path)
    raw = [b"\xff\xfe" + name.encode() for name in rows[column].to_pylist()]
    names = pa.array(raw, pa.binary()).view(pa.string())
    pq.write_table(rows.set_column(rows.column_names.index(column), rows.schema.field(column), names), path)
    with pytest.raises(SystemExit) as ended:
        run(["validate", str(data)])
    told = capsys.readouterr()
    assert (ended.value.code, told.err) == (1, "")
    if table == "files":  # read by `validate` alone
        assert f"{path}: truncated or grown" in told.out
        return
    assert f"{path}: not a readable Parquet file" in told.out
    assert "UTF8" in refused("birdseye", data, "--out", tmp_path / "frame.png")
    assert "UTF8" in refused("infer", "objects", data)
    assert not (tmp_path / "frame.png").exists()


@pytest.mark.parametrize(
    ("table", "column", "value", "said"),
    [
        ("frames", "scene", "../../scene", "'../../scene' is no name"),
        ("frames", "points", [1, 2], "needs one number of points for each of its lidars"),
        ("frames", "index", 7, "is not spin 7 of cav0"),
        ("poses", "world_from_agent_then", [1.0], "needs 16 numbers for each pose"),
        ("poses", "world_from_agent", [float("nan")] * 16, "is not a rigid transform"),
        ("points", "row", -1, "sees an actor that is not annotated"),
        ("points", "row", 10_000, "sees an actor that is not annotated"),
        ("annotations", "x", float("nan"), "not finite"),
        ("annotations", "category", "tank", "unknown class 'tank'"),
        ("annotations", "track", None, "has empty cells"),
    ],
)
def test_what_nobody_can_have_measured(
    table: str, column: str, value: object, said: str, data: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    path = data / f"{table}.parquet"
    rows = pq.read_table(path)
    cells = [value, *rows[column].to_pylist()[1:]]
    field = rows.schema.field(column)
    pq.write_table(rows.set_column(rows.column_names.index(column), field, pa.array(cells, field.type)), path)
    assert said in refused("birdseye", data, "--out", tmp_path / "frame.png")
    assert said in refused("export", "opv2v", data, "--out", tmp_path / "out", "--validation", "0")
    assert left_in(tmp_path) == left_in(data.parent)
    with pytest.raises(SystemExit) as ended:
        run(["validate", str(data)])
    assert ended.value.code == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scenarios": [{"kind": "stalled_vehicle", "at_s": 20, "lasts_s": "1e309"}]}, "lasts_s' = inf: "),
        ({"spins_per_scene": 10**400}, "spins_per_scene"),
        ({"spins_per_scene": 50_000}, "put the last spin at 50029 s, after 36000 s"),
        ({"weather": {"sun_azimuth_deg": 1e300}}, "sun_azimuth_deg' = 1e+300: "),
        ({"vehicle_rig": {"radars": {"radar": {"settings": {"range_cell_m": 1e-320}}}}}, "range_cell_m' = "),
    ],
)
def test_numbers_that_nobody_can_mean_in_a_recipe(
    change: dict[str, object], said: str, tmp_path: Path, refused: Callable[..., str]
) -> None:
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(RECIPE | change))
    assert said in refused("record", tmp_path / "recipe.yaml", "--out", tmp_path / "data")
    assert left_in(tmp_path) == ["recipe.yaml"]


def test_numbers_that_nobody_can_mean_in_a_history_and_a_graph(tmp_path: Path, refused: Callable[..., str]) -> None:
    history = tmp_path / "history.csv"
    history.write_text("samples,edge_rounds,cloud_rounds,accuracy\n1e-310,0,0,0.1\n100,0,0,0.5\n1000,0,0,0.7\n")
    for model in ("additive", "effective"):
        assert "samples = 1e-310 must be 0, or a number from 1e-09 to 1e+09" in refused(
            "fit", history, "--model", model
        )
    text = (Path(__file__).parents[2] / "recipes" / "graphs" / "three_layers.yaml").read_text()
    for name, changed in (("alpha", "b: 0.10, alpha: 1e-320"), ("b", "b: 1e-320, alpha: 0.1")):
        (tmp_path / "graph.yaml").write_text(text.replace("b: 0.10, alpha: 0.1", changed))
        assert f"{name}' = 1e-320: " in refused("allocate", tmp_path / "graph.yaml")
    steep = PROBLEM["tasks"][0] | {"curve": {"model": "additive", "pretrain": {"a": 1.0, "b": 200.0, "x0": 1e-9}}}
    steep["limits"] = steep["limits"] | {"samples": [0, 400]}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(PROBLEM | {"tasks": [steep]}))
    assert "curve of task 'objects' predicts an error of inf" in refused("allocate", tmp_path / "problem.yaml")
    slight = PROBLEM["tasks"][0] | {"curve": {"model": "additive", "pretrain": {"a": 5e-324, "b": 0.4}}}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(PROBLEM | {"tasks": [slight]}))
    assert "pretrain.a' = 5e-324" in refused("allocate", tmp_path / "problem.yaml")


@pytest.mark.parametrize("text", ["a: " + "[" * 2000 + "]" * 2000, "a: 2020-13-45", "{[1]: 2}", "a: &b [*b]"])
def test_yaml_that_the_parser_trips_over(text: str, tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "a.yaml").write_text(text)
    for command in (("record", tmp_path / "a.yaml", "--out", tmp_path / "data"), ("allocate", tmp_path / "a.yaml")):
        assert str(tmp_path / "a.yaml") in refused(*command)


def test_a_town_is_looked_for_beside_the_recipe_too(
    tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tmp_path / "recipes" / "recipe.yaml"
    recipe.parent.mkdir()
    recipe.write_text(yaml.safe_dump(RECIPE | {"town": "town02", "poles": [99]}))
    monkeypatch.chdir(tmp_path)
    sentence = refused("record", recipe, "--out", tmp_path / "data")
    assert "unknown town 'town02'; known towns: suburb, grid, ring, arterial, hilly_suburb, hilly_grid" in sentence
    assert "hilly_arterial, or a folder" in sentence
    assert f"there is no {recipe.parent / 'town02'} nor {tmp_path / 'town02'}" in sentence
    shutil.copytree(load_town("suburb").net.parent, recipe.parent / "town02")
    assert "field 'poles' = 99: no pole of town02" in refused("record", recipe, "--out", tmp_path / "data")
    (recipe.parent / "town02").rename(tmp_path / "town02")
    assert "field 'poles' = 99: no pole of town02" in refused("record", recipe, "--out", tmp_path / "data")


def test_weights_of_another_network(data: Path, weights: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    save_file({"layer": torch.zeros(3)}, tmp_path / "foreign.safetensors")
    with safe_open(weights, framework="pt") as file:
        config = {config_key(OBJECTS): file.metadata()[config_key(OBJECTS)]}
    tensors = {name: tensor.contiguous() for name, tensor in second_paper().state_dict().items()}
    save_file(tensors, tmp_path / "mixed.safetensors", config)
    whole = weights.read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    for name, said in (("foreign", "another network"), ("mixed", "another network"), ("cut", "damaged")):
        path = tmp_path / f"{name}.safetensors"
        for command in (("evaluate", "objects", "--data", data), ("infer", "objects", data)):
            sentence = refused(*command, "--weights", path)
            assert said in sentence
            assert str(path) in sentence


def test_a_plan_over_budget(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(PROBLEM))
    with pytest.raises(SystemExit) as ended:
        run(["allocate", str(tmp_path / "problem.yaml"), "--json"])
    assert ended.value.code == 2
    told = capsys.readouterr()
    sentence = one_sentence(told.err)
    assert json.loads(told.out) == {"status": "infeasible", "message": sentence}
    assert "costs 80 MB of wireless uplink" in sentence  # 40 samples, 2 rounds of 4 vehicles
    assert "budgets_mb.wireless = 50" in sentence


def test_output_below_a_file(data: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "file").write_text("kept")
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(RECIPE))
    below = tmp_path / "file" / "out"
    for command in (
        ("record", tmp_path / "recipe.yaml", "--out", below),
        ("train", "objects", "--data", data, "--out", below, "--epochs", 1),
        ("birdseye", data, "--out", below / "frame.png"),
        ("demo", "--out", below),
    ):
        assert refused(*command).startswith(str(below)), command[0]
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.slow
def test_a_full_disk_while_weights_are_written(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = shell("train", "objects", "--data", data, "--out", out, "--epochs", 1, file_bytes=BUDGET_B)
    assert done.returncode == 1
    assert one_sentence(done.stderr) == f"{out / 'weights.safetensors'}: File too large"
    assert all(name.startswith("events/") for name in left_in(out))  # curves, whole as far as they go


@pytest.mark.slow
def test_a_full_disk_while_a_picture_is_written(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out" / "frame.png"
    done = shell("birdseye", data, "--out", out, file_bytes=10_000)
    assert done.returncode == 1
    assert one_sentence(done.stderr) == f"{out}: File too large"
    assert left_in(out.parent) == []


@pytest.mark.slow
def test_a_demo_into_the_folder_of_another(tmp_path: Path, refused: Callable[..., str]) -> None:
    step = tmp_path / "work" / "suburb-pool-objects"
    step.mkdir(parents=True)
    (step / "done.json").write_text(json.dumps({"fingerprint": "of another seed", "value": {}}))
    said = refused("demo", "--out", tmp_path)
    assert said.startswith(f"{tmp_path / 'work'}: did suburb-pool-objects by another configuration; choose another")
    assert left_in(tmp_path) == ["work/suburb-pool-objects/done.json"]


def test_a_pole_outside_the_town_of_the_map_is_named(tmp_path: Path, refused: Callable[..., str]) -> None:
    (tmp_path / "errors.csv").write_text("x,y,z\n10,20,1\n")
    (tmp_path / "poles.csv").write_text("id,x,y,z\n1,30,20,6\n2,1000000000,20,6\n")
    files = ("--errors", tmp_path / "errors.csv", "--poles", tmp_path / "poles.csv")
    drawn = ("--town", "grid", "--map", tmp_path / "map.png")
    assert "poles.csv: row 2 lies at 1000000000, 20, outside grid" in refused(
        "place", *files, "--range", "40", "--count", "1", *drawn
    )
    assert not (tmp_path / "map.png").exists()


def test_a_listed_file_with_a_name_too_long_is_missing(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = data / "files.parquet"
    rows = pq.read_table(path)
    names = pa.array(["x" * 5000, *rows["path"].to_pylist()[1:]], rows.schema.field("path").type)
    pq.write_table(rows.set_column(rows.column_names.index("path"), rows.schema.field("path"), names), path)
    with pytest.raises(SystemExit) as ended:
        run(["validate", str(data)])
    told = capsys.readouterr()
    assert (ended.value.code, told.err) == (1, "")
    assert "xxx ...: missing" in told.out


RECIPES = {
    "dataset recipe": "recipes/weather.yaml",
    "run recipe": "recipes/runs/demo.yaml",
    "allocation problem": "recipes/allocation/objects.yaml",
}
READERS = {
    "dataset recipe": ("record", "--out", "out"),
    "run recipe": ("run", "--out", "out"),
    "allocation problem": ("allocate",),
}


@pytest.mark.parametrize("given", RECIPES)
@pytest.mark.parametrize("wanted", READERS)
def test_a_recipe_of_another_kind_is_named_with_the_command_that_reads_it(wanted, given, refused):
    if given != wanted:
        command, *more = READERS[wanted]
        assert (
            f" {given}, and a{'n' * (wanted[0] == 'a')} {wanted} is wanted; `flcav {READERS[given][0]} {RECIPES[given]}"
            in (refused(command, RECIPES[given], *more))
        )


@pytest.mark.parametrize(
    ("command", "meant"),
    [
        (("towns", "show", "subrub"), "suburb"),
        (("trian",), "train"),
        (("towns", "shwo"), "show"),
        (("train", "weathr", "--data", "d", "--out", "o"), "weather"),
        (("train", "weather", "--daat", "d"), "--data"),
        (("place", "--errors", "e", "--poles", "p", "--method", "exakt"), "exact"),
        (("export", "kiti", "d", "--out", "o"), "kitti"),
        (("reproduce", "fig3", "--out", "o"), "fig3b"),
    ],
)
def test_a_misspelt_name_is_suggested_once(command, meant, refused):
    told = refused(*command).lower()
    assert told.count("did you mean") == 1
    assert f"'{meant}'" in told.split("did you mean")[1]


def test_missing_files_of_place_are_told_before_its_options(refused):
    assert "nowhere.csv: no such file" in refused("place", "--errors", "nowhere.csv", "--poles", "nowhere.csv")


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        ("budgets_mb", "budget_mb", "(did you mean 'budgets_mb'?)"),
        ("wireless: 4000", "wireless: 4 GB", "must be a number of MB, without the unit: 4000"),
    ],
)
def test_fields_and_numbers_that_users_guess_are_told_as_they_are_written(right, wrong, told, tmp_path, refused):
    text = Path("recipes/allocation/objects.yaml").read_text(encoding="utf-8")
    (tmp_path / "problem.yaml").write_text(text.replace(right, wrong), encoding="utf-8")
    assert told in refused("allocate", tmp_path / "problem.yaml")


@pytest.mark.parametrize(("accuracy", "told"), [("55", "55 % is 0.55"), ("55%", "without the unit: 0.55")])
def test_accuracies_in_per_cent_are_told_as_shares(accuracy, told, tmp_path, refused):
    (tmp_path / "history.csv").write_text(f"task,stage,resource,accuracy\na,pretrain,10,{accuracy}\n")
    assert told in refused("fit", tmp_path / "history.csv")


def test_a_picture_takes_the_place_of_no_other_kind_of_file(
    data: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("town: suburb")
    for command in (("birdseye", data, "--out"), ("camera", data, "--out"), ("towns", "show", "suburb", "--out")):
        assert refused(*command, recipe) == f"--out {recipe}: a PNG picture is written; name it {tmp_path}/recipe.png"
    assert recipe.read_text() == "town: suburb"

"""Groups on request, deployed: vehicles check, ask, offer and tell losses; the files are those of the embedded run."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from waiting import read_all_traffic

from flcav.fleet.authority import open_registry
from flcav.fleet.up import VEHICLES

RECIPE = {
    "seed": 1,
    "size": "toy",
    "tasks": {"weather": {"plan": {"samples": 4, "edge_rounds": 2, "cloud_rounds": 1}}},
    "regions": {"suburb": {"role": "pretrain"}, "ring": {"role": "federate", "vehicles": 2}},
    "budgets_mb": {"wireless": 9, "wireline": 9},
    "placement": {"rule": "none"},
}
EVERYBODY = {"excess": 1.0, "range_m": 2000, "most": 1, "patience": 2}  # both ask, and one is called
NOBODY = {"excess": 1000.0, "range_m": 10_000, "most": 1}
STEP = "ring-federate-weather"
ASKING_BYTES = 20_000  # more than a check, a request and an offer with what Flower adds; an update has 250 kB


def federate(recipe: Path, out: Path, *more: str) -> dict:
    """Run a federation in the folder `out`; return its group."""
    command = [sys.executable, "-m", "flcav", "federate", str(recipe), "--out", str(out), "--jobs", "1", *more]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads((out / "federation.json").read_text())["federations"][0]["result"]["group"]


def write_recipe(path: Path, requests: dict) -> Path:
    path.write_text(yaml.safe_dump({**RECIPE, "federation": {"requests": requests}}))
    return path


def read_kept(out: Path) -> dict[str, bytes]:
    """Return the files of weights, ledgers and results of the group's rounds."""
    paths = [path for path in (out / "work" / STEP).iterdir() if path.suffix in (".safetensors", ".parquet")]
    return {path.name: path.read_bytes() for path in [*paths, out / "work" / STEP / "result.json"]}


@pytest.fixture(scope="module")
def embedded(tmp_path_factory):
    out = tmp_path_factory.mktemp("embedded")
    federate(write_recipe(out / "run.yaml", EVERYBODY), out)
    return out


@pytest.fixture
def begin(tmp_path, embedded):
    """Return a function that begins a folder with the data and the pretraining of the embedded one."""

    def copy(name: str) -> Path:
        shutil.copytree(embedded / "work", tmp_path / name / "work", ignore=shutil.ignore_patterns(STEP))
        return tmp_path / name

    return copy


def count_bytes(folder: Path) -> dict[str, int]:
    """Return the bytes that each vehicle's app has sent."""
    return {name: own.content_up for name, own in read_all_traffic(folder).vehicles.items()}


def test_same_weights_ledger_and_record(tmp_path, embedded, begin, deployment):
    folder, out = deployment.folder, begin("deployed")
    vehicles = [own.name for own in open_registry(folder).list_vehicles()]
    before = count_bytes(folder)
    recipe = write_recipe(tmp_path / "run.yaml", EVERYBODY)
    group = federate(recipe, out, "--runtime", "flower", "--fleet", str(folder))
    expected, found = read_kept(embedded), read_kept(out)
    assert expected.keys() == found.keys()
    assert [name for name, data in expected.items() if data != found[name]] == []
    (member,) = group["members"]
    assert {name for name, own in group["vehicles"].items() if own["asks"]} == {"ring/cav0", "ring/cav1"}
    own = vehicles[["ring/cav0", "ring/cav1"].index(member)]
    trained = {path.parent.name for path in (folder / VEHICLES).glob("*/*.state.bin")}
    assert trained <= {own}  # nobody else was ever asked to train
    sent = {name: count - before.get(name, 0) for name, count in count_bytes(folder).items()}
    (other,) = {*vehicles[:2]} - {own}
    assert 0 < sent[other] < ASKING_BYTES
    assert sent[own] > 10 * ASKING_BYTES


def test_an_fl_request_leads_to_a_group_once(tmp_path, begin, deployment):
    folder, recipe = deployment.folder, write_recipe(tmp_path / "run.yaml", NOBODY)
    vehicle = open_registry(folder).list_vehicles()[1].name  # of ring/cav1
    about = ["--task", "weather", "--loss", "2.5", "--frames", "12", "--at", "104", "-31"]
    command = [sys.executable, "-m", "flcav", "fleet", "request", str(folder / VEHICLES / vehicle), *about]
    assert subprocess.run(command, check=False).returncode == 0
    where = "--runtime", "flower", "--fleet", str(folder)
    group = federate(recipe, begin("asked"), *where)
    assert group["members"] == ["ring/cav1"]
    assert [(name, own.get("told"), own["asks"]) for name, own in group["vehicles"].items()] == [
        ("ring/cav0", None, False),
        ("ring/cav1", 2.5, True),
    ]
    told = subprocess.run(
        [sys.executable, "-m", "flcav", "fleet", "status", str(folder)], capture_output=True, text=True, check=True
    ).stdout
    assert f"{vehicle} asks for federated learning of weather: loss 2.5" in told
    assert "a group was formed" in told
    again = federate(recipe, begin("again"), *where)
    assert (again["members"], again["lead"]) == ([], "")  # nobody asks

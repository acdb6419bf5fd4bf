"""A town made from an OpenDRIVE map, recorded as a user would, and its dataset without the town's folder."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from PIL import Image

from flcav.cli.main import run
from flcav.dataset.store import Dataset

pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")

CROSS = Path(__file__).parents[1] / "data" / "cross.xodr"
REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
ASKED = "FLCAV_REAL_DATA" in os.environ  # else CARLA's towns alone, which take less time
MAPS = sorted([*REAL.glob("carla_maps/*.xodr"), *(REAL.glob("opendrive/*.xodr") if ASKED else ())])
TOWNS = ("Town02", "Town10HD")  # CARLA's
SMALL = {"channels": 16, "azimuth_steps": 360}
RECIPE: dict[str, Any] = {
    "seed": 1,
    "cavs": 2,
    "poles": "all",
    "warmup_s": 40.0,
    "spins_per_scene": 2,
    "vehicle_rig": {
        "lidars": {"lidar": {"mount": {"z": 1.85}, "settings": SMALL}},
        "cameras": {"front": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 320, "height": 192}}},
    },
    "pole_rig": {
        "lidars": {"lidar": {"settings": {**SMALL, "down_deg": -45}}},
        "cameras": {"watch": {"mount": {"pitch_deg": 20}, "settings": {"width": 320, "height": 192}}},
    },
}


def flcav(*arguments: object) -> None:
    with pytest.raises(SystemExit) as ended:
        run([str(argument) for argument in arguments])
    assert not ended.value.code, arguments


def recorded(xodr: Path, folder: Path, **changes: object) -> Path:
    """Import a map, name its folder in a recipe, record and validate that."""
    flcav("towns", "import", xodr, "--out", folder / "mine")
    (folder / "recipe.yaml").write_text(yaml.safe_dump({**RECIPE, "town": str(folder / "mine"), **changes}))
    flcav("record", folder / "recipe.yaml", "--out", folder / "data")
    flcav("validate", folder / "data")
    return folder / "data"


def test_a_dataset_brings_its_town_along(tmp_path: Path):
    data = recorded(CROSS, tmp_path)
    kept = data / "town" / "mine"
    for name in ("town.net.xml", "town.yaml"):
        assert (kept / name).read_bytes() == (tmp_path / "mine" / name).read_bytes()
    shutil.rmtree(tmp_path / "mine")
    town = Dataset.open(data).town()
    assert town is not None
    assert town.name == "mine"
    flcav("export", "nuscenes", data, "--out", tmp_path / "nuscenes")
    assert np.asarray(Image.open(tmp_path / "nuscenes" / "maps" / "map.png")).any()


def test_a_dataset_of_a_slope_is_tilted(tmp_path: Path):
    profile = (
        '<elevationProfile><elevation s="0" a="10" b="0.08" c="0" d="0"/></elevationProfile><lateralProfile>'
        '<superelevation s="0" a="0.04" b="0" c="0" d="0"/></lateralProfile><lanes>'
    )
    text = CROSS.read_text()
    first, then = text.index("<road"), text.index('<road name="way')
    xodr = tmp_path / "slope.xodr"
    level = '<elevationProfile><elevation s="0" a="10" b="0" c="0" d="0"/></elevationProfile><lanes>'
    xodr.write_text(text[:first] + text[first:then].replace("<lanes>", profile) + text[then:].replace("<lanes>", level))
    lidar = {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": SMALL}}}
    data = Dataset.open(recorded(xodr, tmp_path, poles=[], vehicle_rig=lidar, pole_rig="roadside"))
    assert data.manifest.format == 3
    town, trace = data.town(), data.trace(data.keys[0].scene)
    assert town is not None
    assert town.relief is not None
    assert trace is not None
    for i in range(len(data)):
        frame = data.frame(i)
        x, y, z = frame.world_from_agent[:3, 3]
        assert z == pytest.approx(town.ground(x, y), abs=0.1)
        ahead, nose = frame.world_from_agent[:3, 0], frame.world_from_agent[:3, 3] + 2 * frame.world_from_agent[:3, 0]
        assert ahead[2] == pytest.approx((town.ground(*nose[:2]) - z) / 2, abs=0.05)
        boxes = frame.annotations.boxes
        assert boxes.tilt is not None
        vehicles = boxes.label != "pedestrian"
        feet = boxes.center - boxes.rotations()[:, :, 2] * boxes.size[:, 2:] / 2
        np.testing.assert_allclose(feet[vehicles, 2], town.grounds(*feet[vehicles, :2].T), atol=0.1)
    steep = np.abs(trace.tilts(0)[trace.present[0]])
    assert np.degrees(steep[:, 0].max()) == pytest.approx(4.57, abs=1.0)
    flcav("export", "opv2v", data.folder, "--out", tmp_path / "opv2v", "--validation", 0)


def test_a_folder_whose_name_no_file_can_have(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    flcav("towns", "import", CROSS, "--out", tmp_path / "town")
    (tmp_path / "town").rename(tmp_path / "my town")
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump({**RECIPE, "town": str(tmp_path / "my town")}))
    with pytest.raises(SystemExit) as ended:
        run(["record", str(tmp_path / "recipe.yaml"), "--out", str(tmp_path / "data")])
    assert ended.value.code == 2
    assert "the folder's name must be letters, digits, - and _" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
@pytest.mark.skipif(not MAPS, reason="the maps are not part of the project")
@pytest.mark.parametrize("path", MAPS, ids=lambda path: path.stem)
def test_real_maps_are_driven_recorded_and_valid(path: Path, tmp_path: Path):
    """CARLA's towns show lights and signs, which cameras see; the others are seen by one LiDAR alone."""
    if path.stem not in TOWNS:
        rig = {"lidars": RECIPE["vehicle_rig"]["lidars"]}
        recorded(path, tmp_path, cavs=1, poles=[], warmup_s=5.0, spins_per_scene=1, vehicle_rig=rig)
        return
    data = recorded(path, tmp_path)
    signs = pq.read_table(data / "signs.parquet").to_pydict()
    states = {state for kind, state in zip(signs["kind"], signs["state"]) if kind == "signal"}
    assert {"red", "green"} <= states
    assert any(kind.startswith("speed") for kind in signs["kind"])
    categories = set(pq.read_table(data / "annotations.parquet")["category"].to_pylist())
    assert {"car", "pedestrian"} <= categories

"""`flcav view --save`, read back by Rerun's own reader."""

import importlib
import importlib.util
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from painted_source import CATEGORIES, PaintedSource
from scipy.spatial.transform import Rotation

from flcav.cli.main import run
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.interface.wording import format_install_command
from flcav.world.map.lanes import map_layers
from flcav.world.map.town import load_town

SPINS = 2
WITHOUT_RERUN = importlib.util.find_spec("rerun") is None
needs_rerun = pytest.mark.skipif(WITHOUT_RERUN, reason="rerun-sdk (170 MB, the extra 'view') is not installed")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("painted") / "dataset"
    record(PaintedSource(2, spins=SPINS, town="suburb"), folder)
    return Dataset.open(folder)


def _view(dataset: Dataset, *arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        run(["view", str(dataset.folder), *arguments])
    return int(end.value.code or 0)


def _read(path: Path) -> dict[str, dict[int, dict[str, list]]]:
    """Return entity -> spin (-1 for what is static) -> component -> values."""
    chunk = importlib.import_module("rerun.chunk")
    found: dict[str, dict[int, dict[str, list]]] = defaultdict(lambda: defaultdict(dict))
    for part in chunk.RrdReader(path).stream():
        batch = part.to_record_batch()
        spins = [-1] * part.num_rows if part.is_static else batch["spin"].to_pylist()
        for name in batch.schema.names:
            if ":" in name:
                for spin, value in zip(spins, batch[name].to_pylist()):
                    found[part.entity_path][spin][name.partition(":")[2]] = value
    return found


@needs_rerun
def test_a_recording_holds_points_boxes_tracks_and_pictures(dataset: Dataset, tmp_path: Path):
    assert _view(dataset, "--save", str(tmp_path / "a.rrd")) == 0
    found = _read(tmp_path / "a.rrd")
    for i in dataset.select(scenes=[dataset.manifest.scenes[0]]):
        frame = dataset.frame(i)
        agent = f"/world/agents/{frame.agent}"
        place = found[agent][frame.index]
        np.testing.assert_allclose(place["translation"][0], frame.world_from_agent[:3, 3], atol=1e-5)
        points = found[f"{agent}/lidar"][frame.index]["positions"]
        np.testing.assert_array_equal(np.array(points, np.float32), frame.lidar["lidar"][:, :3])
        for name, picture in frame.images.items():
            assert found[f"{agent}/{name}"][frame.index]["resolution"][0] == [*picture.rgb.shape[1::-1]]
            assert len(found[f"{agent}/{name}/image"][frame.index]["blob"][0]) > 100
            shown = (frame.annotations.views[name].pixels > 0).sum()
            assert len(found[f"{agent}/{name}/image/actors"][frame.index]["centers"]) == shown
        for name, echoes in frame.radar.items():
            away = np.linalg.norm(found[f"{agent}/{name}"][frame.index]["positions"], axis=1)
            np.testing.assert_allclose(away, echoes[:, 0], rtol=1e-5)
    actors, tracks = found["/world/actors"], found["/world/tracks"]
    for spin in range(SPINS):
        assert actors[spin]["labels"] == [f"{name} veh{i}" for i, name in enumerate(CATEGORIES)]
        assert [len(line) for line in tracks[spin]["strips"]] == [spin + 1] * len(CATEGORIES)
    last = dataset.frame(dataset.select(scenes=[dataset.manifest.scenes[0]])[-1]).annotations.boxes
    np.testing.assert_allclose(actors[SPINS - 1]["centers"], last.center, atol=1e-4)
    np.testing.assert_allclose(2 * np.array(actors[SPINS - 1]["half_sizes"]), last.size, atol=1e-4)


@needs_rerun
def test_a_recording_holds_the_map_of_its_town(dataset: Dataset, tmp_path: Path):
    assert _view(dataset, "--save", str(tmp_path / "a.rrd")) == 0
    found, layers = _read(tmp_path / "a.rrd"), map_layers(load_town("suburb"))
    for name in ("roads", "sidewalks", "crossings", "markings"):
        assert len(found[f"/world/map/{name}"][-1]["strips"]) == len(getattr(layers, name))
    x_min, y_min, *_ = np.array(found["/world/map/roads"][-1]["strips"][0]).min(axis=0)
    np.testing.assert_allclose((x_min, y_min), layers.roads[0].min(axis=0), rtol=1e-5)


@needs_rerun
def test_on_slopes_the_map_lies_on_the_ground_and_boxes_are_tilted(tmp_path: Path):
    record(PaintedSource(1, spins=SPINS, town="hilly_ring", tilted=(0,), cameras=False), tmp_path / "hills")
    hills, town = Dataset.open(tmp_path / "hills"), load_town("hilly_ring")
    assert _view(hills, "--save", str(tmp_path / "a.rrd")) == 0
    found = _read(tmp_path / "a.rrd")
    for name in ("roads", "sidewalks", "crossings", "lanes", "markings"):
        drawn = np.concatenate([np.array(strip) for strip in found[f"/world/map/{name}"][-1]["strips"]])
        assert np.ptp(drawn[:, 2]) > 1
        np.testing.assert_allclose(drawn[:, 2], town.grounds(*drawn[:, :2].T), atol=1e-3)
    boxes = hills.frame(len(hills) - 1).annotations.boxes
    assert boxes.tilt is not None
    turned = Rotation.from_quat(found["/world/actors"][SPINS - 1]["quaternions"]).as_matrix()
    np.testing.assert_allclose(turned, [boxes.pose(i)[:3, :3] for i in range(len(boxes))], atol=1e-6)
    for i, line in enumerate(found["/world/tracks"][SPINS - 1]["strips"]):
        foot = boxes.pose(i) @ (0, 0, -boxes.size[i, 2] / 2, 1)
        np.testing.assert_allclose(line[-1], foot[:3], atol=1e-4)


@needs_rerun
def test_a_scene_can_be_chosen(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    names = dataset.manifest.scenes
    assert _view(dataset, "--scene", names[1], "--save", str(tmp_path / "a.rrd")) == 0
    assert f"scene {names[1]}, {2 * SPINS} frames" in capsys.readouterr().out
    assert _view(dataset, "--scene", "other", "--save", str(tmp_path / "b.rrd")) == 2
    assert f"no scene 'other'; it has {names[0]}, {names[1]}" in capsys.readouterr().err
    assert _view(dataset, "--save", str(tmp_path / "a.txt")) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]


@pytest.mark.skipif(not WITHOUT_RERUN, reason="rerun-sdk is installed")
def test_without_rerun_one_sentence_says_how_to_get_it(dataset: Dataset, capsys: pytest.CaptureFixture[str]):
    assert _view(dataset) == 2
    assert format_install_command("view") in capsys.readouterr().err


@needs_rerun
def test_without_a_display_or_a_viewer_there_is_one_sentence(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    if sys.platform == "linux":
        assert _view(dataset) == 2
        assert "no display" in capsys.readouterr().err
    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.setenv("PATH", "")
    assert _view(dataset) == 2
    assert capsys.readouterr().err.startswith("flcav: flcav view has no viewer to show it in (")

"""A user's rig with LiDARs whose spin takes time: recorded, read back, checked, exported."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from test_record_sensors import resign

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.frame_checks import check_points
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.sensors.frame import Frame
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

RECIPE: dict[str, Any] = {
    "town": "grid",
    "seed": 3,
    "cavs": 2,
    "poles": [2],
    "warmup_s": 40.0,
    "spins_per_scene": 2,
    "vehicle_rig": {
        "lidars": {
            "roof": {"mount": {"x": -0.3, "z": 1.9, "yaw_deg": 5}, "settings": {"beams": "vlp16", "rolling": True}},
            "bumper": {"mount": {"x": 2.4, "z": 0.6}, "settings": {"channels": 8, "rolling": True, "rate_hz": 5}},
            "still": {"mount": {"z": 1.8}, "settings": {"channels": 8}},
        },
    },
    "pole_rig": {"lidars": {"lidar": {"settings": {"channels": 32, "down_deg": -45, "rolling": True}}}},
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rolling")
    (folder / "recipe.yaml").write_text(yaml.safe_dump(RECIPE, sort_keys=False))
    with pytest.raises(SystemExit) as ended:
        run(["record", str(folder / "recipe.yaml"), "--out", str(folder / "data")])
    assert not ended.value.code
    return folder / "data"


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "data"))


def first(folder: Path) -> Frame:
    return Dataset.open(folder).frame(0)


def test_times_come_back(recorded: Path):
    source = EmbeddedSource(Recipe.model_validate(RECIPE))
    seen, stored = next(source.frames(source.scenes()[0])), first(recorded)
    assert list(stored.point_times) == ["roof", "bumper"]
    for name, times in seen.point_times.items():
        np.testing.assert_array_equal(stored.point_times[name], times)
        assert len(times) == len(stored.lidar[name])
    spans = {name: float(np.ptp(times)) for name, times in stored.point_times.items()}
    assert spans == {"roof": pytest.approx(0.1, abs=1e-3), "bumper": pytest.approx(0.2, abs=2e-3)}


def test_a_rolling_recording_has_no_problems(recorded: Path):
    assert validate(recorded) == []


def test_points_are_judged_at_their_times(recorded: Path):
    """Where times are said to be other than they were, points lie outside the boxes of what moves."""
    dataset = Dataset.open(recorded)
    frames = [dataset.frame(i) for i in range(len(dataset))]
    trace = dataset.trace(frames[0].scene)
    assert not any(problem for frame in frames for problem in check_points(frame, trace))
    for frame in frames:
        for times in frame.point_times.values():
            times *= -1
    assert any("lie outside the box" in problem for frame in frames for problem in check_points(frame, trace))


@pytest.mark.parametrize("change", [lambda times: times + 0.2, lambda times: times * np.nan])
def test_impossible_times(folder: Path, change: Any):
    path = folder / "roof" / "grid-3-000_0000_cav0.times.bin"
    change(np.fromfile(path, "<f4")).astype("<f4").tofile(path)
    resign(folder)
    assert any("'roof' has a point that was measured in no spin" in problem for problem in validate(folder))


def test_missing_times(folder: Path):
    path = folder / "roof" / "grid-3-000_0000_cav0.times.bin"
    path.unlink()
    assert f"{path}: missing" in validate(folder)
    with pytest.raises(InputError, match=r"grid-3-000_0000_cav0\.times\.bin: missing from the dataset"):
        first(folder)


def test_times_without_their_points(folder: Path):
    path = folder / "roof" / "grid-3-000_0000_cav0.times.bin"
    path.write_bytes(path.read_bytes()[:-4])
    resign(folder)
    assert any("bytes where" in problem for problem in validate(folder))


def test_mcap_has_the_times(recorded: Path, tmp_path: Path):
    with pytest.raises(SystemExit) as ended:
        run(["export", "mcap", str(recorded), "--out", str(tmp_path / "mcap")])
    assert not ended.value.code
    frame = first(recorded)
    with (tmp_path / "mcap" / f"{frame.scene}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = [f"/{frame.agent}/{name}/points" for name in frame.lidar]
        clouds = {}
        for _, channel, _, message in reader.iter_decoded_messages(topics):
            clouds.setdefault(channel.topic, message)
    cloud = clouds[f"/{frame.agent}/roof/points"]
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "intensity", "time"]
    rows = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
    np.testing.assert_array_equal(rows[:, 4], frame.point_times["roof"])
    np.testing.assert_array_equal(rows[:, :4], frame.lidar["roof"])
    assert [field.name for field in clouds[f"/{frame.agent}/still/points"].fields] == ["x", "y", "z", "intensity"]


def test_the_listing_has_the_times(recorded: Path):
    files = pq.read_table(recorded / "files.parquet")["path"].to_pylist()
    assert sum(name.endswith(".times.bin") for name in files) == 2 * (2 * 2 + 1)

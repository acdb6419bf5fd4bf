"""Formats of a user's own, named as module:NAME: that of docs/formats.md, and what is none."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from painted_source import PaintedSource

from flcav.cli.main import run
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.geometry import inverse

PAGE = Path(__file__).parents[3] / "docs" / "formats.md"


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dataset:
    """A dataset in the working directory, beside the module that the page shows."""
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [path for path in sys.path if path])
    monkeypatch.delitem(sys.modules, "clouds", raising=False)
    Path("clouds.py").write_text(code, encoding="utf-8")
    record(PaintedSource(2, spins=2), tmp_path / "data")
    return Dataset.open(tmp_path / "data")


def ended(*command: str) -> int:
    with pytest.raises(SystemExit) as end:
        run([*command])
    return int(end.value.code or 0)


def test_the_format_that_is_shown_holds_what_the_dataset_holds(data: Dataset, capsys: pytest.CaptureFixture[str]):
    assert not ended("export", "clouds:EXPORT", "data", "--out", "clouds")
    assert f"exported {len(data)} frames, " in capsys.readouterr().out
    assert not ended("import", "clouds:IMPORT", "clouds", "--out", "again")
    again = Dataset.open(Path("again"))
    assert again.manifest.imported == "clouds"
    assert len(again) == len(data)
    assert not validate(Path("again"))
    for i, key in enumerate(sorted(str(data.frame(i).key) for i in range(len(data)))):
        before, after = data.frame(data.number(key)), again.frame(i)
        np.testing.assert_array_equal(after.lidar["lidar"], before.lidar["lidar"])
        seen = before.annotations.boxes.transform(inverse(before.world_from_sensor("lidar")))
        np.testing.assert_allclose(after.annotations.boxes.array(), seen.array())
        assert after.annotations.boxes.label.tolist() == seen.label.tolist()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            "export poetry data",
            "export format 'poetry': choose one of kitti, yolo, .*, or name your own as module:NAME",
        ),
        ("import poetry data", "import format 'poetry': choose one of kitti, kitti-tracking, .*, or name your own as"),
        ("export no_clouds:EXPORT data", "no module 'no_clouds' in .* or among what is installed"),
        ("export clouds:RAIN data", r"clouds\.py has no 'RAIN'"),
        ("export clouds:write data", "is no export format, it has no write, options"),
        ("export clouds:IMPORT data", "is no export format, it has no write, options"),
        ("import clouds:EXPORT data", "is no import format, it has no read, signs"),
        ("export clouds:EXPORT data --min-points 3", "has no use for --min-points; it takes --calibration"),
        ("export clouds:EXPORT none", "none"),
        ("import clouds:IMPORT none", "none: no such folder"),
    ],
)
def test_what_is_no_format_is_one_sentence(command: str, said: str, data: Dataset, capsys: pytest.CaptureFixture[str]):
    assert ended(*command.split(), "--out", "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(said, line), line
    assert not Path("out").exists()


def test_a_folder_of_another_format_is_told(data: Dataset, capsys: pytest.CaptureFixture[str]):
    assert not ended("export", "kitti", "data", "--out", "kitti")
    capsys.readouterr()
    assert ended("import", "clouds:IMPORT", "kitti", "--out", "out") == 2
    assert "kitti: is no folder of 'clouds:IMPORT' but of 'kitti'" in capsys.readouterr().err

"""flcav towns, as a user runs it."""

import json
from pathlib import Path

import pytest

from flcav.cli.main import run
from flcav.world.map.town import PACKAGED

CROSS = Path(__file__).parents[1] / "data" / "cross.xodr"


def flcav(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        run([*arguments])
    return int(ended.value.code or 0)


def test_list_says_what_towns_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert flcav("towns", "list", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["towns"]
    assert [row["name"] for row in rows] == list(PACKAGED)
    assert all(row["junctions"] >= 8 and row["driving_km"] > 2 and row["buildings"] > 100 for row in rows)


def test_a_map_becomes_a_town_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    town, picture = tmp_path / "cross", tmp_path / "map.png"
    assert flcav("towns", "import", str(CROSS), "--out", str(town)) == 0
    assert flcav("towns", "show", str(town), "--out", str(picture)) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "sidewalks: added" in capsys.readouterr().out
    assert flcav("towns", "import", str(CROSS), "--out", str(town)) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_is_no_town_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert flcav("towns", "show", "atlantis", "--out", str(tmp_path / "map.png")) == 2
    assert "unknown town 'atlantis'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())

import csv
import json
from pathlib import Path

import pytest
from flcav.experiments.points import append_points, points_of

from flcav.cli.main import run

VALUES = {
    "plan": {"tasks": [{"samples": 200, "edge_rounds": 3, "cloud_rounds": 1}]},
    "test-pretrain-grid": {"ap50": 0.5, "frames": 240},
    "rounds-grid-edge-chosen-grid": [{"round": r, "ap50": 0.55 + r / 100, "frames": 30} for r in (1, 2, 3)],
    "test-grid-edge-chosen-grid": {"ap50": 0.6, "frames": 240},
    "rounds-cloud-grid": [{"round": 1, "ap50": 0.7, "frames": 30}],
    "test-cloud-grid": {"ap50": 0.65, "frames": 240},
}


def rows(path: Path) -> list[tuple[str, ...]]:
    with path.open() as file:
        return [tuple(row.values())[1:6] for row in csv.DictReader(file)]


def test_a_run_leaves_a_point_per_round_the_last_of_a_stage_on_all_test_frames(tmp_path: Path) -> None:
    append_points(tmp_path / "history.csv", points_of(VALUES, "seed1"))
    assert rows(tmp_path / "history.csv") == [
        ("200", "0", "0", "0.5000", "240"),
        ("200", "1", "0", "0.5600", "30"),
        ("200", "2", "0", "0.5700", "30"),
        ("200", "3", "0", "0.6000", "240"),
        ("200", "3", "1", "0.6500", "240"),
    ]


def test_rounds_that_were_not_tested_have_no_point() -> None:
    partial = {name: value for name, value in VALUES.items() if "rounds" not in name and "cloud" not in name}
    assert [point["edge_rounds"] for point in points_of(partial, "seed1")] == [0, 3]


def test_points_are_appended_once(tmp_path: Path) -> None:
    path = tmp_path / "history.csv"
    for name in ("seed1", "seed2", "seed1"):
        append_points(path, points_of(VALUES, name))
    assert len(rows(path)) == 10


def test_fit_reads_what_a_run_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "history.csv"
    append_points(path, points_of(VALUES, "seed1"))
    with pytest.raises(SystemExit) as stopped:
        run(["fit", str(path), "--json", "--repeats", "20"])
    assert not stopped.value.code
    (curve,) = json.loads(capsys.readouterr().out)["curves"]
    assert (curve["task"], curve["points"]) == ("objects", 5)
    assert curve["edge"]["a"] > 0

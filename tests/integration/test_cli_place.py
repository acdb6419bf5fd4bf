"""`flcav place` from files to JSON."""

import json
from pathlib import Path

import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from flcav.cli.main import run

ERRORS = "x,y,z,weight\n0,0,0,1\n1,0,0,1\n50,0,0,5\n"
POLES = "id,x,y,z\n3,0,0,3\n8,50,0,3\n"


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        run([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


@pytest.fixture
def files(tmp_path) -> tuple[Path, Path]:
    (tmp_path / "errors.csv").write_text(ERRORS)
    (tmp_path / "poles.csv").write_text(POLES)
    return tmp_path / "errors.csv", tmp_path / "poles.csv"


def asked(files: tuple[Path, Path], *more: object, reach: object = 10, count: object = 1) -> int:
    return called("place", "--errors", files[0], "--poles", files[1], "--range", reach, "--count", count, *more)


@pytest.mark.parametrize("method", ["exact", "greedy"])
@pytest.mark.parametrize("parquet", [False, True])
def test_place_chooses_by_weight(files, method, parquet, capsys):
    if parquet:
        for path in files:
            pq.write_table(pyarrow.csv.read_csv(path), path.with_suffix(".parquet"))
        files = (files[0].with_suffix(".parquet"), files[1].with_suffix(".parquet"))
    assert asked(files, "--method", method, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "chosen": [{"pole": 8}], "covered": 1, "covered_weight": 5.0, "upper_bound": 5.0, "optimal": True,
    }  # fmt: skip
    assert asked(files) == 0
    assert "poles 8" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("errors", "change", "named"),
    [
        ("x,y\n0,0\n", {}, "'z'"),
        ("x,y,z\n0,nan,0\n", {}, "row 1: y ="),
        ("x,y,z\n", {}, "no rows"),
        (ERRORS, {"reach": -1}, "range = -1"),
        (ERRORS, {"count": 3}, "count = 3"),
    ],
)
def test_bad_input_is_one_sentence(errors, change, named, files, capsys):
    files[0].write_text(errors)
    assert asked(files, **change) == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1

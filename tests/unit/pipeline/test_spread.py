"""Tables of the spread of retraining: written, read back, and refused where they are none."""

from dataclasses import fields, replace
from pathlib import Path

import pytest

from flcav.config import InputError
from flcav.intervals import Spread
from flcav.pipeline.seeds.spread import SpreadRow, read_spreads
from flcav.pipeline.tables import append_records

ROW = SpreadRow("objects", "grid", "main", "edge", "", "", sd=0.021, trainings=9, run="seed1")


def test_a_table_is_read_by_measure_and_by_difference(tmp_path: Path) -> None:
    append_records(tmp_path / "own.csv", [ROW, replace(ROW, before_arm="main", before_stage="pretrain", sd=0.015)])
    assert read_spreads("own.csv", tmp_path) == {
        ("objects", "grid", "main", "edge", "", ""): Spread(0.021, 9),
        ("objects", "grid", "main", "edge", "main", "pretrain"): Spread(0.015, 9),
    }


def test_runs_of_one_measure_are_pooled(tmp_path: Path) -> None:
    append_records(tmp_path / "own.csv", [ROW, replace(ROW, sd=0.04, trainings=3, run="seed2")])
    (pooled,) = read_spreads("own.csv", tmp_path).values()
    assert (pooled.sd, pooled.trainings) == (pytest.approx(((8 * 0.021**2 + 2 * 0.04**2) / 10) ** 0.5), 11)


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        ("wide,9,seed1", "row 1: sd and trainings must be numbers"),
        ("nan,9,seed1", "row 1: sd must be from 0 to 1"),
        ("0.1,1,seed1", "trainings 2 or more"),
        ("0.1,9", "row 1: column 'run' is missing"),
    ],
)
def test_a_row_that_is_no_spread_is_named(tmp_path: Path, cells: str, said: str) -> None:
    header = ",".join(field.name for field in fields(SpreadRow))
    (tmp_path / "own.csv").write_text(f"{header}\nobjects,grid,main,edge,,,{cells}\n")
    with pytest.raises(InputError, match=said):
        read_spreads("own.csv", tmp_path)


def test_a_table_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"spread: 'none\.csv' is no spread of the package"):
        read_spreads("none.csv", tmp_path)

"""Tables of the spread of retraining: written, read back, and refused where they are none."""

from pathlib import Path

import pytest

from flcav.config import InputError
from flcav.intervals import Spread
from flcav.pipeline.spread import COLUMNS, read_spreads
from flcav.pipeline.tables import append_rows

ROW = {
    "task": "objects", "region": "grid", "arm": "main", "stage": "edge", "before_arm": "", "before_stage": "",
    "sd": "0.02100", "trainings": "9", "run": "seed1",
}  # fmt: skip


def test_a_table_is_read_by_measure_and_by_difference(tmp_path: Path) -> None:
    difference = ROW | {"before_arm": "main", "before_stage": "pretrain", "sd": "0.01500"}
    append_rows(tmp_path / "own.csv", COLUMNS, [ROW, difference])
    assert read_spreads("own.csv", tmp_path) == {
        ("objects", "grid", "main", "edge", "", ""): Spread(0.021, 9),
        ("objects", "grid", "main", "edge", "main", "pretrain"): Spread(0.015, 9),
    }


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"sd": "wide"}, "row 1: sd and trainings must be numbers"),
        ({"sd": "nan"}, "row 1: sd must be from 0 to 1"),
        ({"trainings": "1"}, "trainings 2 or more"),
    ],
)
def test_a_row_that_is_no_spread_is_named(tmp_path: Path, change: dict[str, str], said: str) -> None:
    append_rows(tmp_path / "own.csv", COLUMNS, [ROW | change])
    with pytest.raises(InputError, match=said):
        read_spreads("own.csv", tmp_path)


def test_a_table_that_is_not_there_or_lacks_a_column_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"spread: 'none\.csv' is no spread of the package"):
        read_spreads("none.csv", tmp_path)
    append_rows(tmp_path / "short.csv", COLUMNS[:-1], [{name: ROW[name] for name in COLUMNS[:-1]}])
    with pytest.raises(InputError, match="row 1: column 'run' is missing"):
        read_spreads("short.csv", tmp_path)

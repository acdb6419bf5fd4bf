"""Histories in files, as Python reads them."""

import re
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flcav.config import InputError
from flcav.optimization.curves.fitting import fit
from flcav.optimization.curves.history import load_history, parse_histories
from flcav.storage.records import read_csv


def test_a_curve_is_fitted_to_a_file(tmp_path: Path):
    path = tmp_path / "history.csv"
    path.write_text("samples,edge_rounds,cloud_rounds,accuracy\n10,0,0,0.3\n100,0,0,0.5\n1000,0,0,0.7\n")
    assert fit(str(path)).curve == fit(path).curve == fit(load_history(path)).curve
    path.write_text("task,samples,edge_rounds,cloud_rounds,accuracy\na,10,0,0,0.3\nb,100,0,0,0.5\n")
    with pytest.raises(InputError, match="a history of one task is wanted, and it has those of a, b"):
        fit(path)
    with pytest.raises(InputError, match="no such file"):
        fit("none.csv")


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("NaN", "row 2: accuracy = nan must be a number from 0 to 1"),
        ("NA", "row 2: accuracy = 'NA' must be a number"),
        ("", "row 2: accuracy is empty, and must be a number from 0 to 1"),
        (" ", "row 2: accuracy is empty, and must be a number from 0 to 1"),
        ("inf", "row 2: accuracy = inf must be a number from 0 to 1"),
        ("-0.1", "row 2: accuracy = -0.1 must be a number from 0 to 1"),
        ("85", "row 2: accuracy = 85.0 must be a number from 0 to 1; 85 % is 0.85"),
        ("85 %", "row 2: accuracy = '85 %' must be a number, without the unit: 0.85"),
        ("1e-12", "row 2: accuracy = 1e-12 must be 0, or a number from 1e-09 to 1"),
        ("none", "row 2: accuracy = 'none' must be a number"),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_value_that_is_no_accuracy_is_named_with_its_row_and_column(
    tmp_path: Path, value: str, said: str, suffix: str
) -> None:
    path = tmp_path / "history.csv"
    path.write_text(f"samples,edge_rounds,cloud_rounds,accuracy\n10,0,0,0.3\n100,0,0,{value}\n1000,0,0,0.7\n")
    columns = read_csv(path).to_pydict()
    if suffix == ".parquet":
        pq.write_table(pa.table(columns), path.with_suffix(suffix))
        columns = pq.read_table(path.with_suffix(suffix)).to_pydict()
    with pytest.raises(InputError, match=rf"history: {re.escape(said)}"):
        parse_histories(columns, "history", "task")


@pytest.mark.parametrize(
    ("header", "row", "said"),
    [
        ("task,", "", "row 1: task is empty"),
        ("run,", "", "row 1: run is empty"),
        ("accuracy,", "0.4", "column 'accuracy' is there twice"),
    ],
)
def test_rows_without_a_name_and_columns_of_one_name_are_refused(
    tmp_path: Path, header: str, row: str, said: str
) -> None:
    path = tmp_path / "history.csv"
    path.write_text(f"{header}samples,edge_rounds,cloud_rounds,accuracy\n{row},10,0,0,0.3\n")
    with pytest.raises(InputError, match=said):
        load_history(path)

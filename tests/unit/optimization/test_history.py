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


NAMED = "N,FL rounds,Test accuracy (%)\n10,0,42\n20,0,55\n40,0,63\n80,0,70\n80,2,74\n80,4,75.5\n"


def test_columns_are_read_by_the_names_that_people_give_them_and_told(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text(NAMED)
    found = load_history(tmp_path / "mine.csv")
    plain = "samples,edge_rounds,cloud_rounds,accuracy\n"
    rows = "10,0,0,.42\n20,0,0,.55\n40,0,0,.63\n80,0,0,.7\n80,2,0,.74\n80,4,0,.755\n"
    (tmp_path / "plain.csv").write_text(plain + rows)
    expected = load_history(tmp_path / "plain.csv")
    assert found.resources.tolist() == expected.resources.tolist()
    assert found.accuracy == pytest.approx(expected.accuracy)
    assert expected.warnings == ()
    assert found.warnings == (
        "column 'N' is read as samples",
        "column 'FL rounds' is read as edge_rounds",
        "column 'Test accuracy (%)' is read as accuracy, divided by 100",
        "no cloud_rounds in the table: 0 in every row, and the curve says nothing of them",
    )


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("samples,loss", "column 'accuracy' is missing; .* of whose numbers one is enough; .*; found samples, loss"),
        ("epoch,accuracy", "column 'samples' is missing; .*; found epoch, accuracy"),
        ("stage,accuracy", "column 'resource' is missing"),
        ("samples,val_acc,test_acc", "columns 'val_acc' and 'test_acc' are both accuracy: call the one that counts ac"),
    ],
)
def test_a_table_without_what_a_history_needs_is_refused(header: str, said: str) -> None:
    columns = {name: [0.5] for name in header.split(",")}
    with pytest.raises(InputError, match=said):
        parse_histories(columns, "history", "task")


def test_a_column_of_its_own_name_counts_and_the_others_are_left() -> None:
    columns = {"samples": [10], "frames": [99], "error": [0.4], "AP": [0.3], "weight": [2]}
    found = parse_histories(columns, "history", "task")["task"]
    assert (found.resources.tolist(), found.accuracy.tolist()) == ([[10, 0, 0]], [0.6])


@pytest.mark.parametrize(
    "text",
    ["N;Straße;acc\n10;x;0,42\n20;y;0,5\n", "N;acc\n10;0.42\n20;0.5\n", "N\tacc\n10\t0.42\n20\t0.5\n"],
)
def test_semicolons_tabs_and_decimal_commas_are_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.csv").write_text(text)
    found = load_history(tmp_path / "mine.csv")
    assert found.resources[:, 0].tolist() == [10, 20]
    assert found.accuracy.tolist() == [0.42, 0.5]

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest

from flcav.config import InputError
from flcav.storage.records import LEFT_OUT, Class, Record, read_csv, to_rows


@dataclass(frozen=True)
class Row:
    label: Class
    ap: float | None


@dataclass(frozen=True)
class Told(Record):
    rows: tuple[Row, ...]
    by_town: Mapping[str, Row]
    more: Annotated[Row | None, LEFT_OUT] = None


@dataclass(frozen=True)
class Outer:
    town: str
    row: Row
    seeds: tuple[int, ...]


def test_a_record_comes_back_from_its_json() -> None:
    told = Told((Row("Car", 0.5), Row("Van", None)), {"grid": Row("Car", 1.0)})
    values = {
        "rows": [{"class": "Car", "ap": 0.5}, {"class": "Van", "ap": None}],
        "by_town": {"grid": {"class": "Car", "ap": 1.0}},
    }
    assert told.as_json() == values
    assert Told.from_json(values, "told") == told
    assert Told((), {}, Row("Car", 0.5)).as_json()["more"] == {"class": "Car", "ap": 0.5}


def test_what_is_no_such_record_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"result\.json: not a result .*field 'rows\.0\.ap'"):
        Told.from_json({"rows": [{"class": "Car", "ap": "high"}], "by_town": {}}, "result.json")


def test_rows_have_a_column_for_each_number_of_a_nested_record() -> None:
    rows = to_rows([Outer("grid", Row("Car", 0.5), (1, 2)), Outer("ring", Row("Van", None), ())])
    assert rows == [
        {"town": "grid", "row.class": "Car", "row.ap": 0.5, "seeds": [1, 2]},
        {"town": "ring", "row.class": "Van", "row.ap": None, "seeds": []},
    ]


@pytest.mark.parametrize(
    ("written", "encoding"),
    [
        ("id;x;y;street\n7;1,5;-2;Kö\n8;1.000,25;;Kö\n", "utf-8-sig"),
        ("id\tx\ty\tstreet\n7\t1,5\t-2\tKö\n8\t1000,25\t\tKö\n", "utf-16"),
        ("sep=;\r\nid;x;y;street\r\n7;1.5;-2;Kö\r\n8;1000.25;;Kö\r\n", "cp1252"),
        ('id,x,y,street\n7,"1,5",-2,Kö\n8,"1000,25",,Kö\n', "utf-8"),
    ],
)
def test_tables_of_spreadsheets_are_read(written: str, encoding: str, tmp_path: Path):
    (tmp_path / "own.csv").write_bytes(written.encode(encoding))
    assert read_csv(tmp_path / "own.csv", ["id"]).to_pylist() == [
        {"id": "7", "x": 1.5, "y": -2, "street": "Kö"},
        {"id": "8", "x": 1000.25, "y": None, "street": "Kö"},
    ]


def test_thousands_and_lists_stay_text(tmp_path: Path):
    (tmp_path / "own.csv").write_text('cost,tags\n"1,234","2,5 m"\n"12,500","3,5"\n')
    assert read_csv(tmp_path / "own.csv").to_pydict() == {"cost": ["1,234", "12,500"], "tags": ["2,5 m", "3,5"]}

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import pytest

from flcav.config import InputError
from flcav.storage.records import LEFT_OUT, Class, Record, to_rows


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

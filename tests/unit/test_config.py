from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

from flcav.config import Config, InputError, parse_config, read_config, read_json


class Circle(Config):
    kind: Literal["circle"] = "circle"
    radius_m: Annotated[float, Field(gt=0)]


class Square(Config):
    kind: Literal["square"] = "square"
    side_m: Annotated[float, Field(gt=0)]


class Picture(Config):
    shapes: Annotated[tuple[Annotated[Circle | Square, Field(discriminator="kind")], ...], Field(min_length=1)]
    frame: Square | None = None
    by_name: Mapping[str, Circle] = {}
    paint: str | Mapping[str, Mapping[str, float]] = "white"


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({}, "p.yaml: field 'shapes' is missing"),
        ({"shapes": []}, "p.yaml: field 'shapes' = ..: Tuple should have at least 1 item"),
        ({"shapes": [{"kind": "circle", "radius_m": -1}]}, r"field 'shapes.0.circle.radius_m' = -1: .* than 0$"),
        (
            {"shapes": [{"kind": "circle", "radius_m": 1, "red": 1}]},
            "unknown field 'shapes.0.circle.red'; known fields: .*radius_m",
        ),
        (
            {"shapes": [{"kind": "square", "side_m": 1}], "frame": {"extent": 1}},
            r"'frame.side_m' is missing \(and 1 mor",
        ),
        (
            {"shapes": [{"kind": "square", "side_m": 1}], "frame": {"sides": 1}},
            r"unknown field 'frame.sides'; known fields: kind, side_m \(did you mean 'side_m'\?\) \(and 1 more\)$",
        ),
        (
            {"shapes": [{"kind": "square", "side_m": 1}], "colour": 1},
            "'colour'; known fields: by_name, frame, paint, shapes$",
        ),
        (
            {"shapes": [{"kind": "square", "side_m": 1}], "by_name": {"a": {"radius_m": 1, "r": 2}}},
            "'by_name.a.r'; known fields: kind, radius_m$",
        ),
    ],
)
def test_a_fault_is_one_sentence_with_field_value_and_rule(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        parse_config(Picture, values, "p.yaml")


@pytest.mark.parametrize("number", [float("nan"), float("inf"), "1e309", 1e300, 10**400])
def test_numbers_that_nobody_can_mean_are_refused(number: float) -> None:
    with pytest.raises(InputError, match=r"^p.yaml: field 'radius_m' = .{1,90}: ") as caught:
        parse_config(Circle, {"radius_m": number}, "p.yaml")
    assert len(str(caught.value)) < 250


def test_a_record_in_the_place_of_which_something_else_stands() -> None:
    with pytest.raises(InputError, match=r"'frame' = 3: must be a mapping of the fields kind, side_m$"):
        parse_config(Picture, {"shapes": [{"kind": "square", "side_m": 1}], "frame": 3}, "p.yaml")
    with pytest.raises(InputError, match=r"'paint.red' = 3: must be a mapping$"):
        parse_config(Picture, {"shapes": [{"kind": "square", "side_m": 1}], "paint": {"red": 3}}, "p.yaml")


@pytest.mark.parametrize("text", ["[" * 100_000, "{", "\xff", '{"a": 1' + "0" * 5000 + "}"])
def test_json_that_the_parser_trips_over(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"a\.json: not JSON"):
        read_json(tmp_path / "a.json")


def test_what_is_no_mapping_is_refused() -> None:
    with pytest.raises(InputError, match=r"p.yaml: expected a mapping of fields, found list"):
        parse_config(Picture, [], "p.yaml")


def test_numbers_of_mappings_have_a_size_that_can_be_computed_with():
    with pytest.raises(InputError, match=r"field 'paint' = .*: a number's size, sign apart, must be from 0 to 1e"):
        parse_config(Picture, {"shapes": [{"kind": "circle", "radius_m": 1}], "paint": {"a": {"b": 1.7e308}}}, "test")


def test_yes_and_no_are_no_numbers():
    class Numbers(Config):
        amount: float
        counts: tuple[int, ...] = ()
        by_name: Mapping[str, float] | None = None
        least: int | None = None
        shown: bool = False
        rounds: int | Literal["all"] | bool = 1

    assert Numbers(amount=1, shown=True, rounds=True).shown
    for field, value in (("amount", True), ("counts", [1, False]), ("by_name", {"a": True}), ("least", True)):
        with pytest.raises(InputError, match=f"'{field}' is true or false .yes, no, on, off., and a number is wanted"):
            parse_config(Numbers, {"amount": 1.0, field: value}, "numbers.yaml")


def test_an_empty_file_and_a_folder_are_called_so(tmp_path: Path):
    (tmp_path / "empty.yaml").write_text("")
    with pytest.raises(InputError, match=r"empty\.yaml: is empty"):
        read_config(Config, tmp_path / "empty.yaml")
    with pytest.raises(InputError, match="is a folder, and a file is wanted"):
        read_config(Config, tmp_path)

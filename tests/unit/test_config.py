from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

from flcav.config import Config, InputError, parse_config


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
            {"shapes": [{"kind": "square", "side_m": 1}], "frame": {"sides": 1}},
            r"'frame.side_m' is missing \(and 1 mor",
        ),
        ({"shapes": [{"kind": "square", "side_m": 1}], "colour": 1}, "'colour'; known fields: by_name, frame, shapes$"),
        (
            {"shapes": [{"kind": "square", "side_m": 1}], "by_name": {"a": {"radius_m": 1, "r": 2}}},
            "'by_name.a.r'; known fields: kind, radius_m$",
        ),
    ],
)
def test_a_fault_is_one_sentence_with_field_value_and_rule(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        parse_config(Picture, values, "p.yaml")


def test_what_is_no_mapping_is_refused() -> None:
    with pytest.raises(InputError, match=r"p.yaml: expected a mapping of fields, found list"):
        parse_config(Picture, [], "p.yaml")

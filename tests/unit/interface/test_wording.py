"""Names that were meant, numbers with units, and plurals."""

import re
from pathlib import Path

import pytest

import flcav
from flcav.interface.wording import describe_number, hint_share, plural, suggest


def test_the_closest_known_name_is_suggested_if_it_is_close() -> None:
    assert suggest("subrub", ["grid", "suburb"]) == " (did you mean 'suburb'?)"
    assert suggest("atlantis", ["grid", "suburb"]) == ""


@pytest.mark.parametrize(
    ("text", "field", "written"),
    [
        ("2 GB", "budgets_mb.wireless", "of MB, without the unit: 2000"),
        ("1600kB", "tasks.0.sample_mb", "of MB, without the unit: 1.6"),
        ("1 min", "horizon_s", "of s, without the unit: 60"),
        ("40 m", "range_m", "of m, without the unit: 40"),
        ("1 Gbit/s", "uplink_mbps.car0", "of Mbit/s, without the unit: 1000"),
        ("2 GB", "horizon_s", "of s, without a unit"),
        ("55%", "accuracy", ", without the unit: 0.55"),
        ("10 MB", "resource", ", without a unit"),
        ("many", "budgets_mb.wireless", ""),
    ],
)
def test_a_number_with_a_unit_is_told_in_the_unit_of_its_field(text: str, field: str, written: str) -> None:
    assert describe_number(text, field) == f"must be a number{' ' * written.startswith('of')}{written}"


def test_a_share_in_per_cent_is_told_as_a_fraction() -> None:
    assert hint_share(55.0) == "; 55 % is 0.55"
    assert [hint_share(value) for value in (-1.0, 0.5, 1.0, 200.0)] == [""] * 4


def test_one_of_a_thing_is_singular() -> None:
    assert [plural(number, "scene") for number in (0, 1, 2)] == ["0 scenes", "1 scene", "2 scenes"]


def test_no_command_counts_one_of_a_thing_in_the_plural() -> None:
    counted = re.compile(r"\{[^{}]*\} (?:scenes|frames|poles|points|images|annotations|steps|rounds|seeds|vehicles)\b")
    commands = sorted((Path(flcav.__file__).parent / "cli").rglob("*.py"))
    found = {file.name: counted.findall(file.read_text(encoding="utf-8")) for file in commands}
    assert {name: lines for name, lines in found.items() if lines} == {}

"""The allocation and placement examples run as they stand."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("name", "says"), [("02_allocate_a_budget.py", "8000 MB per link"), ("03_place_a_sensor.py", "exact: poles")]
)
def test_example(name, says, capsys):
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert says in capsys.readouterr().out
    assert len((EXAMPLES / name).read_text().splitlines()) <= 80

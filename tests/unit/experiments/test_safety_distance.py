"""Margins compared: means over drives, the pair nearest in mean speed, paired differences, picture."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from flcav.driving.errors import load_error_model
from flcav.driving.measures import DriveResult, Hit
from flcav.reproductions.safety_distance.run import (
    SafetyDistance,
    bound_count,
    draw_trade_off,
    list_settings,
    summarise_margins,
)
from flcav.storage.records import from_json

HIT = Hit(3.0, "car", "vehicle", 5.0, at_fault=True)
OWN = DriveResult("a", 301, 12.0, 0.5, 6.0, 2.0, 0.1, 2, 0, (), 0.5)


@pytest.fixture(scope="module")
def results() -> SafetyDistance:
    """Wider margins are slower by 1 m/s each; one standard deviation is as slow as 0.4 m, and brakes once less."""
    slower = {name: 6.0 - i for i, name in enumerate(list_settings())} | {"1 sigma": 5.1}
    drives = {}
    for name, speed in slower.items():
        first = replace(OWN, mean_speed=speed, hard_brakes=1 if name == "1 sigma" else 2)
        other = replace(first, scenario="b", near_share=0.3, hits=(HIT, replace(HIT, at_fault=False)), score=0.0)
        drives[name] = [first, other]
    return summarise_margins(drives, load_error_model())


def test_means_are_over_drives_and_faults_are_counted(results: SafetyDistance) -> None:
    found = {own.name: own for own in results.settings}
    assert list(found) == list(list_settings())
    least = found["fixed 0 m"]
    assert (least.near_share, least.hard_brakes, least.mean_speed, least.score) == pytest.approx((0.2, 2.0, 6.0, 0.25))
    assert (least.faults, results.drives) == (1, 2)
    assert [(own.uncertain, own.size) for own in results.settings[-5:]] == [
        (False, 1.8),
        *((True, size) for size in (0.25, 0.5, 1.0, 2.0)),
    ]


def test_the_pair_nearest_in_mean_speed_is_compared_drive_by_drive(results: SafetyDistance) -> None:
    assert results.compared == ("fixed 0.4 m", "1 sigma")
    brakes = results.differences["hard_brakes"]
    assert (brakes.mean, brakes.low, brakes.high) == (-1.0, -1.0, -1.0)
    assert results.differences["mean_speed"].mean == pytest.approx(0.1)


def test_margins_are_told_drawn_and_read_back(results: SafetyDistance) -> None:
    assert from_json(SafetyDistance, results.as_json(), "result.json") == results
    assert results.sentences()[0].startswith("fixed 0 m: 1 collisions at fault in 2 drives, 2.00 hard brakes a drive")
    with Image.open(BytesIO(results.picture())) as picture:
        assert picture.format == "PNG"


def test_collisions_have_the_exact_interval_of_a_count_and_no_line() -> None:
    assert bound_count(0) == pytest.approx((0.0, 3.689), abs=1e-3)  # tabulated by Garwood
    assert bound_count(2) == pytest.approx((0.242, 7.225), abs=1e-3)
    axes = draw_trade_off({"fixed": [(3.0, 0.01, 1.0, 2), (4.0, 0.02, 2.0, 0)]}, 48).axes[2]
    assert axes.get_title(loc="left") == "collisions at fault, in 48 drives"
    (dots,) = (line for line in axes.get_lines() if line.get_marker() == "o")
    assert dots.get_linestyle() == "None"
    assert [0.2422, 7.2247] in [
        np.round(np.asarray(line.get_ydata(), np.float64), 4).tolist() for line in axes.get_lines()
    ]

"""Means, differences, counts of mended conditions, tables and the picture of the comparison of lifelong learning."""

from io import BytesIO
from types import SimpleNamespace
from typing import Any, cast

import pytest
from PIL import Image

from flcav.report import style
from flcav.report.charts.lifelong import draw_rounds
from flcav.reproductions.lifelong.run import (
    ARMS,
    LifelongResult,
    compare_lifelong,
    count_mended,
    draw_lifelong,
    lifelong_tables,
)
from flcav.runs.extras.lifelong.rows import LifelongArm, Passed
from flcav.runs.recipe import load_run_recipe
from flcav.sources.recipe import recipe_path

RECIPE = load_run_recipe(recipe_path("runs/lifelong"))
CONDITIONS = ("home", "fog", "vans")


def arm(name: str, last: tuple[float, float, float], learned_s: float | None, mended_s: float | None) -> LifelongArm:
    """Return an arm that ends at `last`, and had (.6, .2, .3) before."""
    rows = ((0.6, 0.2, 0.3), (0.6, 0.2, 0.3), (0.5, 0.5, 0.4), last)
    scores: dict[str, tuple[float, ...]] = {}
    passed = []
    for number, condition in enumerate(CONDITIONS):
        scores = {**dict.fromkeys(CONDITIONS[:number], (0.5, 0.4, 0.4)), condition: (0.2, 0.4, 0.5)}
        found = (0.0, 0.0) if number == 0 else (learned_s, mended_s)
        passed.append(
            Passed(condition, (), 3, 2, bool(number), scores, 0.5, 24.0, *found, 10**6, 2 * 10**6, (7.0, 7.0))
        )
    return LifelongArm.of(name, "objects", "AP50", rows, tuple(passed))


def runs() -> list[Any]:
    """Return two seeds: replay gains .1 and .2 over no replay in the mean of the three conditions."""
    made = []
    for seed, gain in ((1, 0.1), (2, 0.2)):
        arms = (
            arm("replay", (0.3 + 3 * gain, 0.5, 0.6), 31.0, 38.0 + seed),
            arm("no replay", (0.3, 0.5, 0.6), None, None),
            arm("nothing", (0.6, 0.2, 0.3), None, None),
        )
        made.append(SimpleNamespace(recipe=RECIPE.model_copy(update={"seed": seed}), lifelong=arms))
    return made


@pytest.fixture(scope="module")
def results() -> LifelongResult:
    return compare_lifelong(RECIPE, cast(Any, runs()))


def test_the_recipe_has_the_arms_conditions_and_no_roster() -> None:
    assert RECIPE.lifelong is not None
    assert RECIPE.lifelong.conditions == CONDITIONS
    assert RECIPE.federation.requests is None  # what a condition can reach is learned by all of its vehicles


def test_means_and_differences_by_hand(results: LifelongResult) -> None:
    assert results.differences["final mean AP50: replay - no replay"].mean == pytest.approx(0.15)
    # without replay home falls from .6 to .3, and fog stays
    assert results.backward["no replay"].mean == pytest.approx((0.3 - 0.6 + 0.5 - 0.5) / 2)
    assert results.differences["backward transfer: replay - no replay"].mean == pytest.approx(0.45 / 2)
    assert results.forward["replay"].mean == pytest.approx((0.0 + 0.1) / 2)
    assert results.up_mb["replay"].mean == pytest.approx(3.0)
    assert [each.mean for each in results.tested["fog"]["replay"]] == pytest.approx([0.2, 0.2, 0.5, 0.5])


def test_conditions_with_errors_are_counted_and_those_mended(results: LifelongResult) -> None:
    found = results.mended["replay"]
    assert (found.passed, found.broken, found.mended, found.seconds) == (6, 4, 4, 39.5)
    assert count_mended([each.lifelong[1] for each in runs()]).seconds is None


def test_results_are_read_back_and_tables_show_them(results: LifelongResult) -> None:
    assert LifelongResult.from_json(results.as_json(), "made up") == results
    tables = lifelong_tables(results)
    assert tables["arms"].count("\n") == 1 + len(ARMS)
    assert "| replay | fog | 0 | 3 | 2 | 0.200 | 0.500 | 0.500 | yes | 39 |" in tables["rounds"]
    assert "4 of 6 | 4 | 40 |" in tables["arms"]


def test_pictures_have_a_panel_for_each_condition_and_arm(results: LifelongResult) -> None:
    wide, high = Image.open(BytesIO(draw_lifelong(results))).size
    assert wide > 2 * high
    figure = draw_rounds(runs()[0].lifelong)
    assert [panel.get_title(loc="left") for panel in figure.axes] == [*ARMS]
    assert len(style.png(figure)) > 10_000

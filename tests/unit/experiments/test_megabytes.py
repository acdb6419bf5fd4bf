"""What a megabyte teaches: crossings of curves, their means over seeds, tables and pictures."""

import dataclasses

import numpy as np
import pytest

from flcav.experiments.megabytes import AtBytes, average_curves, find_crossing, list_uploads
from flcav.reproductions.megabytes.run import (
    COMPARED,
    FEDERATED,
    INT8,
    MORE,
    SWEEPS,
    MegabytesResult,
    SeedCurves,
    compare_megabytes,
    draw_megabytes,
    megabytes_tables,
)
from flcav.runs.recipe import MAIN, load_run_recipe
from flcav.sources.recipe import recipe_path

RECIPE = load_run_recipe(recipe_path("runs/megabytes"))


@pytest.mark.parametrize("level", [0.05, 0.1, 0.25, 0.4, 0.55, 0.7])
def test_a_crossing_is_where_a_line_between_points_reaches_the_level(level: float) -> None:
    x, y = np.array([0.0, 2.0, 3.0, 7.0]), np.array([0.1, 0.3, 0.4, 0.7])
    expected = float(np.interp(level, y, x))
    assert find_crossing(list(zip(x, y, strict=True)), level) == pytest.approx(expected)


def test_a_crossing_is_the_first_and_may_be_none() -> None:
    assert find_crossing([(0.0, 0.1), (1.0, 0.5), (2.0, 0.3), (3.0, 0.6)], 0.5) == 1.0
    assert find_crossing([(0.0, 0.1), (1.0, 0.05), (2.0, 0.2)], 0.15) == pytest.approx(1 + 0.1 / 0.15)
    assert find_crossing([(0.0, 0.1), (1.0, 0.5)], 0.51) is None
    assert find_crossing([], 0.0) is None


def test_the_arms_are_those_of_the_recipe() -> None:
    uploads = {arm for arm, _ in list_uploads(RECIPE)}
    assert {*FEDERATED.values()} == {MAIN, *RECIPE.arms} - uploads
    assert {name for pair in COMPARED for name in pair} <= {*FEDERATED}
    assert all(RECIPE.arms[arm].compressed for arm in uploads)
    own = RECIPE.training_of("objects").local_steps
    for name, arm in FEDERATED.items():
        more = {} if arm == MAIN else RECIPE.arms[arm].training
        assert more.get("local_steps", own) == (4 * own if MORE in name else own)
    for arm in uploads:
        steps = RECIPE.arms[arm].training.get("local_steps", own)
        assert steps == (4 * own if arm.endswith("_fourfold") else own)


def curves_of(more: float) -> dict[str, tuple[AtBytes, ...]]:
    start = AtBytes("pretraining", 0.0, 0.5 + more, 0)
    ends = {name: (start, AtBytes("10 rounds", 7.0, 0.6 + more + 0.1 * (MORE in name))) for name in FEDERATED}
    few, many = AtBytes("10 sweeps", 1.0, 0.7 + more, 80), AtBytes("20 sweeps", 2.0, 0.8 + more, 180)
    return {**ends, SWEEPS: (start, few), f"{SWEEPS}{MORE}": (start, dataclasses.replace(few, ap50=0.6 + more), many)}


def test_sweeps_that_match_a_federation_in_megabytes_and_boxes() -> None:
    found = compare_megabytes(
        RECIPE, {name: SeedCurves(curves_of(more), 900, 2.3) for name, more in (("31", 0.0), ("32", 0.04))}
    )
    own, more = found.matches[INT8], found.matches[f"{INT8}{MORE}"]
    assert own.sweeps_mb == pytest.approx((0.5, 0.5))  # half of the way from .5 to .7
    assert own.sweeps_boxes == pytest.approx((40, 40))
    assert more.sweeps_mb == pytest.approx((1.5, 1.5))
    assert more.sweeps_boxes == pytest.approx((130, 130))
    assert found.curves[INT8][-1].ap50.mean == pytest.approx(0.62)
    assert found.differences[f"{INT8}{MORE} - {INT8}"].mean == pytest.approx(0.1)
    assert MegabytesResult.from_json(found.as_json(), "x") == found
    shown = megabytes_tables(found)
    assert f"| {INT8} | 0.620 (" in shown["matches"]
    assert "| 7.00 | 0.50 (0.50 to 0.50) | 40 (40 to 40) |" in shown["matches"]
    assert f"| {SWEEPS} | 10 sweeps | 1.00 | 80 | 0.720" in shown["curves"]
    assert "| seed 31 | 2.30 | 900 |" in shown["sizes"]
    assert any(
        line.startswith(f"{INT8}, 7.00 MB; megabytes of sweeps that reach it: 0.50") for line in found.sentences()
    )
    assert draw_megabytes(found).startswith(b"\x89PNG")


def test_a_federation_beyond_all_sweeps_is_told_as_such() -> None:
    curves = curves_of(0.0)
    best = (curves[INT8][0], AtBytes("10 rounds", 7.0, 0.9))
    found = compare_megabytes(RECIPE, {"31": SeedCurves({**curves, INT8: best}, 900, 2.3)})
    assert found.matches[INT8].sweeps_mb == (None,)
    assert (
        f"| {INT8} | 0.900 | 7.00 | not reached in 1 of 1 seeds | not reached in 1 of 1 seeds |"
        in (megabytes_tables(found)["matches"])
    )


def test_a_mean_point_has_the_mean_bytes_and_boxes() -> None:
    curves = [{"a": (AtBytes("3 sweeps", mb, 0.5, boxes),)} for mb, boxes in ((1.0, 10), (2.0, 30))]
    (point,) = average_curves(curves)["a"]
    assert (point.mb, point.boxes, point.ap50.mean) == (1.5, 20, pytest.approx(0.5))

"""Rare kinds among the targets, numbers of runs, tables and the picture of the comparison of corner cases."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from flcav.geometry import Boxes
from flcav.perception.objects.evaluate import score_detections
from flcav.perception.objects.truth import FrameTruth
from flcav.reproductions.corner_cases import run as corner_cases
from flcav.reproductions.corner_cases.run import (
    ARMS,
    COMPARED,
    GLOBAL,
    LOCAL,
    OWN,
    TOWNS,
    CornerCaseResult,
    RareScore,
    compare_corner_cases,
    corner_case_tables,
    draw_corner_cases,
    is_rare,
    only_rare,
)
from flcav.runs.recipe import MAIN, load_run_recipe
from flcav.sources.recipe import recipe_path
from flcav.world.shapes import PARKED_ONLY, RARE, SHAPES

RECIPE = load_run_recipe(recipe_path("runs/corner_cases"))


def boxes(*shapes: tuple[str, str], score: float | None = None) -> Boxes:
    """Return cars with the sizes of shapes (category, name), 10 m apart."""
    sizes = [next(shape[1:] for shape in SHAPES[kind] if shape.name == name) for kind, name in shapes]
    center = np.array([(10.0 * i, 0.0, 1.0) for i in range(len(shapes))])
    label = np.array(["Car"] * len(shapes))
    found = Boxes(center, np.array(sizes, float).reshape(-1, 3), np.zeros(len(shapes)), label)
    return found if score is None else replace(found, score=np.full(len(shapes), score))


def test_the_arms_and_towns_are_those_of_the_recipe() -> None:
    assert {learned.arm for learned in ARMS.values()} == {MAIN, *RECIPE.arms}
    assert {*TOWNS} == {name for name in RECIPE.regions if name != "suburb"}
    assert all({after, before} <= {*TOWNS[town]} for town, after, before, _ in COMPARED)
    drawn = {name: own.recording.rare_splits for name, own in RECIPE.regions.items() if own.recording.rare}
    assert drawn == {"grid": ("test",), "ring": ("edge", "test"), "arterial": ("test",)}


def test_rare_kinds_are_known_by_their_sizes_and_no_common_one_has_them() -> None:
    for kind in ("car", "van"):
        for shape in SHAPES[kind]:
            assert is_rare(boxes((kind, shape.name)))[0] == (shape.name in RARE)
    asked = {name for own in RECIPE.regions.values() for name in own.recording.rare or {}}
    assert asked == {name for name, kind in RARE.items() if kind in ("car", "van")} - {"angled"}
    assert "overturned" in PARKED_ONLY


def test_common_objects_are_neither_found_nor_missed_where_rare_ones_are_asked_for() -> None:
    seen = boxes(("car", "sedan"), ("van", "box_van"), ("car", "sedan"))
    truth = FrameTruth("a", seen[np.array([0, 1])], seen[:0], seen[:0])
    alone = only_rare(truth)
    assert (len(alone.targets), len(alone.neutral)) == (1, 1)

    def ap(found: Boxes) -> float | None:
        scores = score_detections([found], [alone], ("Car",))
        return next(row.ap for row in scores if (row.kind, row.iou) == ("3d", 0.5))

    both = replace(seen, score=np.array([0.9, 0.5, 0.1]))
    assert ap(both[np.array([0, 1])]) == pytest.approx(1)  # the common one does no harm
    assert ap(both[np.array([0])]) == 0
    false = replace(both, score=np.array([0.9, 0.5, 0.95]))
    assert ap(false) == pytest.approx(0.5)  # what lies on nothing does


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> CornerCaseResult:
    """Return the results of two seeds whose edge + cloud FL gains .1 and .2 on rare kinds, and loses .01 on all."""

    def score(run: Any, work: Path, arm: str, town: str) -> RareScore:
        cloud = arm == GLOBAL
        return RareScore(0.7 - 0.01 * cloud, 0.3 + 0.1 * run.recipe.seed * cloud, 50)

    monkeypatch.setattr(corner_cases, "score_arm", score)
    runs = [cast("Any", SimpleNamespace(recipe=SimpleNamespace(seed=seed))) for seed in (1, 2)]
    return compare_corner_cases(RECIPE, runs, [Path("a"), Path("b")])


def test_differences_are_of_the_same_seed(results: CornerCaseResult) -> None:
    gain = results.differences[f"{OWN}, rare kinds: {GLOBAL} - {LOCAL}"]
    assert (gain.mean, gain.seeds) == (pytest.approx(0.15), 2)
    assert results.differences[f"{OWN}, all objects: {GLOBAL} - {LOCAL}"].mean == pytest.approx(-0.01)
    assert results.rare[OWN][GLOBAL].mean == pytest.approx(0.45)
    told = " ".join(results.sentences())
    assert "grid, edge + cloud FL: AP50 of rare kinds 0.450" in told
    assert CornerCaseResult.from_json(results.as_json(), "result.json") == results


def test_tables_and_picture_have_every_town_and_arm(results: CornerCaseResult) -> None:
    tables = corner_case_tables(results)
    arms = sum(map(len, TOWNS.values()))
    assert [tables[name].count("\n") for name in ("scores", "differences", "seeds")] == [
        arms + 1,
        len(COMPARED) + 1,
        arms + 1,
    ]
    assert "| grid, edge + cloud FL | 0.400, 0.690 | 0.500, 0.690 |" in tables["seeds"]
    with Image.open(BytesIO(draw_corner_cases(results))) as picture:
        assert min(picture.size) > 300

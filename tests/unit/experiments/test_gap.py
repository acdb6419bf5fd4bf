"""Where the gap is: numbers of runs, shares of the gap, costs at home, tables and the picture."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from flcav.experiments.megabytes import ROUNDS, AtBytes, list_uploads
from flcav.reproductions.gap.run import (
    ARMS,
    AT_HOME,
    BOXES,
    COMPARED,
    FEDERATED,
    GLOBAL,
    HOME,
    IMITATING,
    ORACLE,
    PRETRAINED,
    REPLAY,
    ROAD,
    TRACKS,
    TRUTH,
    GapResult,
    compare_gap,
    draw_gap,
    draw_megabytes,
    gap_tables,
)
from flcav.runs.recipe import MAIN, load_run_recipe
from flcav.runs.results.training import LabelQuality
from flcav.sources.recipe import recipe_path

RECIPE = load_run_recipe(recipe_path("runs/gap"))
AP50 = dict.fromkeys(ARMS, 0.6) | {  # in the town that federates
    PRETRAINED: 0.5,
    ROAD: 0.66,
    TRACKS: 0.7,
    BOXES: 0.72,
    TRUTH: 0.8,
    ORACLE: 0.9,
}
AT_HOME_AP50 = dict.fromkeys(AT_HOME, 0.88) | {PRETRAINED: 0.9, GLOBAL: 0.82, IMITATING: 0.86}


def run_of(seed: int, more: float) -> Any:
    """Return what is asked of a run: `AP50` and `more` in the town that federates, `AT_HOME_AP50` at home."""

    def tested(arm: str, stage: str, region: str, task: str) -> Any:
        name = next(name for name, each in ARMS.items() if each == (arm, stage))
        ap50 = AP50[name] + more if region != HOME else AT_HOME_AP50[name]
        return SimpleNamespace(estimate=SimpleNamespace(mean=ap50), numbers={"AP70": ap50 / 2})

    labels = (LabelQuality(1, 10, 20, 0.9, 0.8),)
    stages = [SimpleNamespace(stage="edge", region="grid", labels=labels)]
    arms = {arm: SimpleNamespace(stages=stages) for arm in (MAIN, *RECIPE.arms)}
    return SimpleNamespace(recipe=SimpleNamespace(seed=seed), test=tested, arms=arms)


def test_the_arms_are_those_of_the_recipe() -> None:
    assert {arm for arm, _ in ARMS.values()} == {MAIN, *RECIPE.arms} - {arm for arm, _ in list_uploads(RECIPE)}
    assert {name for pair in COMPARED for name in pair} <= {*ARMS}
    remedies = {arm: own for arm, own in RECIPE.arms.items() if "cloud" in own.stages and own.central is None}
    joint = {arm for arm, own in RECIPE.arms.items() if own.central == "all"}
    assert {ARMS[name][0] for name in AT_HOME} == {MAIN, *remedies, *joint}
    assert {own.federation["replay"] for own in remedies.values()} == {0}  # one remedy at a time
    assert {*FEDERATED.values()} <= {MAIN, *RECIPE.arms}
    assert [number for _, number in list_uploads(RECIPE)] == [6, 15, 30, 59]
    assert RECIPE.tasks["objects"].plan is not None
    assert RECIPE.tasks["objects"].plan.edge_rounds == ROUNDS[-1]


def test_shares_of_the_gap_and_costs_at_home() -> None:
    curves = [{"edge FL on tracks": (AtBytes("3 rounds", 8.0, 0.6 + more),)} for more in (0.0, 0.02)]
    found = compare_gap(RECIPE, cast(Any, [run_of(1, 0.0), run_of(2, 0.02)]), curves)
    (point,) = found.megabytes["edge FL on tracks"]
    assert (point.mb, point.ap50.mean) == (8.0, pytest.approx(0.61))
    assert found.closed50[PRETRAINED].mean == 0
    assert found.closed50[TRUTH].mean == pytest.approx(1)
    assert found.closed50[TRACKS].mean == pytest.approx(2 / 3)  # (.7 - .5) / (.8 - .5)
    assert found.closed70[ORACLE].mean == pytest.approx(4 / 3)
    assert found.differences[f"{TRUTH} - {BOXES}"].mean == pytest.approx(0.08)
    assert found.differences[f"{TRACKS} - {ROAD}"].mean == pytest.approx(0.04)
    assert {GLOBAL, REPLAY, IMITATING} < {*found.home50} == {*AT_HOME} - {PRETRAINED}
    assert [found.home50[name].mean for name in (GLOBAL, REPLAY, IMITATING)] == pytest.approx([-0.08, -0.02, -0.04])
    assert found.home70[GLOBAL].mean == pytest.approx(-0.04)
    assert (found.seeds["1"][TRACKS].precision, found.seeds["1"][ORACLE].precision) == (0.9, None)
    assert GapResult.from_json(found.as_json(), "x") == found
    shown = gap_tables(found)
    assert f"| {TRACKS} | 0.710" in shown["arms"]
    assert next(row for row in shown["arms"].splitlines() if f"| {TRACKS} |" in row).endswith("| 0.900 | 0.800 |")
    assert f"| {PRETRAINED} | 0.900 | | 0.450 | |" in shown["home"]
    assert f"| {GLOBAL} | 0.820 | -0.080 (-0.080 to -0.080) | 0.410 | -0.040" in shown["home"]
    assert f"| {ORACLE} | 0.900, 0.450 | 0.920, 0.460 |" in shown["seeds"]
    assert any(line.startswith(f"at home, {REPLAY}: AP50 -0.020") for line in found.sentences())
    assert "| edge FL on tracks | 3 rounds | 8.0 | 0.610" in shown["megabytes"]
    assert all(draw(found).startswith(b"\x89PNG") for draw in (draw_gap, draw_megabytes))

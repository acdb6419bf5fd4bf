"""The comparison of what vehicles learn from: numbers of runs, means, shares and tables."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from flcav.reproductions.distillation.run import (
    ARMS,
    AVERAGE,
    DENSEST,
    IDEAL,
    JOINED,
    PRETRAINED,
    ROAD,
    TRACKS,
    compare_labels,
    tables,
)
from flcav.runs.recipe import EDGE, MAIN, load_run_recipe
from flcav.runs.results.run import Spent
from flcav.runs.results.training import LabelQuality
from flcav.sources.recipe import recipe_path

RECIPE = load_run_recipe(recipe_path("runs/distillation"))
AP50 = {PRETRAINED: 0.5, ROAD: 0.55, AVERAGE: 0.54, TRACKS: 0.58, DENSEST: 0.585, JOINED: 0.6, IDEAL: 0.61}


def run_of(seed: int, more: float) -> Any:
    """Return what is asked of a run: `AP50` and `more`, labels before two rounds of the run itself."""

    def reached(arm: str, stage: str, **about: str) -> Any:
        name = next(name for name, each in ARMS.items() if each == (arm, stage))
        return SimpleNamespace(estimate=SimpleNamespace(mean=AP50[name] + more), numbers={"AP70": 0.2})

    def stages(arm: str) -> list[Any]:
        labels = (LabelQuality(1, 10, 20, 0.8, 0.4), LabelQuality(2, 12, 20, 0.75, 0.45))
        return [SimpleNamespace(stage=EDGE, region="grid", labels=labels if arm == MAIN else labels[:1])]

    spent = [Spent(EDGE, "objects", "wireless", 32.5), Spent("pretrain", "objects", "wireless", 20.0)]
    arms = {arm: SimpleNamespace(stages=stages(arm), spent=spent) for arm in (MAIN, *RECIPE.arms)}
    return SimpleNamespace(recipe=SimpleNamespace(seed=seed), test=reached, arms=arms)


def test_every_arm_of_the_recipe_is_compared_in_stage_two() -> None:
    assert {arm for arm, _ in ARMS.values()} == {MAIN, *RECIPE.arms}
    assert all(arm.stages == (EDGE,) for arm in RECIPE.arms.values())


def test_means_differences_and_the_share_that_tracks_bring() -> None:
    found = compare_labels(RECIPE, cast(Any, [run_of(1, 0.0), run_of(2, 0.02)]))
    assert found.ap50[JOINED].mean == pytest.approx(0.61)
    assert found.differences[f"{JOINED} - {TRACKS}"].mean == pytest.approx(0.02)
    assert found.differences[f"{AVERAGE} - {TRACKS}"].mean == pytest.approx(-0.04)
    assert found.closed.mean == pytest.approx(0.8)  # (.58 - .5) / (.6 - .5)
    assert found.seeds["1"][JOINED].up_mb == 32.5
    assert found.seeds["1"][PRETRAINED].labels == ()
    shown = tables(found)
    assert "| tracks and road labels, VRCSP pole | 0.800 | 0.400 | 0.750 | 0.450 |" in shown["labels"]
    assert "| tracks, no road sensor | 0.800 | 0.400 | 0.800 | 0.400 |" in shown["labels"]
    assert "32.50 MB" in shown["arms"]
    assert any("that tracks bring without one: 0.800" in sentence for sentence in found.sentences())

"""What a run recipe may say, and the sentence where it says something else."""

from pathlib import Path
from typing import Any

import pytest

from flcav.config import InputError, parse_config
from flcav.runs.analysis.histories import history_recipes
from flcav.runs.recipe import SIZES, SPLITS_OF, RunRecipe, load_run_recipe

RUNS = Path(__file__).parents[3] / "recipes" / "runs"
WHOLE: dict[str, Any] = {
    "tasks": {"objects": {"history": "objects"}},
    "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 3}},
    "budgets_mb": {"wireless": 100, "wireline": 100},
}


def parsed(**changes: Any) -> RunRecipe:
    return parse_config(RunRecipe, WHOLE | changes, "run.yaml")


def test_defaults_are_those_of_the_article() -> None:
    recipe = parsed()
    assert recipe.placement.rule == "vrcsp"
    assert recipe.placement.tasks == ("objects",)
    assert recipe.federation.strategy == "fedavg"
    assert recipe.vehicles("grid") == 3
    assert recipe.sized_splits == SIZES["demo"][0]
    assert (
        parsed(tasks={"weather": {"plan": {"samples": 8, "edge_rounds": 1, "cloud_rounds": 0}}}).placement.tasks == ()
    )


def test_the_recipe_of_the_article_has_its_sizes() -> None:
    recipe = load_run_recipe(RUNS / "article.yaml")
    sizes = recipe.sized_splits
    assert sizes.pool.scenes * sizes.pool.spins * sizes.pool.cavs == 5000
    assert sizes.edge.scenes * sizes.edge.spins == 500  # of each vehicle
    assert [recipe.vehicles(region) for region in ("Town05", "Town03")] == [4, 3]
    assert sizes.test.scenes * sizes.test.spins * sizes.test.cavs == 2432
    assert (recipe.budgets_mb.wireless, recipe.budgets_mb.wireline) == (4000, 4000)


@pytest.mark.parametrize("path", sorted(RUNS.glob("*.yaml")), ids=lambda path: path.stem)
def test_committed_recipes_are_read(path: Path) -> None:
    recipe = load_run_recipe(path)
    assert RunRecipe.model_validate(recipe.model_dump(mode="json")) == recipe


def test_the_full_size_tests_on_300_frames_or_more() -> None:
    test = SIZES["full"][0].test
    assert test.scenes * test.spins * test.cavs >= 300


def test_every_region_is_validated_and_tested() -> None:
    assert all({"validation", "test"} <= set(splits) for splits in SPLITS_OF.values())


STARTED = {"objects": {"weights": "shipped", "plan": {"samples": 0, "edge_rounds": 1, "cloud_rounds": 1}}}
ARM = {"placement": {"rule": "densest"}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tasks": {}}, "tasks"),
        ({"tasks": {"objects": None}}, "'objects' needs 'history', learning curves to plan by, or 'plan', a fixed one"),
        (
            {"tasks": {"objects": {"history": "objects", "plan": {"samples": 1, "edge_rounds": 1, "cloud_rounds": 1}}}},
            "it has both",
        ),
        (
            {"tasks": {"objects": {"plan": {"samples": 0, "edge_rounds": 1, "cloud_rounds": 1}}}},
            "a plan of 0 samples trains nothing in stage I: name the 'weights' to begin with",
        ),
        ({"tasks": STARTED, "arms": {"more": {"central": "pretrain"}}}, "more pretraining goes with samples"),
        ({"tasks": STARTED, "arms": {"joint": {"central": "all"}}}, "training on all regions goes with samples"),
        ({"arms": {"few": {"central": "federate", "compressed": True}}}, "a form of uploads; give their number"),
        ({"tasks": STARTED, "federation": {"replay": 0.3}}, "the cloud trains on samples of stage I"),
        ({"regions": {"grid": {"role": "federate"}}}, "one with the role pretrain is wanted"),
        ({"regions": {"suburb": {"role": "pretrain"}}}, "one with the role federate is wanted"),
        ({"regions": {"a": {"role": "pretrain", "vehicles": 2}}}, "'vehicles' belong to a town with the role federate"),
        ({"regions": {"a": {"role": "pretrain", "town": "grid", "data": "d"}}}, "give either 'town' or 'data'"),
        ({"regions": {"a": {"role": "unseen", "data": {"test": "d"}}}}, "'data' lacks validation"),
        ({"regions": {"a b": {"role": "unseen"}}}, "String should match pattern"),
        ({"budgets_mb": {"wireless": 0, "wireline": 1}}, "wireless"),
        ({"arms": {"main": ARM}}, "'main' is the run itself"),
        ({"arms": {"x": {"placement": {"rule": "best"}}}}, "arms.x.placement: field 'rule' = 'best'"),
        ({"arms": {"x": {"regions": ["suburb"]}}}, "arms.x.regions: 'suburb' is none of grid"),
        ({"arms": {"x": {"labels": {"signs": "annotated"}}}}, "arms.x.labels: 'signs' is none of objects"),
        ({"arms": {"x": {"stages": ["cloud"]}}}, "must be [edge], [edge, cloud] or [edge, more_edge]"),
        ({"placement": {"tasks": ["signs"]}}, "'signs' is none of the run's tasks: objects"),
        (
            {"recording": {"grid": {"weather": "fog"}}},
            "recording.grid: 'grid' is one of the regions; write regions.grid.recording",
        ),
        ({"recording": {"objects": {}}}, "recording.objects: 'objects' is one of the tasks; write tasks.objects.rec"),
        ({"training": {"objects": {"steps": 9}}}, "'objects' is one of the tasks; write tasks.objects.training"),
        ({"recording": {"fog": {}}}, "unknown field 'recording.fog'; known fields: cal"),
        ({"size": "huge"}, "'toy', 'demo' or 'full'"),
        ({"rounds": 3}, "unknown field 'rounds'; known fields: arms, budgets_mb"),
    ],
)
def test_what_cannot_be_run_is_refused_in_a_sentence(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError) as refused:
        parsed(**changes)
    assert said in str(refused.value)
    assert str(refused.value).startswith("run.yaml: ")


def test_a_history_of_a_recipe_with_arms_claims_and_a_horizon_has_ample_time_and_claims_nothing() -> None:
    (own,) = history_recipes(load_run_recipe(RUNS / "demo.yaml"), "objects", [40], 10, 5, [101]).values()
    plan = own.tasks["objects"].plan
    assert plan is not None
    assert (plan.samples, plan.edge_rounds, plan.cloud_rounds, own.seed) == (40, 10, 5, 101)
    assert (own.horizon_s, own.primary_claims, dict(own.arms), own.retrainings) == (None, (), {}, 0)

"""`local_steps: fit` in a recipe: as many local steps as the horizon holds over all rounds."""

from typing import Any

import pytest

from flcav.config import InputError, parse_config
from flcav.runs.recipe import RunRecipe


def recipe(**changes: Any) -> RunRecipe:
    values = {
        "training": {"local_steps": "fit", "local_rate": 0.7},
        "tasks": {"objects": {"plan": {"samples": 40, "edge_rounds": 6, "cloud_rounds": 2}, "train_s": 1.6}},
        "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 3}},
        "budgets_mb": {"wireless": 100, "wireline": 80},
        "federation": {"edge_rounds_per_cloud_round": 3},
        "horizon_s": 60,
    }
    return parse_config(RunRecipe, {name: each for name, each in (values | changes).items() if each is not None}, "it")


def test_the_steps_are_the_most_whose_rounds_end_within_the_horizon() -> None:
    """By hand: 6 + 3 * 2 = 12 rounds in 60 s are 5 s a round, and a step takes .1 s: 50 steps."""
    found = recipe()
    assert (found.training_of("objects").local_steps, found.training_of("objects").local_rate) == (50, 0.7)
    assert found.tasks["objects"].train_s == pytest.approx(5.0)
    assert found.horizon_s is None  # which a run of fixed plans alone refuses
    assert recipe(horizon_s=59.9).training_of("objects").local_steps == 49
    again = parse_config(RunRecipe, found.model_dump(mode="json"), "it")
    assert again == found


def test_tasks_share_the_time_and_limits_bound_the_rounds_of_a_history() -> None:
    """By hand: at most 5 + 3 * 1 = 8 rounds of 1.6 s and 3.2 s are 38.4 s with 16 steps: 25 in 60 s."""
    tasks = {name: {"history": name, "train_s": each} for name, each in (("objects", 1.6), ("weather", 3.2))}
    found = recipe(tasks=tasks, limits={"edge_rounds": [1, 5], "cloud_rounds": [1, 1]})
    assert (found.training_of("weather").local_steps, found.horizon_s) == (25, 60)
    assert [task.train_s for task in found.tasks.values()] == pytest.approx([2.5, 5.0])


def test_an_arm_has_the_most_beside_the_steps_of_the_run() -> None:
    """By hand: 12 rounds of 1.6 s with 8 steps are 19.2 s, and 25 steps 60 s."""
    arms = {"most": {"training": {"local_steps": "fit"}}, "fourfold": {"training": {"local_steps": 32}}}
    found = recipe(training={"local_steps": 8}, arms=arms)
    assert [found.arms[name].training["local_steps"] for name in arms] == [25, 32]
    assert (found.training_of("objects").local_steps, found.tasks["objects"].train_s) == (8, 1.6)
    toy = recipe(training=None, size="toy", arms={"most": {"training": {"local_steps": "fit"}}})
    assert toy.arms["most"].training["local_steps"] == 3  # 12 rounds of the preset's one step are 19.2 s


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"horizon_s": 1.0}, "no round can hold a step: 12 rounds of 16 steps take 19.2 s, and horizon_s is 1"),
        ({"horizon_s": None}, "needs 'horizon_s', in seconds"),
        ({"tasks": {"objects": {"plan": {"samples": 40, "edge_rounds": 6, "cloud_rounds": 2}}}}, "objects.train_s'"),
        ({"tasks": {"objects": {"history": "objects", "train_s": 1.0}}}, "needs the number of rounds of 'objects'"),
        ({"training": {"local_steps": "many"}}, "local_steps"),
        ({"training": {"local_steps": 0}}, "local_steps"),
        ({"training": {"local_steps": "x"}, "arms": {"most": {"training": {"local_steps": "fit"}}}}, "local_steps"),
        ({"federation": {"edge_rounds_per_cloud_round": "x"}}, "number of rounds"),
        (
            {"tasks": {"objects": {"history": "objects", "train_s": 1.0}}, "limits": {"edge_rounds": 3}},
            "number of rounds",
        ),
        ({"tasks": {"objects": {"plan": 3, "train_s": "soon"}}}, "number of rounds"),
        (
            {"training": None, "tasks": {"objects": {"history": "objects", "training": {"local_steps": "fit"}}}},
            "tasks.objects.training.local_steps: tasks share a vehicle's time",
        ),
        (
            {"tasks": {"objects": {"plan": {"samples": 4, "edge_rounds": 0, "cloud_rounds": 0}, "train_s": 1}}},
            "there is no round",
        ),
    ],
)
def test_steps_that_cannot_be_found_are_one_sentence(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told) as refused:
        recipe(**changes)
    assert str(refused.value).count("\n") == 0

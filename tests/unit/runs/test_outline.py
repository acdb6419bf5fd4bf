"""What a run refuses by its recipe, before anything is recorded."""

from pathlib import Path

import pytest

from flcav.config import InputError
from flcav.runs.recipe import RunRecipe
from flcav.runs.stages.outline import Outline


def outline_of(network: str) -> Outline:
    recipe = {
        "tasks": {"signs": {"network": network, "history": "signs"}},
        "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}},
        "budgets_mb": {"wireless": 1, "wireline": 1},
    }
    return Outline(RunRecipe.model_validate(recipe), Path())


@pytest.mark.parametrize(
    ("network", "why"),
    [("road", "signs: this network sees pictures of poles"), ("m", "network 'm': choose one of n, s, road")],
)
def test_a_network_that_vehicles_cannot_train_is_refused(network: str, why: str) -> None:
    with pytest.raises(InputError, match=f"^{why}"):
        outline_of(network)


def test_other_networks_of_the_task_are_taken() -> None:
    assert outline_of("s").recipe.tasks["signs"].network == "s"

"""A recipe of two federating regions, of five and of four vehicles, for tests of what federations take."""

from typing import Any

from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import RunRecipe

PRIVACY = {"clip": 1.0, "noise": 4.0}


def settings(arms: dict[str, Any], **federation: Any) -> tuple[RunRecipe, Any]:
    recipe = RunRecipe.model_validate(
        {
            "tasks": {"objects": {"history": "objects"}},
            "regions": {
                "suburb": {"role": "pretrain"},
                "grid": {"role": "federate", "vehicles": 5},
                "ring": {"role": "federate", "vehicles": 4},
            },
            "budgets_mb": {"wireless": 100, "wireline": 80},
            "federation": federation,
            "arms": {name: {"federation": own} for name, own in arms.items()},
        }
    )
    return recipe, resolve_settings(recipe, {"objects": "ideal-road"}).values()

"""Steps that register errors and place roadside sensors."""

from collections.abc import Iterator

from flcav.pipeline.arms import Setting
from flcav.pipeline.engine import Step
from flcav.pipeline.graph.outline import Outline
from flcav.pipeline.graph.recording import make_recording
from flcav.pipeline.recipe import EDGE
from flcav.pipeline.steps.placing import ErrorsSettings, PlaceSettings, errors_step, place_step
from flcav.pipeline.steps.settings import make_step


def list_placements(outline: Outline, arm: Setting, region: str) -> Iterator[Step]:
    """Yield the steps that register a region's errors, and that place an arm's sensors there."""
    recipe, names = outline.recipe, outline.names
    errors = {task: names.errors(arm.name, region, task) for task in arm.placement.tasks}
    for task, name in errors.items():
        settings = ErrorsSettings(
            task=task,
            region=region,
            plan=names.plan(arm.name),
            pretrained=names.pretrain(arm.name, task),
            registry=names.recording(region, "registry", task),
            vehicles=outline.vehicles,
            budgets_mb=recipe.budgets_mb,
        )
        yield make_step(name, errors_step, settings)
    recorded = recipe.regions[region].data is not None
    if recorded:
        yield make_recording(outline, region, EDGE, outline.placing_task)
    settings = PlaceSettings(
        region=region,
        how=arm.placement,
        errors=errors,
        weights={task: recipe.tasks[task].weight for task in errors},
        registry=names.recording(region, "registry", outline.placing_task),
        edge=names.recording(region, EDGE, outline.placing_task) if recorded else None,
        seed=recipe.seed if arm.placement.rule == "random" else None,
    )
    yield make_step(names.place(arm.name, region), place_step, settings)

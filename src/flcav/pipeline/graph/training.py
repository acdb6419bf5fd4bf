"""Steps of the stages of training, and of centralised training in place of stage II."""

from collections.abc import Iterator
from typing import Any

from flcav.fusion.navigation import NavigationErrors
from flcav.pipeline.arms import Setting
from flcav.pipeline.engine import Step
from flcav.pipeline.graph.outline import Outline
from flcav.pipeline.labels.sources import LABEL_SOURCES
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MORE_EDGE
from flcav.pipeline.steps.central import CentralSettings, central_step
from flcav.pipeline.steps.cloud import CloudSettings, cloud_step
from flcav.pipeline.steps.edge import EdgeSettings, edge_step
from flcav.pipeline.steps.pretraining import PretrainSettings, pretrain_step
from flcav.pipeline.steps.settings import make_step


def list_pretraining(outline: Outline, arm: Setting) -> Iterator[Step]:
    """Yield stage I of an arm, for each task."""
    recipe, names = outline.recipe, outline.names
    for task in recipe.tasks:
        kinds = [LABEL_SOURCES[each.labels[task]] for each in outline.settings.values()]
        settings = PretrainSettings(
            learning=outline.learning(arm, task),
            plan=names.plan(arm.name),
            pools=outline.pools(task),
            validation=tuple(names.recording(region, "validation", task) for region in recipe.with_role("pretrain")),
            budgets_mb=recipe.budgets_mb,
            upload_seed=recipe.seed,
            thresholded=any(kind.from_detections for kind in kinds),
        )
        yield make_step(names.pretrain(arm.name, task), pretrain_step, settings)


def list_edge_stages(outline: Outline, arm: Setting) -> Iterator[Step]:
    """Yield stage II of an arm, or its centralised training, for each task and region."""
    for task in outline.recipe.tasks:
        averaged = any(LABEL_SOURCES[each.labels[task]].averaged for each in outline.settings.values())
        for region in arm.regions:
            if arm.central:
                yield _centralise(outline, arm, region, task)
                continue
            name, inputs = outline.names.edge(arm.name, region, task), outline.inputs(arm, region, task, EDGE)
            about = _federate(outline, arm, task, EDGE)
            settings = EdgeSettings(**about, inputs=inputs, scored=averaged, last=arm.stages[-1] == EDGE)
            yield make_step(name, edge_step, settings, outline.vehicles[region])


def list_further_stages(outline: Outline, arm: Setting) -> Iterator[Step]:
    """Yield what follows stage II in an arm, for each task: stage III or further edge rounds."""
    names = outline.names
    last = next((stage for stage in (CLOUD, MORE_EDGE) if stage in arm.stages), None)
    if last is None:
        return
    for task in outline.recipe.tasks:
        inputs = {
            region: outline.inputs(arm, region, task, last).model_copy(
                update={"edge": names.edge(arm.name, region, task)}
            )
            for region in arm.regions
        }
        if last == CLOUD:
            name = names.cloud(arm.name, task)
            about = _federate(outline, arm, task, CLOUD)
            scored = arm.regions if arm.federation.score_statistics else ()
            validation = {region: names.recording(region, "validation", task) for region in scored}
            settings = CloudSettings(**about, regions=inputs, validation=validation)
            at_once = max(outline.vehicles[region] for region in arm.regions)  # of one edge server
            yield make_step(name, cloud_step, settings, at_once)
            continue
        for region, own in inputs.items():
            name = names.more_edge(arm.name, region, task)
            about = _federate(outline, arm, task, last)
            yield make_step(name, edge_step, EdgeSettings(**about, inputs=own), outline.vehicles[region])


def _federate(outline: Outline, arm: Setting, task: str, stage: str) -> dict[str, Any]:
    """Return the fields of `FederationSettings` of a stage of a task."""
    recipe, timed = outline.recipe, arm.federation.network is not None
    given = {name: recipe.speeds(name) for name in outline.federating}
    speeds = {f"{region}/{vehicle}": speed for region in given for vehicle, speed in given[region].items()}
    return {
        "learning": outline.learning(arm, task),
        "federation": arm.federation if stage == CLOUD else arm.edge_federation,
        "budgets_mb": recipe.budgets_mb,
        "vehicles": outline.vehicles,
        "labels": arm.labels[task],
        "distillation": arm.distillation if LABEL_SOURCES[arm.labels[task]].averaged else None,
        "navigation": recipe.navigation if LABEL_SOURCES[arm.labels[task]].from_poles else NavigationErrors(),
        "train_s": recipe.tasks[task].train_s if timed else 0.0,
        "speeds": speeds if timed else {},
    }


def _centralise(outline: Outline, arm: Setting, region: str, task: str) -> Step:
    inputs = outline.inputs(arm, region, task, CENTRAL)
    settings = CentralSettings(
        learning=outline.learning(arm, task),
        inputs=inputs.model_copy(update={"pools": outline.pools(task)}),
        vehicles=outline.vehicles[region],
        source=arm.central or "pretrain",
    )
    return make_step(outline.names.central(arm.name, region, task), central_step, settings)

"""Caveats of a run's labels and of its privacy, which are stated with its results."""

from collections.abc import Iterable, Mapping

from flcav.fusion.road import TRAINED_IN
from flcav.runs.arms import Setting
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MORE_EDGE, RunRecipe
from flcav.runs.results.run import ArmResult
from flcav.runs.results.training import StageResult, diverges
from flcav.world.map.town import HILLY

STAGES = {EDGE: "stage II", CLOUD: "stage III", MORE_EDGE: "further edge rounds", CENTRAL: "centralised training"}
DIVERGING = "the training diverged"
PLACED_BARE = "vehicles send the places of their errors as they are: neither noise nor masks cover the error registry"


def list_caveats(recipe: RunRecipe, labels: Iterable[str], settings: Iterable[Setting]) -> tuple[str, ...]:
    """Return the caveats of the kinds of `labels`, of a road detector in the towns of its training, and of privacy.

    `settings`: those of all arms.
    """
    settings = [*settings]
    general = dict.fromkeys(LABEL_SOURCES[kind].caveat for kind in labels)
    labelled = {
        region
        for setting in settings
        for region in setting.regions
        if any(LABEL_SOURCES[kind].trained for kind in setting.labels.values())
    }
    known = [
        region for region in recipe.with_role("federate") if region in labelled and _was_trained_in(recipe, region)
    ]
    trained = (
        f"the road detector was trained in {' and '.join(known)}, so that its labels are better there than elsewhere"
    )
    bare = [PLACED_BARE] if any(_places_bare(setting) for setting in settings) else []
    return (*filter(None, general), *([trained] if known else []), *bare)


def list_unreached(arms: Mapping[str, ArmResult], settings: Mapping[str, Setting], range_m: float) -> tuple[str, ...]:
    """Return a caveat per region that has sensors, but no vehicle within `range_m` [m] of one in stage II."""
    found = {
        stage.region
        for name, arm in arms.items()
        for stage in arm.stages
        if stage.stage == EDGE and LABEL_SOURCES[settings[name].labels[stage.task]].from_poles and not stage.poles
        if any(placed.region == stage.region and placed.chosen for placed in arm.placed)
    }
    consequence = "so that all took part, without labels from the road"
    where = f"within {range_m:g} m (placement.group_range_m) of a sensor in the frames of stage II"
    return tuple(f"no vehicle of '{region}' came {where}, {consequence}" for region in sorted(filter(None, found)))


def list_diverged(arms: Mapping[str, ArmResult]) -> tuple[str, ...]:
    """Return a caveat per arm and task whose training diverged, with its first and last loss."""
    found = []
    for name, arm in arms.items():
        first: dict[str, float | None] = {}  # by task
        for stage in arm.stages:
            losses = (first.get(stage.task), *stage.losses) if stage.stage == CLOUD else stage.losses
            first.setdefault(stage.task, next((loss for loss in losses if loss is not None), None))
            known = [loss for loss in losses if loss is not None]
            if diverges(losses) or stage.kept is not None:
                at = f"{stage.task} in {_name_stage(name, stage)}"
                sentence = f"{DIVERGING}: {at}, its loss went from {known[0]:.3g} to {known[-1]:.3g}"
                if stage.kept is not None:
                    weights = f"after round {stage.kept}" if stage.kept else "that it began with"
                    sentence += f"; it stopped in round {stage.rounds}, and has the weights {weights}"
                    further = any(later.stage in (CLOUD, MORE_EDGE) for later in arm.stages)
                    sentence += "; no rounds follow" if stage.stage == EDGE and further else ""
                found.append(sentence)
    return tuple(found)


def list_cut(arms: Mapping[str, ArmResult], settings: Mapping[str, Setting]) -> tuple[str, ...]:
    """Return a caveat per arm and task for which the privacy budget afforded fewer rounds than planned."""
    found = []
    for name, arm in arms.items():
        privacy = settings[name].federation.privacy
        for stage in arm.stages if privacy is not None and privacy.epsilon is not None else ():
            plan = arm.plan.tasks[stage.task]
            planned = plan.cloud_rounds if stage.stage == CLOUD else plan.edge_rounds
            stopped = any(result.kept is not None for result in arm.stages if result.task == stage.task)
            if stage.stage in (EDGE, CLOUD) and stage.rounds < planned and not stopped:
                at = _name_stage(name, stage)
                found.append(f"privacy affords {stage.rounds} of {planned} planned rounds of {stage.task} in {at}")
    return tuple(found)


def _name_stage(arm: str, stage: StageResult) -> str:
    return f"{STAGES[stage.stage]} of '{arm}'" + (f" on {stage.region}" if stage.region else "")


def _places_bare(setting: Setting) -> bool:
    """Return whether vehicles send the places of their errors unprotected, while noise or masks hide their updates."""
    hidden = setting.federation.privacy is not None or setting.federation.secure is not None
    return hidden and setting.central is None and bool(setting.placement.tasks)


def _was_trained_in(recipe: RunRecipe, region: str) -> bool:
    place = recipe.regions[region]
    town = place.town or region
    return place.data is None and HILLY.get(town, town) in TRAINED_IN

"""Steps that plan a run, and plan the rest of it anew after a stage."""

from flcav.pipeline.arms import Setting
from flcav.pipeline.engine import Step
from flcav.pipeline.graph.outline import Outline
from flcav.pipeline.graph.testing import list_validations
from flcav.pipeline.planning.histories import read_history
from flcav.pipeline.planning.updates import update_forms
from flcav.pipeline.recipe import CLOUD, EDGE, MAIN
from flcav.pipeline.steps.planning import (
    AirSettings,
    FirstPlanSettings,
    LabelSettings,
    PlannedTask,
    ReplanSettings,
    plan_step,
    replan_step,
)
from flcav.pipeline.steps.settings import make_step
from flcav.pipeline.steps.uploads import UploadSettings


def make_plan(outline: Outline, arm: Setting) -> Step:
    """Return the step that makes an arm's first plan."""
    recipe, air, uploads = outline.recipe, _predict_air(outline), None
    if recipe.uploads == "planned":
        network, range_m = recipe.federation.network, recipe.placement.range_m
        uploads = UploadSettings(regions=recipe.with_role("pretrain"), network=network, range_m=range_m)
    held = _count_held(outline)
    settings = FirstPlanSettings(
        rule=arm.plan,
        seed=recipe.seed,
        budgets_mb=recipe.budgets_mb,
        headroom=recipe.headroom,
        limits=recipe.limits,
        horizon_s=recipe.horizon_s,
        edge_rounds_per_cloud_round=recipe.federation.edge_rounds_per_cloud_round,
        tasks={task: _plan_task(outline, task) for task in recipe.tasks},
        held=held,
        speeds=_list_speeds(outline, held, timed=air is not None),
        updates=tuple(update_forms(outline.settings.values())),
        uploads=uploads,
        air=air,
    )
    return make_step(outline.names.plan(arm.name), plan_step, settings)


def make_replan(outline: Outline, stage: str) -> Step:
    """Return the step that plans the rest of the run anew after stage I or II, from what the run itself reached."""
    names, main = outline.names, outline.settings[MAIN]
    tasks = [name for name, task in outline.recipe.tasks.items() if task.history is not None]
    edges = {task: tuple(names.edge(MAIN, region, task) for region in main.regions) for task in tasks}
    settings = ReplanSettings(
        stage="edge" if stage == EDGE else "pretrain",
        first=names.plan(MAIN),
        plan=names.plan(MAIN, stage),
        watched={task: tuple(step.name for step in list_validations(outline, stage, task)) for task in tasks},
        books={task: (names.pretrain(MAIN, task), *(edges[task] if stage == EDGE else ())) for task in tasks},
    )
    return make_step(names.plan(MAIN, CLOUD if stage == EDGE else EDGE), replan_step, settings)


def _plan_task(outline: Outline, task: str) -> PlannedTask:
    own = outline.recipe.tasks[task]
    return PlannedTask(
        network=own.network,
        weight=own.weight,
        train_s=own.train_s,
        fixed=own.plan,
        history=None if own.history is None else read_history(task, own.history, outline.beside),
        pools=tuple(outline.pools(task).values()),
        labels=_label_task(outline, task),
    )


def _label_task(outline: Outline, task: str) -> LabelSettings | None:
    """Return what the messages of labels are predicted from; None where no arm labels by the road average."""
    arms = [arm for arm in outline.settings.values() if arm.central is None]
    averaging = outline.averaging(task)
    if not averaging:
        return None
    most = {"window_s": outline.window_s(task), "pose_graph": any(each.pose_graph for each in averaging)}
    placements, own = [arm.placement for arm in arms], outline.recipe.placement
    split = "registry" if task in (*own.tasks, outline.placing_task) else "validation"
    return LabelSettings(
        distillation=averaging[0].model_copy(update=most),  # the largest messages of any arm
        drives={region: outline.names.recording(region, split, task) for region in outline.federating},
        recorded=tuple(outline.recorded),
        poles=tuple(sorted({pole for each in placements for pole in each.poles})),
        count=max((each.count for each in placements if each.rule not in ("fixed", "none")), default=0),
        traffic_m=own.range_m,
        near_m=own.group_range_m,
    )


def _predict_air(outline: Outline) -> AirSettings | None:
    """Return what a plan within a horizon predicts times on the network from; None without a network."""
    recipe, network = outline.recipe, outline.recipe.federation.network
    if network is None or recipe.horizon_s is None:
        return None
    names, task = outline.names, outline.placing_task
    drives = {region: names.recording(region, "registry", task) for region in outline.federating}
    recorded = tuple(outline.recorded)
    return AirSettings(network=network, range_m=recipe.placement.range_m, drives=drives, recorded=recorded)


def _count_held(outline: Outline) -> dict[str, dict[str, int]]:
    """Return the vehicles of each federating region with their numbers of training frames."""
    recipe, each = outline.recipe, outline.recipe.sized_splits.edge
    return {
        region: outline.recorded.get(region)
        or {f"cav{number}": each.scenes * each.spins for number in range(recipe.vehicles(region))}
        for region in outline.federating
    }


def _list_speeds(outline: Outline, held: dict[str, dict[str, int]], timed: bool) -> dict[str, float]:
    """Return the speed of every vehicle, "region/vehicle"; empty where no region gives any, and no message is timed."""
    speeds = {region: outline.recipe.speeds(region) for region in held}
    if not timed and not any(speeds.values()):
        return {}
    return {f"{region}/{cav}": speeds[region].get(cav, 1.0) for region, own in held.items() for cav in own}

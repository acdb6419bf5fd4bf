"""Steps that test networks, validate rounds, and look at a sweep before and after."""

from collections.abc import Iterator

from flcav.pipeline.arms import Setting
from flcav.pipeline.engine import Step
from flcav.pipeline.graph.outline import Outline
from flcav.pipeline.recipe import EDGE, MAIN, PRETRAIN
from flcav.pipeline.steps.settings import make_step
from flcav.pipeline.steps.testing import (
    LookSettings,
    RoundsSettings,
    TestSettings,
    look_step,
    rounds_step,
    test_step,
)

LOOK, OBJECTS = "look", "objects"


def list_tests(outline: Outline, arm: Setting) -> Iterator[Step]:
    """Yield the tests of an arm; of the run itself also the look at a sweep, and the validations of all stages."""
    names = outline.names
    for stage, region, task in outline.tested(arm):
        trained, frames = names.stage(arm.name, stage, region, task), names.recording(region, "test", task)
        about = {"task": task, "region": region, "trained": trained, "frames": frames, "seed": outline.recipe.seed}
        for model in outline.models(arm, stage):
            yield make_step(names.test(trained, region, model), test_step, TestSettings(**about, model=model))
    if arm.name == MAIN:
        yield from _list_looks(outline, arm)
        for stage in (PRETRAIN, *arm.stages):
            for task in outline.recipe.tasks:
                yield from list_validations(outline, stage, task)


def list_validations(outline: Outline, stage: str, task: str) -> Iterator[Step]:
    """Yield the validations of a stage of the run itself in the federating regions."""
    names, main = outline.names, outline.settings[MAIN]
    for region in main.regions:
        trained, training = names.stage(MAIN, stage, region, task), main.training[task]
        settings = RoundsSettings(
            task=task,
            region=region,
            stage=stage,
            start=names.pretrain(MAIN, task),
            trained=trained,
            frames=names.recording(region, "validation", task),
            averaged=training.average_rounds,
            share=training.start_share if stage == EDGE else 0.0,
        )
        yield make_step(names.rounds(trained, region), rounds_step, settings)


def _list_looks(outline: Outline, main: Setting) -> Iterator[Step]:
    """Yield the look at a sweep of the first region before and after the stages; none where no objects are learned."""
    if OBJECTS in outline.recipe.tasks:
        names, region, stage = outline.names, main.regions[0], main.stages[-1]
        before, after = (names.stage(MAIN, each, region, OBJECTS) for each in (PRETRAIN, stage))
        frames = names.recording(region, "test", OBJECTS)
        yield make_step(LOOK, look_step, LookSettings(before=before, after=after, frames=frames))

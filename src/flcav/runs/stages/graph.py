"""The steps of a run in their order: plan, pretrain, register errors, place sensors, edge FL, cloud FL, test.

The steps of extras follow them.
"""

from collections.abc import Iterator
from pathlib import Path

from flcav.runs.arms import Setting
from flcav.runs.engine import Step
from flcav.runs.recipe import CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe
from flcav.runs.registry import STEPS, load_all
from flcav.runs.stages.centralised import list_central_steps, list_pretraining
from flcav.runs.stages.federating import list_edge_steps, list_more_edge_steps, make_cloud_step
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.placing import list_placements
from flcav.runs.stages.planning import make_plan_step, make_replan_step
from flcav.runs.stages.recording import list_recordings, make_recording
from flcav.runs.stages.testing import list_tests, list_validations
from flcav.runs.stages.tracking import list_tracks


class Graph(Outline):
    """The steps of a recipe in topological order: a step comes after those it needs.

    Raises `InputError` where a task, its labels, a town, a recording or a dataset cannot be used.
    """

    def __init__(self, recipe: RunRecipe, beside: Path) -> None:
        super().__init__(recipe, beside)
        steps: dict[str, Step] = {}
        for step in self._list_steps():
            steps.setdefault(step.name, step)  # arms that share a step have the same one
        self.steps = tuple(steps.values())

    def _list_steps(self) -> Iterator[Step]:
        """Yield the steps of all arms; shared steps occur more than once."""
        arms = self.settings.values()
        replanned = self.settings[MAIN].replanned
        yield from list_recordings(self)
        for arm in arms:
            yield from self._start(arm)
        if replanned:
            yield from self._replan(PRETRAIN)
        for region in self.federating:
            for task in self.recipe.tasks:
                yield make_recording(self, region, EDGE, task, self.sites(region))
        for arm in arms:
            for task in self.recipe.tasks:
                if not arm.central:
                    yield from list_tracks(self, arm, task)
                yield from (list_central_steps if arm.central else list_edge_steps)(self, arm, task)
        if replanned:
            yield from self._replan(EDGE)
        for arm in arms:
            for task in self.recipe.tasks:
                if CLOUD in arm.stages:
                    yield make_cloud_step(self, arm, task)
                elif MORE_EDGE in arm.stages:
                    yield from list_more_edge_steps(self, arm, task)
            yield from list_tests(self, arm)
        for list_further in load_all(STEPS):
            yield from list_further(self)

    def _start(self, arm: Setting) -> Iterator[Step]:
        """Yield the steps of an arm before it federates."""
        yield make_plan_step(self, arm)
        yield from list_pretraining(self, arm)
        for region in arm.regions:
            yield from list_placements(self, arm, region)

    def _replan(self, stage: str) -> Iterator[Step]:
        """Yield the validations of a stage for the tasks that are planned by a history, and the plan of the rest."""
        for name, task in self.recipe.tasks.items():
            if task.history is not None:
                yield from list_validations(self, stage, name)
        yield make_replan_step(self, stage)

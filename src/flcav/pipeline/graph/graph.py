"""The steps of a run in their order: plan, pretrain, register errors, place sensors, edge FL, cloud FL, test."""

from collections.abc import Iterator
from pathlib import Path

from flcav.pipeline.arms import Setting
from flcav.pipeline.engine import Step
from flcav.pipeline.graph.outline import Outline
from flcav.pipeline.graph.placement import list_placements
from flcav.pipeline.graph.planning import make_plan, make_replan
from flcav.pipeline.graph.recording import list_recordings, make_recording
from flcav.pipeline.graph.testing import list_tests, list_validations
from flcav.pipeline.graph.training import list_edge_stages, list_further_stages, list_pretraining
from flcav.pipeline.recipe import EDGE, MAIN, PRETRAIN, RunRecipe


class Graph(Outline):
    """The steps of a recipe in topological order: each comes after those it needs.

    Raises `InputError` where a task, its labels, a town, a recording or a dataset cannot be used.
    """

    def __init__(self, recipe: RunRecipe, beside: Path) -> None:
        super().__init__(recipe, beside)
        steps: dict[str, Step] = {}
        for step in self._list_steps():
            steps.setdefault(step.name, step)  # arms share a step: it is the same
        self.steps = tuple(steps.values())

    def _list_steps(self) -> Iterator[Step]:
        """Yield the steps of all arms, those that they share more than once."""
        arms, replanned = self.settings.values(), self.settings[MAIN].replanned
        yield from list_recordings(self)
        for arm in arms:
            yield from self._start(arm)
        if replanned:
            yield from self._replan(PRETRAIN)
        for region in self.federating:
            for task in self.recipe.tasks:
                yield make_recording(self, region, EDGE, task, self.sites(region))
        for arm in arms:
            yield from list_edge_stages(self, arm)
        if replanned:
            yield from self._replan(EDGE)
        for arm in arms:
            yield from list_further_stages(self, arm)
            yield from list_tests(self, arm)

    def _start(self, arm: Setting) -> Iterator[Step]:
        """Yield the steps of an arm before it federates."""
        yield make_plan(self, arm)
        yield from list_pretraining(self, arm)
        for region in arm.regions:
            yield from list_placements(self, arm, region)

    def _replan(self, stage: str) -> Iterator[Step]:
        """Yield the validations of a stage of the tasks that are planned by a history, and the plan of the rest."""
        for name, task in self.recipe.tasks.items():
            if task.history is not None:
                yield from list_validations(self, stage, name)
        yield make_replan(self, stage)

"""The step of stage I of a task: uploads, pretraining, and the score threshold of pseudo-labels."""

from collections.abc import Mapping
from typing import Any

from flcav.network.ledger import Ledger
from flcav.pipeline.engine import Work
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.pseudo_labels import fit_label_threshold
from flcav.pipeline.learning import load_stage_network
from flcav.pipeline.recipe import Budgets
from flcav.pipeline.results.plans import Plan
from flcav.pipeline.results.saved import LEDGER
from flcav.pipeline.results.training import Pretrained
from flcav.pipeline.stages.centralised import pretrain
from flcav.pipeline.stages.uploads import choose_planned_uploads, choose_uploads, upload_samples
from flcav.pipeline.steps.budgets import share_plan_budget
from flcav.pipeline.steps.settings import LearningSettings, StepSettings
from flcav.pipeline.steps.uploads import list_frames


class PretrainSettings(StepSettings):
    """Settings of stage I of a task."""

    learning: LearningSettings
    plan: str
    pools: Mapping[str, str]  # recordings of the candidates for upload, by region
    validation: tuple[str, ...]  # recordings of the frames that it is validated on
    budgets_mb: Budgets  # of the run
    upload_seed: int  # of the draw of uploads, the same in retrainings
    thresholded: bool  # whether detections serve as labels, from some score on

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (self.plan, *self.pools.values(), *self.validation)


def pretrain_step(work: Work, settings: PretrainSettings) -> None:
    """Run stage I of a task: upload the planned samples, train on them, fix the score threshold of pseudo-labels."""
    task, learning = settings.learning.task, settings.learning.resolve()
    plan = Plan.load(work.inputs[settings.plan])
    opened = {region: Frames.open(work.inputs[step]) for region, step in settings.pools.items()}
    watched = [Frames.open(work.inputs[step]) for step in settings.validation]
    uploads = plan.tasks[task].uploads
    if uploads is None:
        pools = {region: split.vehicles for region, split in opened.items()}
        chosen = choose_uploads(pools, plan.tasks[task].samples, settings.upload_seed)
    else:
        held = {region: dict(list_frames(region, split)) for region, split in opened.items()}
        chosen = choose_planned_uploads(held, uploads, settings.upload_seed)
    book, samples = Ledger(share_plan_budget(plan, settings.budgets_mb, task)), list[Any]()
    for region, frames in chosen.items():
        if frames:
            received = upload_samples(book, learning.task, learning.config, region, opened[region], frames)
            samples += [received[number] for number in range(len(received))]  # in memory: each is drawn many times
    book.save(work.folder / LEDGER)
    validated = pretrain(learning, samples, watched, work.folder, work.report)
    trained = load_stage_network(learning.task, work.folder)
    Pretrained(
        task=task,
        network=learning.network or next(iter(learning.task.configurations)),
        uploaded=chosen,
        validated=validated,
        steps=learning.training.steps,
        threshold=fit_label_threshold(trained, watched) if settings.thresholded else None,
    ).save(work.folder)

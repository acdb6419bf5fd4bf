"""The step of centralised training in place of stage II, on ground truth."""

from flcav.perception.weights import save_network
from flcav.pipeline.engine import Work
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import load_stage_network
from flcav.pipeline.recipe import CENTRAL, Role
from flcav.pipeline.results.plans import Plan
from flcav.pipeline.results.saved import WEIGHTS
from flcav.pipeline.results.training import Pretrained, StageResult
from flcav.pipeline.stages.centralised import train_centrally
from flcav.pipeline.steps.labelling import select_group
from flcav.pipeline.steps.settings import LearningSettings, RegionInputs, StepSettings


class CentralSettings(StepSettings):
    """Settings of centralised training for a region."""

    learning: LearningSettings
    inputs: RegionInputs
    vehicles: int  # of the region, whose local steps it takes
    source: Role  # pretrain: the uploaded samples; federate: the training frames of the region's vehicles

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return self.inputs.needs


def central_step(work: Work, settings: CentralSettings) -> None:
    """Continue training centrally on ground truth, for as many optimiser steps as stage II takes in the region."""
    learning, inputs = settings.learning.resolve(), settings.inputs
    trained = load_stage_network(learning.task, work.inputs[inputs.pretrain])
    if settings.source == "pretrain":
        uploaded = Pretrained.load(work.inputs[inputs.pretrain]).uploaded
        parts = [(Frames.open(work.inputs[inputs.pools[name]]), frames) for name, frames in uploaded.items()]
    else:
        split = Frames.open(work.inputs[inputs.frames])
        parts = [(split, select_group(work, split, inputs))]
    each = (learning.task.samples(split.data, trained.config, frames) for split, frames in parts)
    samples = [own[number] for own in each for number in range(len(own))]  # in memory: each is drawn many times
    rounds = Plan.load(work.inputs[inputs.plan]).tasks[settings.learning.task].edge_rounds
    losses = train_centrally(learning, trained, samples, rounds, settings.vehicles, settings.source)
    save_network(learning.task, trained, work.folder / WEIGHTS)
    about = (CENTRAL, settings.learning.task, inputs.region, rounds, len(samples), 1, ())
    StageResult(*about, losses).save(work.folder)

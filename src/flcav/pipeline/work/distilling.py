"""Federated distillation in the steps of stages II and III."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from flcav.fusion.distillation import Distillation
from flcav.network.ledger import Ledger
from flcav.perception.objects.distillation.loss import DistillationTerms, DistilledObjects
from flcav.pipeline.federations.distillation import RoadAverageLabels, measure_labels, read_history
from flcav.pipeline.frames import Frames
from flcav.pipeline.results import LabelQuality, Pretrained
from flcav.pipeline.stages import Learning, load_stage_network
from flcav.pipeline.steps import Work
from flcav.pipeline.work import Fields


def learn_by_distillation(learning: Learning, distillation: Fields) -> Learning:
    """Return the settings of a training whose loss is that of federated distillation."""
    how = Distillation.model_validate(distillation)
    on = ("regression" in how.terms, "contrastive" in how.terms)
    return replace(learning, task=DistilledObjects(DistillationTerms(*on, how.contrastive_weight, how.temperature)))


def label_by_average(
    work: Work,
    learning: Learning,
    region: str,
    steps: Mapping[str, Any],
    frames: Sequence[int],
    poles: Sequence[int],
    distillation: Fields,
    book: Ledger,
    stage: str,
) -> RoadAverageLabels:
    """Return the samples of a region's vehicles with the road average for labels; messages enter `book`, under `stage`.

    They are to be renewed: in stage II (without a step "edge") before each round, and what road sensors see is sent;
    afterwards once, and vehicles still have what road sensors saw.
    """
    pretrained = Pretrained.load(work.inputs[steps["pretrain"]])
    assert pretrained.threshold is not None  # fixed wherever labels come from detections
    config = load_stage_network(learning.task, work.inputs[steps["pretrain"]]).config
    how, split = Distillation.model_validate(distillation), Frames.open(work.inputs[steps["frames"]])
    where: Any = (split, frames, poles, region, book, stage, None if "edge" in steps else work.folder, work.report)
    labels = RoadAverageLabels(how, config, pretrained.threshold, *where)
    if "edge" not in steps:
        labels.send_views()
    return labels


def score_labels(
    work: Work, region: str, steps: Mapping[str, Any], frames: Sequence[int], config: Any, samples: Mapping[str, Any]
) -> tuple[LabelQuality, ...]:
    """Return the quality of the labels of a stage II before each round; of labels that stay, before the first."""
    if isinstance(samples, RoadAverageLabels):
        return read_history(work.folder).rounds
    return (measure_labels(1, Frames.open(work.inputs[steps["frames"]]), frames, region, samples, config),)

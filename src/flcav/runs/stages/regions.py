"""A region's vehicles in the steps of stages II and III: labelled samples, and the radio links of rounds."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flcav.dataset.ground import DatasetGround
from flcav.federation.links.in_process import update_bytes
from flcav.federation.rules import RegionalModels, Rules
from flcav.federation.strategies import exchanges_more
from flcav.federation.trainable import Weights
from flcav.federation.upload import encode_model
from flcav.network.clock.records import save_rounds
from flcav.network.clock.rounds import NetworkSettings
from flcav.network.ledger import Ledger, LedgerEntry
from flcav.network.radio.links import RadioLinks
from flcav.perception.objects.distillation import ImitatingObjects
from flcav.perception.weights import to_arrays
from flcav.runs.driving import CLOCK, DrivenRounds, Fleet, drive_rounds, link_scenes
from flcav.runs.engine import Work
from flcav.runs.frames import Frames
from flcav.runs.label_sources import LABEL_SOURCES, LabelSource
from flcav.runs.labels.faults import give_fault, read_occlusion
from flcav.runs.labels.pseudo_labels import annotated_samples, label_detected, label_frames, select_frames_near
from flcav.runs.labels.quality import measure_labels
from flcav.runs.labels.roadside import label_roadside
from flcav.runs.labels.tracks import label_tracked, load_heard, load_tracks
from flcav.runs.poles import find_sites
from flcav.runs.registry import LABELLERS, LOSSES, load_all
from flcav.runs.results.plans import Placed
from flcav.runs.results.training import LabelQuality, Pretrained
from flcav.runs.stages.rounds import RegionStart
from flcav.runs.stages.settings import FederationSettings, RegionInputs
from flcav.runs.training.learning import Learning, load_stage_network


class RenewedSamples(Mapping[str, Sequence[Any]], ABC):
    """Samples of a region's vehicles, by "region/vehicle", that are relabelled in the course of the rounds."""

    @abstractmethod
    def renew(self, round_: int, weights: Weights) -> None:
        """Relabel all samples by the detections of a network with `weights`, before a round."""

    @abstractmethod
    def list_quality(self) -> tuple[LabelQuality, ...]:
        """Return the quality of the labels before the rounds so far."""


@dataclass(frozen=True)
class Labelling:
    """The inputs for labelling the samples of a region's vehicles."""

    split: Frames
    frames: Sequence[int]  # to be labelled
    poles: Sequence[int]  # whose sensors contribute
    config: Any  # of the pretrained network
    threshold: float  # lowest score of a label
    inputs: RegionInputs
    book: Ledger  # of the messages
    stage: str  # under which they are entered


@dataclass(frozen=True)
class LabelledSamples:
    """The labelled samples of a region's vehicles."""

    samples: Mapping[str, Sequence[Any]]  # by "region/vehicle"
    poles: tuple[int, ...]  # whose sensors contributed labels


def select_group(work: Work, split: Frames, inputs: RegionInputs) -> tuple[int, ...]:
    """Return the vehicles' frames near a roadside sensor of any arm, so that all arms have the same frames.

    Without such frames, the region has no labels from the road, and all frames are returned.
    """
    return _select_near(work, split, inputs) or split.vehicles


def _select_near(work: Work, split: Frames, inputs: RegionInputs) -> tuple[int, ...]:
    placed = [Placed.load(work.inputs[step]) for step in inputs.sites]
    numbers = {pole for placement in placed for pole in placement.chosen}
    if not numbers:
        return ()
    sites = find_sites(split, split if inputs.recorded else None)
    return select_frames_near(split, sites.position[np.isin(sites.number, list(numbers)), :2], inputs.group_range_m)


def choose_poles(work: Work, split: Frames, inputs: RegionInputs, kind: LabelSource) -> tuple[int, ...]:
    """Return the poles whose sensors contribute to a region's labels of a kind: none where no frame is near one."""
    near = kind.from_poles and _select_near(work, split, inputs)
    return Placed.load(work.inputs[inputs.place]).chosen if near else ()


def label_samples(
    work: Work, settings: FederationSettings, inputs: RegionInputs, book: Ledger, stage: str
) -> LabelledSamples:
    """Return the labelled samples of a region's vehicles; messages enter `book`, under `stage`.

    They may be `RenewedSamples`, which are relabelled before every round of stage II. After it, where `inputs` names
    the stage II that is continued, they are relabelled once, from road sensors' views that vehicles still have.
    """
    task = settings.learning.resolve().task
    split = Frames.open(work.inputs[inputs.frames])
    kind = LABEL_SOURCES[settings.labels]
    frames = select_group(work, split, inputs)
    frozen = load_stage_network(task, work.inputs[inputs.pretrain])
    if not kind.measured:
        return LabelledSamples(annotated_samples(task, frozen.config, split, frames, inputs.region), ())
    poles = choose_poles(work, split, inputs, kind)
    pretrained = Pretrained.load(work.inputs[inputs.pretrain])
    threshold = pretrained.track_threshold if kind.tracked else pretrained.threshold
    assert threshold is not None  # fixed wherever labels come from detections
    about = Labelling(split, frames, poles, frozen.config, threshold, inputs, book, stage)
    for label in load_all(LABELLERS):
        if (renewed := label(work, settings, about)) is not None:
            return LabelledSamples(renewed, poles)
    units = {}
    if settings.federation.roadside_clients:
        spins = {(split.data.keys[i].scene, split.data.keys[i].index) for i in frames}
        units = label_roadside(split, poles, inputs.region, frozen.config, spins)
    first = book if inputs.edge is None else None  # later labels are those of stage II
    where: Any = (split, frames, poles, inputs.region, work.report, first, kind.trained, settings.navigation)
    if inputs.tracks is not None:
        tracks, ground = (
            load_tracks(work.inputs[inputs.tracks]),
            None if kind.from_detections else DatasetGround(split.data),
        )
        samples = label_frames(label_tracked(tracks, threshold, frozen.config, ground), *where)
        for i, count in load_heard(work.inputs[inputs.tracks]).items() if first is not None else ():
            client = f"{inputs.region}/{split.data.keys[i].agent}"
            book.enter(LedgerEntry(stage, task.name, "sidelink", "down", 0, client, count))
        if settings.fault is not None:
            truth = annotated_samples(task, frozen.config, split, frames, inputs.region)
            hidden = read_occlusion(split, frames, inputs.region, frozen.config)
            samples = give_fault(truth, samples, hidden, settings.fault)
        return LabelledSamples({**samples, **units}, poles)
    return LabelledSamples({**label_frames(label_detected(frozen, threshold, split), *where), **units}, poles)


def load_uploads(work: Work, learning: Learning, config: Any, pretrained: str, pools: Mapping[str, str]) -> list[Any]:
    """Load the samples that were uploaded for stage I, the step `pretrained`, into memory: they are drawn many times.

    `pools`: the steps that recorded the candidates for upload, by region.
    """
    samples: list[Any] = []
    for name, frames in Pretrained.load(work.inputs[pretrained]).uploaded.items():
        held = learning.task.samples(Frames.open(work.inputs[pools[name]]).data, config, frames)
        samples += [held[number] for number in range(len(held))]
    return samples


def choose_loss(work: Work, settings: FederationSettings, pretrained: str) -> Learning:
    """Return the training of a federation with the loss that its settings choose.

    It is that of an extra, or that of the task, possibly with imitation of the network of the step `pretrained`.
    """
    learning = settings.learning.resolve()
    for choose in load_all(LOSSES):
        if (other := choose(settings, learning)) is not None:
            return other
    if weight := learning.training.imitation:
        teacher = load_stage_network(learning.task, work.inputs[pretrained])
        return replace(learning, task=ImitatingObjects(teacher, weight))
    return learning


def score_labels(
    work: Work, inputs: RegionInputs, config: Any, samples: Mapping[str, Sequence[Any]]
) -> tuple[LabelQuality, ...]:
    """Return the quality of the labels of a stage II before its rounds; of constant labels, before the first."""
    if isinstance(samples, RenewedSamples):
        return samples.list_quality()
    split = Frames.open(work.inputs[inputs.frames])
    return (measure_labels(1, split, select_group(work, split, inputs), inputs.region, samples, config),)


def drive_region(
    work: Work,
    settings: FederationSettings,
    learning: Learning,
    inputs: RegionInputs,
    start: RegionStart,
    rules: Rules,
    seeds: Sequence[int],
) -> DrivenRounds:
    """Simulate a region's rounds by `rules` on the radio network, and write their times.

    `start` names the vehicles and counts the earlier rounds; `seeds`: one per round. Without a network no client is
    lost.
    """
    network = settings.federation.network
    if network is None:
        return DrivenRounds(rules, {}, ())
    fleet = open_region_fleet(settings, learning, inputs.region, [*start.clients])
    scenes = link_stage_scenes(work, inputs, network, start.earlier + len(seeds), learning.seed)
    driven = drive_rounds(fleet, scenes, network, rules, seeds, start.earlier)
    save_clock(driven, work, inputs.region)
    return driven


def open_region_fleet(settings: FederationSettings, learning: Learning, region: str, clients: Sequence[str]) -> Fleet:
    """Return the vehicles of a region with their work in a round."""
    how = settings.federation
    weights = to_arrays(learning.build_network())
    both = isinstance(how.personal, RegionalModels)  # the region's and the global model are downloaded together
    down = update_bytes(weights, exchanging=both)
    if how.download != "none":
        down += update_bytes(encode_model(weights)) - update_bytes(weights)
    up = update_bytes(weights, how.upload, exchanging=exchanges_more(how.strategy))
    return Fleet(region, tuple(clients), down, up, settings.train_s, settings.speeds)


def link_stage_scenes(
    work: Work, inputs: RegionInputs, network: NetworkSettings, most: int, seed: int
) -> list[RadioLinks]:
    """Return the radio links of the vehicles in the first `most` scenes of a region's training data, by scene."""
    split = Frames.open(work.inputs[inputs.frames])
    placed = Placed.load(work.inputs[inputs.place])
    return link_scenes(split, placed, network, most, seed)


def save_clock(driven: DrivenRounds, work: Work, region: str) -> None:
    """Write the times of a region's rounds to a Parquet file in the step's folder."""
    save_rounds(driven.records, work.folder / f"{CLOCK}-{region}.parquet")

"""Labels by the road average in a region's rounds: vehicles send what they detect, the edge server averages.

Before each round every vehicle detects with the weights that the round begins with, in its frames and in what it
recorded around them, sends boxes and its own poses up, and receives the road average of its frames' windows; its
samples are then relabelled. A window is centred on its frame: labels are made after the drive, so that what came
after the frame is known, too. All messages are entered in the ledger; what a vehicle tells of a spin is sent once, for
all windows that the spin is in. After stage II samples are labelled once, before the first round.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flcav.federation.trainable import Weights
from flcav.fusion.average import PoseSource, Sighting
from flcav.fusion.distillation import (
    Distillation,
    Guidance,
    average_spin,
    build_context,
    distil_sample,
    pack_sighting,
    unpack_sighting,
)
from flcav.fusion.pose_graph import posts_of
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import Direction, send_message
from flcav.perception.objects.distillation import DistillationTerms, DistilledObjects
from flcav.perception.objects.model import SecondConfig, second
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.weights import from_arrays
from flcav.runs.engine import Work
from flcav.runs.frames import SLACK_S, list_window
from flcav.runs.labels.pseudo_labels import Spin, road_views
from flcav.runs.labels.quality import LABELS, measure_labels, read_label_history
from flcav.runs.labels.sightings import make_sighting
from flcav.runs.results.training import LabelHistory, LabelQuality
from flcav.runs.stages.regions import Labelling, RenewedSamples
from flcav.runs.stages.settings import FederationSettings
from flcav.runs.training.learning import Learning
from flcav.world.map.lanes import map_layers

SURVEYED = np.eye(4)  # pose of a road sensor: it sends its boxes in the world frame


class RoadAverageLabels(RenewedSamples):
    """The samples of a region's vehicles, by "region/vehicle"; `renew` labels them by the road average."""

    def __init__(
        self,
        how: Distillation,
        poses: PoseSource,
        about: Labelling,
        folder: Path | None = None,
        report: Report = ignore_progress,
    ) -> None:
        """Hold the vehicles' frames, to be labelled with the sensors on the poles; `about` names both.

        poses: of the vehicles' navigation. folder: where the quality of the labels is kept, `read_label_history`; None:
        nowhere. The threshold of `about` holds for labels that only vehicles contribute to.
        """
        split, frames = about.split, about.frames
        config: SecondConfig = about.config
        self._how, self._config, self._threshold = how, config, about.threshold
        self._poses: PoseSource = poses
        self._split, self._region = split, about.inputs.region
        self._frames, self._book, self._stage = frames, about.book, about.stage
        self._folder, self._report = folder, report
        self._told = list_window(split, frames, how.window_s)
        seen = [i for pole in about.poles for i in split.poles.get(pole, ())]
        self._time_s = {self._spin(i): split.data.keys[i].time_s for i in (*seen, *self._told)}
        self._around = {spin: self._find_around(spin) for spin in dict.fromkeys(map(self._spin, frames))}
        spins = {spin for around in self._around.values() for spin in around}
        self._views = road_views(split, about.poles, True, spins)
        self._seen_by = {i: self._list_views(self._spin(i)) for i in frames}  # as each frame's vehicle has them
        town = split.data.town() if how.pose_graph or how.map_context else None
        self._posts = None
        if how.pose_graph:
            self._posts = np.zeros((0, 2)) if town is None else posts_of(town)
        self._context = build_context(map_layers(town)) if town is not None and how.map_context else None
        names = sorted({self._name(i) for i in frames})
        self._samples: dict[str, list[Sample]] = {
            name: [Sample(np.zeros((0, 4), np.float32), Boxes.empty()) for i in frames if self._name(i) == name]
            for name in names
        }

    def __getitem__(self, name: str) -> Sequence[Sample]:
        """Return a vehicle's samples: the same list, whose elements `renew` replaces."""
        return self._samples[name]

    def __iter__(self) -> Iterator[str]:
        """Return the vehicles' names."""
        return iter(self._samples)

    def __len__(self) -> int:
        """Return the number of vehicles."""
        return len(self._samples)

    def list_quality(self) -> tuple[LabelQuality, ...]:
        """Return the quality of the labels before each round so far; none where it is not kept."""
        return () if self._folder is None else read_label_history(self._folder).rounds

    def _name(self, frame: int) -> str:
        return f"{self._region}/{self._split.data.keys[frame].agent}"

    def _spin(self, frame: int) -> Spin:
        return self._split.data.keys[frame].scene, self._split.data.keys[frame].index

    def _find_around(self, spin: Spin) -> tuple[Spin, ...]:
        """Return the spins in the window around a spin, the spin itself first."""
        ends = self._time_s[spin] - self._how.window_s - SLACK_S, self._time_s[spin] + self._how.window_s + SLACK_S
        near = (each for each, time_s in self._time_s.items() if each[0] == spin[0] and ends[0] <= time_s <= ends[1])
        return spin, *(each for each in near if each != spin)

    def _list_views(self, spin: Spin) -> list[RoadView]:
        return [*self._views.get(spin, {}).values()]

    def send_views(self) -> None:
        """Send the road sensors' free space to the vehicles, before the first round."""
        for i in self._frames:
            sent = [self._send("down", i, 0, view.message()) for view in self._seen_by[i]]
            self._seen_by[i] = [RoadView.from_message(message) for message in sent]

    def renew(self, round_: int, weights: Weights) -> None:
        """Label all samples by the road average of what `weights` detect, before a round."""
        network = second(self._config)
        from_arrays(network, weights)
        told: dict[int, Sighting] = {}
        own: dict[int, Boxes] = {}
        for done, i in enumerate(self._told, start=1):
            sighting, own[i] = make_sighting(network, self._split.data, i, self._how, self._poses)
            told[i] = unpack_sighting(sighting.agent, self._send("up", i, round_, pack_sighting(sighting)))
            self._report(done, len(self._told), "labels")
        given = {
            i: Guidance.from_message(self._send("down", i, round_, guidance.message()))
            for i, guidance in self._average(told)
        }
        place = dict.fromkeys(self._samples, 0)
        for i in self._frames:
            name, frame = self._name(i), self._split.data.frame(i)
            views, lidar = self._seen_by[i], choose_lidar(frame)
            self._samples[name][place[name]] = distil_sample(frame, own[i], given[i], views, self._config, lidar)
            place[name] += 1
        if self._folder is not None:
            kept = tuple(each for each in read_label_history(self._folder).rounds if each.round < round_)
            quality = measure_labels(round_, self._split, self._frames, self._region, self, self._config)
            LabelHistory((*kept, quality)).save(self._folder, LABELS)

    def _average(self, told: Mapping[int, Sighting]) -> Iterator[tuple[int, Guidance]]:
        """Yield the number of each frame to be labelled, and the averaged boxes that its vehicle receives."""
        spins: dict[Spin, dict[int, Sighting]] = {}
        for i, sighting in told.items():
            spins.setdefault(self._spin(i), {})[i] = sighting
        seen = {
            spin: [Sighting(f"pole {n}", self._time_s[spin], SURVEYED, view.boxes) for n, view in views.items()]
            for spin, views in self._views.items()
        }
        asked = set(self._frames)
        for spin, (_, *others) in self._around.items():
            around = [one for each in others for one in (*spins.get(each, {}).values(), *seen.get(each, ()))]
            middle = [*spins[spin].values(), *seen.get(spin, ())]
            how = (self._config, self._threshold, self._posts, self._context, around)
            found = average_spin(middle, self._list_views(spin), *how)
            yield from (each for each in zip(spins[spin], found, strict=True) if each[0] in asked)

    def _send(self, direction: Direction, i: int, round_: int, message: bytes) -> bytes:
        about: Any = {"stage": self._stage, "task": OBJECTS.name, "link": "wireless", "client": self._name(i)}
        return send_message(self._book, message, **about, direction=direction, round_=round_)


def label_by_average(work: Work, settings: FederationSettings, about: Labelling) -> RoadAverageLabels | None:
    """Return a region's samples, to be labelled by the road average, once vehicles have what road sensors see.

    None of other labels. After a stage II they have it.
    """
    how, first = settings.distillation, about.inputs.edge is None
    if how is None:
        return None
    found = RoadAverageLabels(how, settings.navigation, about, work.folder if first else None, work.report)
    if first:
        found.send_views()
    return found


def choose_distillation(settings: FederationSettings, learning: Learning) -> Learning | None:
    """Return the settings of a training with the loss of federated distillation; None for other labels."""
    how = settings.distillation
    if how is None:
        return None
    on = ("regression" in how.terms, "contrastive" in how.terms)
    terms = DistillationTerms(*on, how.contrastive_weight, how.temperature)
    return replace(learning, task=DistilledObjects(terms))

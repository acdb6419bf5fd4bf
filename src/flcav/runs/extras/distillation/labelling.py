"""Labels by the road average in a region's rounds: vehicles send their detections, the edge server averages them.

Before a round, a vehicle detects objects with the weights that the round begins with, in its frames and in the sweeps
that it recorded around them, sends boxes and poses to the edge server, and receives the road average in the windows of
its frames; its samples are then relabelled. A window is centred on its frame: labels are made after the drive, when the
sweeps after the frame are known, too. All messages are entered in the ledger; a vehicle sends its message about a spin
once, for all windows that contain the spin. After stage II samples are labelled once, before the first round.
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
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.distillation import DistillationTerms, DistilledObjects
from flcav.perception.objects.model import second
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

SURVEYED = np.eye(4)  # pose of a road sensor, whose position is surveyed: it sends its boxes in the world frame


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
        """Prepare the vehicles' frames and the sensors on the poles, both given by `about`, without labels yet.

        `poses`: of the vehicles' navigation. `folder`: where the quality of the labels is kept, see
        `read_label_history`; None: nowhere. The score threshold of `about` applies to labels from vehicles alone.
        """
        split, frames = about.split, about.frames
        config: SecondConfig = about.config
        self._how = how
        self._config = config
        self._threshold = about.threshold
        self._poses: PoseSource = poses
        self._split = split
        self._region = about.inputs.region
        self._frames = frames
        self._book = about.book
        self._stage = about.stage
        self._folder = folder
        self._report = report
        self._sent = list_window(split, frames, how.window_s)  # frames that vehicles send messages about
        seen = [i for pole in about.poles for i in split.poles.get(pole, ())]
        self._time_s = {self._spin(i): split.data.keys[i].time_s for i in (*seen, *self._sent)}
        self._around = {spin: self._find_around(spin) for spin in dict.fromkeys(map(self._spin, frames))}
        spins = {spin for around in self._around.values() for spin in around}
        self._views = road_views(split, about.poles, True, spins)
        self._seen_by = {i: self._list_views(self._spin(i)) for i in frames}  # as the frame's vehicle receives them
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
        """Return the quality of the labels before the rounds so far; empty where it is not kept."""
        return () if self._folder is None else read_label_history(self._folder).rounds

    def _name(self, frame: int) -> str:
        return f"{self._region}/{self._split.data.keys[frame].agent}"

    def _spin(self, frame: int) -> Spin:
        return self._split.data.keys[frame].scene, self._split.data.keys[frame].index

    def _find_around(self, spin: Spin) -> tuple[Spin, ...]:
        """Return the spins in the window around a spin, the spin itself first."""
        ends = self._time_s[spin] - self._how.window_s - SLACK_S, self._time_s[spin] + self._how.window_s + SLACK_S
        times = self._time_s.items()
        near = (other for other, time_s in times if other[0] == spin[0] and ends[0] <= time_s <= ends[1])
        return spin, *(other for other in near if other != spin)

    def _list_views(self, spin: Spin) -> list[RoadView]:
        return [*self._views.get(spin, {}).values()]

    def send_views(self) -> None:
        """Send the road sensors' free space to the vehicles, before the first round."""
        for i in self._frames:
            sent = [self._send("down", i, 0, view.message()) for view in self._seen_by[i]]
            self._seen_by[i] = [RoadView.from_message(message) for message in sent]

    def renew(self, round_: int, weights: Weights) -> None:
        """Relabel all samples by the road average of detections with `weights`, before a round."""
        network = second(self._config)
        from_arrays(network, weights)
        received: dict[int, Sighting] = {}
        detected: dict[int, Boxes] = {}
        for done, i in enumerate(self._sent, start=1):
            sighting, detected[i] = make_sighting(network, self._split.data, i, self._how, self._poses)
            received[i] = unpack_sighting(sighting.agent, self._send("up", i, round_, pack_sighting(sighting)))
            self._report(done, len(self._sent), "labels")
        given = {
            i: Guidance.from_message(self._send("down", i, round_, guidance.message()))
            for i, guidance in self._average(received)
        }
        place = dict.fromkeys(self._samples, 0)
        for i in self._frames:
            name = self._name(i)
            frame = self._split.data.frame(i)
            views, lidar = self._seen_by[i], choose_lidar(frame)
            self._samples[name][place[name]] = distil_sample(frame, detected[i], given[i], views, self._config, lidar)
            place[name] += 1
        if self._folder is not None:
            kept = tuple(known for known in read_label_history(self._folder).rounds if known.round < round_)
            quality = measure_labels(round_, self._split, self._frames, self._region, self, self._config)
            LabelHistory((*kept, quality)).save(self._folder, LABELS)

    def _average(self, received: Mapping[int, Sighting]) -> Iterator[tuple[int, Guidance]]:
        """Yield the numbers of the frames to be labelled, with the averaged boxes that their vehicles receive."""
        spins: dict[Spin, dict[int, Sighting]] = {}
        for i, sighting in received.items():
            spins.setdefault(self._spin(i), {})[i] = sighting
        seen = {
            spin: [Sighting(f"pole {n}", self._time_s[spin], SURVEYED, view.boxes) for n, view in views.items()]
            for spin, views in self._views.items()
        }
        wanted = set(self._frames)
        for spin, (_, *others) in self._around.items():
            around = [one for other in others for one in (*spins.get(other, {}).values(), *seen.get(other, ()))]
            middle = [*spins[spin].values(), *seen.get(spin, ())]
            how = (self._config, self._threshold, self._posts, self._context, around)
            found = average_spin(middle, self._list_views(spin), *how)
            yield from (pair for pair in zip(spins[spin], found, strict=True) if pair[0] in wanted)

    def _send(self, direction: Direction, i: int, round_: int, message: bytes) -> bytes:
        about: Any = {"stage": self._stage, "task": OBJECTS.name, "link": "wireless", "client": self._name(i)}
        return send_message(self._book, message, **about, direction=direction, round_=round_)


def label_by_average(work: Work, settings: FederationSettings, about: Labelling) -> RoadAverageLabels | None:
    """Return a region's samples, to be labelled by the road average, after sending vehicles the road sensors' views.

    None for other labels. After a stage II vehicles have the views.
    """
    how = settings.distillation
    first = about.inputs.edge is None
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

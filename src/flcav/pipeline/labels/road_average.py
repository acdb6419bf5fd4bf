"""Labels by the road average in a region's rounds: vehicles tell what they detect, the edge server averages.

Before each round every vehicle detects with the weights that the round begins with, sends boxes and its own pose up,
and receives the road average of its spin; its samples are then labelled anew. All messages are entered in the ledger.
After stage II they are labelled once, before the first round.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flcav.federation.trainable import Weights
from flcav.fusion.distillation import (
    TOLD,
    Distillation,
    Guidance,
    average_spin,
    distil_sample,
    pack_sighting,
    unpack_sighting,
)
from flcav.fusion.map_context import build_context
from flcav.fusion.pose_graph import Sighting
from flcav.fusion.posts import find_posts, posts_of
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes, transform_points
from flcav.network.ledger import Direction, Ledger
from flcav.network.messages import send
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second, second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.weights import from_arrays
from flcav.pipeline.frames import Frames
from flcav.pipeline.labels.pseudo_labels import road_views
from flcav.pipeline.labels.quality import LABELS, measure_labels, read_history
from flcav.pipeline.recipe import EDGE
from flcav.pipeline.results.training import LabelHistory
from flcav.progress import Report, ignore_progress
from flcav.seeds import stream
from flcav.world.map.lanes import map_layers

SURVEYED = np.eye(4)  # road sensors tell of boxes in the world frame


class RoadAverageLabels(Mapping[str, Sequence[Sample]]):
    """The samples of a region's vehicles, by "region/vehicle"; `renew` labels them by the road average."""

    def __init__(
        self,
        how: Distillation,
        config: SecondConfig,
        threshold: float,
        split: Frames,
        frames: Sequence[int],
        poles: Sequence[int],
        region: str,
        book: Ledger,
        stage: str = EDGE,
        folder: Path | None = None,
        report: Report = ignore_progress,
    ) -> None:
        """Hold the vehicles' `frames` of a split, to be labelled with the sensors on `poles`.

        threshold: lowest score of a label that vehicles alone tell of. book: ledger of the messages, under `stage`.
        folder: where the quality of the labels is kept, `read_history`; None: nowhere.
        """
        self._how, self._config, self._threshold, self._split, self._region = how, config, threshold, split, region
        self._frames, self._book, self._stage, self._folder, self._report = frames, book, stage, folder, report
        self._views = road_views(split, poles, trained=True)
        self._seen_by = {i: self._views.get(self._spin(i), []) for i in frames}  # as each frame's vehicle has them
        town = split.data.town() if how.pose_graph or how.map_context else None
        self._posts = posts_of(town) if town is not None and how.pose_graph else None
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

    def _name(self, frame: int) -> str:
        return f"{self._region}/{self._split.data.keys[frame].agent}"

    def _spin(self, frame: int) -> tuple[str, int]:
        return self._split.data.keys[frame].scene, self._split.data.keys[frame].index

    def send_views(self) -> None:
        """Send what the road sensors see to the vehicles, for the free ground; before the first round."""
        for i in self._frames:
            sent = [self._send("down", i, 0, view.message()) for view in self._seen_by[i]]
            self._seen_by[i] = [RoadView.from_message(message) for message in sent]

    def renew(self, round_: int, weights: Weights) -> None:
        """Label all samples by the road average of what `weights` detect, before a round."""
        network = second(self._config)
        from_arrays(network, weights)
        told: dict[int, Sighting] = {}
        own: dict[int, Boxes] = {}
        for done, i in enumerate(self._frames, start=1):
            sighting, own[i] = self._see(network, i)
            told[i] = unpack_sighting(sighting.agent, self._send("up", i, round_, pack_sighting(sighting)))
            self._report(done, len(self._frames), "labels")
        spins: dict[tuple[str, int], list[int]] = {}
        for i in self._frames:
            spins.setdefault(self._spin(i), []).append(i)
        given: dict[int, Guidance] = {}
        for spin, frames in spins.items():
            views = self._views.get(spin, [])
            poles = [Sighting(f"pole {n}", told[frames[0]].time_s, SURVEYED, v.boxes) for n, v in enumerate(views)]
            sightings = [*(told[i] for i in frames), *poles]
            found = average_spin(sightings, views, self._config, self._threshold, self._posts, self._context)
            for i, guidance in zip(frames, found, strict=True):
                given[i] = Guidance.from_message(self._send("down", i, round_, guidance.message()))
        place = dict.fromkeys(self._samples, 0)
        for i in self._frames:
            name, frame = self._name(i), self._split.data.frame(i)
            views, lidar = self._seen_by[i], choose_lidar(frame)
            self._samples[name][place[name]] = distil_sample(frame, own[i], given[i], views, self._config, lidar)
            place[name] += 1
        if self._folder is not None:
            kept = tuple(each for each in read_history(self._folder).rounds if each.round < round_)
            quality = measure_labels(round_, self._split, self._frames, self._region, self, self._config)
            LabelHistory((*kept, quality)).save(self._folder, LABELS)

    def _see(self, network: Second, i: int) -> tuple[Sighting, Boxes]:
        """Return what the vehicle of a frame tells, by its navigation, and its detections in the LiDAR's frame."""
        data, how = self._split.data, self._how
        key, frame = data.keys[i], data.frame(i)
        (found,) = detect_in(network, [frame], score_threshold=TOLD)
        lidar = choose_lidar(frame)
        mount = frame.assumed.agent_from_sensor[lidar]
        posts = np.zeros((0, 2))
        if self._posts is not None:
            posts = find_posts(transform_points(mount, frame.lidar[lidar][:, :3]), 0.0)
        recorded = str(data.manifest.recipe.get("seed"))
        rng = stream(0, "navigation", recorded, key.scene, key.index, key.agent)
        known = how.navigate(frame.world_from_agent, rng)
        return Sighting(key.agent, key.time_s, known, found.transform(mount), posts, how.navigation), found

    def _send(self, direction: Direction, i: int, round_: int, message: bytes) -> bytes:
        about: Any = {"stage": self._stage, "task": OBJECTS.name, "link": "wireless", "client": self._name(i)}
        return send(self._book, message, **about, direction=direction, round_=round_)

"""The vehicles of a region as clients: which sweeps they train on, and how these are labelled."""

from collections.abc import Mapping

import numpy as np

from flcav.dataset.store import Dataset
from flcav.experiments.pretraining import WEIGHTS
from flcav.experiments.protocol import TASK, Protocol
from flcav.experiments.recording import opened
from flcav.experiments.steps import Work
from flcav.fusion.labels import label_sample
from flcav.fusion.road import RoadView, road_view
from flcav.network.ledger import Ledger, LedgerEntry
from flcav.perception.client import TaskClient
from flcav.perception.objects.detect import detect_all
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.weights import load_network
from flcav.world.town import load_town


def grouped(work: Work, town: str, setting: Protocol) -> list[int]:
    """Return the vehicle frames of stage II: those near a roadside sensor, where the edge server forms its groups.

    Near the chosen pole or the densest, whichever an arm uses or none: so all arms have the same frames.
    """
    placed, poles, data = work.result(f"{town}-place"), load_town(town).poles, opened(work, f"{town}-edge")
    sites = poles.position[np.isin(poles.id, (placed["chosen"], placed["densest"])), :2]

    def near(i: int) -> bool:
        place = data.frame(i).world_from_agent[:2, 3]
        return bool((np.linalg.norm(sites - place, axis=1) <= setting.group_range_m).any())

    return [i for i, key in enumerate(data.keys) if key.agent.startswith("cav") and near(i)]


def region(
    work: Work, town: str, pole: int | None, setting: Protocol, book: Ledger | None = None
) -> dict[str, TaskClient]:
    """Return a region's vehicles with their frames, labelled without ground truth.

    The road's views are booked as downlink where a `book` is given (once: the labels are kept through the stages).
    """
    frozen = load_network(work.inputs["pretrain"] / WEIGHTS)
    threshold = work.result("pretrain")["threshold"]
    data, chosen = opened(work, f"{town}-edge"), grouped(work, town, setting)
    views = _views(data, pole)
    samples: dict[str, list[Sample]] = {}
    for done, i in enumerate(chosen):
        key, frame = data.keys[i], data.frame(i)
        detections = detect_all(frozen, [frame.lidar["lidar"]], score_threshold=threshold)[0]
        told = [views[key.scene, key.index]] if pole is not None else []
        name = f"{town}/{key.agent}"
        samples.setdefault(name, []).append(label_sample(frame, detections, told, frozen.config))
        if book is not None:
            for view in told:
                book.enter(LedgerEntry("edge", TASK, "wireless", "down", 0, name, len(view.message())))
        work.report(done, len(chosen), "labels")
    return {
        name: TaskClient(OBJECTS, frozen.config, samples[name], batch=setting.training.batch)
        for name in sorted(samples)
    }


def held(clients: Mapping[str, TaskClient]) -> int:
    """Return how many sweeps the vehicles hold together."""
    return sum(len(client.samples) for client in clients.values())


def _views(data: Dataset, pole: int | None) -> dict[tuple[str, int], RoadView]:
    seen = [(i, key) for i, key in enumerate(data.keys) if key.agent == f"pole{pole}"]
    return {(key.scene, key.index): road_view(data.frame(i)) for i, key in seen}

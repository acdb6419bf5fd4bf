"""Where errors lie in a region, and where its roadside sensors are placed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.optimization.placement import coverage, place
from flcav.perception.errors import PerceptionError
from flcav.perception.metrics.matching import assign_targets, on_neutral
from flcav.perception.objects.detect import detect
from flcav.perception.objects.evaluate import Asked, asked_of
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import only_lidar
from flcav.pipeline.frames import Frames
from flcav.pipeline.recipe import Placement
from flcav.pipeline.results import Looked, Placed, Pole, Seen
from flcav.pipeline.stages import stage_network
from flcav.world.map.census import mean_actors
from flcav.world.trace import Trace

SHOWN_SCORE = 0.3


def look(before: Path, after: Path, split: Frames) -> Looked:
    """Detect with the networks of two steps in the test frame that holds most targets, whatever they find there."""
    networks = {name: stage_network(OBJECTS, folder) for name, folder in (("before", before), ("after", after))}
    config = networks["before"].config
    truths = [asked_of(split.data.frame(i), config) for i in split.vehicles]
    best = int(np.argmax([len(truth.targets) for truth in truths]))
    frame, truth = split.data.frame(split.vehicles[best]), truths[best]
    points = frame.lidar[only_lidar(frame)]
    seen = {
        name: _matched(detect(network, points, score_threshold=SHOWN_SCORE), truth)
        for name, network in networks.items()
    }
    return Looked(split.vehicles[best], _rows(truth.targets), seen["before"], seen["after"])


def _matched(found: Boxes, truth: Asked) -> Seen:
    """Return the detections that count, which of them hit, and which targets were found."""
    target = assign_targets(found, truth.targets, 0.5)
    counts = (target >= 0) | ~on_neutral(found, truth.neutral)
    hits = target[counts]
    reached = np.isin(np.arange(len(truth.targets)), hits)
    return Seen(_rows(found[counts]), tuple((hits >= 0).tolist()), tuple(reached.tolist()))


def _rows(boxes: Boxes) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, boxes.array().tolist()))


@dataclass(frozen=True)
class Sites:
    """The candidate poles of a region."""

    number: NDArray[np.int64]  # (P,)
    position: NDArray[np.float64]  # (P, 3) of the sensor's mount, world [m]


def sites_of(drive: Frames, edge: Frames | None) -> Sites:
    """Return the candidates: the town's poles, of recorded data those whose sweeps it holds."""
    town = drive.data.town()
    if edge is None:
        return Sites(town.poles.id, town.poles.position) if town is not None else Sites(*_none())
    known = sorted(edge.poles)
    mounts = [edge.data.frame(edge.poles[pole][0]).world_from_agent[:3, 3] for pole in known]
    return Sites(np.array(known, dtype=np.int64), np.array(mounts, dtype=np.float64).reshape(-1, 3))


def place_sensors(
    region: str,
    how: Placement,
    sites: Sites,
    errors: Mapping[str, Sequence[PerceptionError]],
    weights: Mapping[str, float],
    traces: Sequence[Trace],
) -> Placed:
    """Return the poles that a rule chooses: errors by task, those of a task weighing what the run says."""
    every = [replace(error, weight=error.weight * weights[task]) for task in how.tasks for error in errors[task]]
    xyz = np.array([(error.x, error.y, error.z) for error in every]).reshape(-1, 3)
    weight = np.array([error.weight for error in every])
    if not len(sites.number):
        return Placed(region, "none", (), len(xyz), 0, how.range_m, ())
    actors = mean_actors(sites.position, traces, how.range_m)
    within = coverage(xyz, sites.position, how.range_m)
    count = min(how.count, len(sites.number))
    chosen: list[int] = []
    if how.rule == "vrcsp" and len(xyz):  # without errors there is nothing to look for
        chosen = list(place(xyz, sites.position, how.range_m, count, weight=weight).chosen)
    elif how.rule == "densest":
        chosen = np.argsort(-actors, kind="stable")[:count].tolist()
    return Placed(
        region=region,
        rule=how.rule,
        chosen=tuple(int(sites.number[i]) for i in chosen),
        errors=len(xyz),
        covered=int(within[chosen].any(axis=0).sum()) if chosen else 0,
        range_m=how.range_m,
        poles=tuple(
            Pole(int(number), int(row.sum()), round(float(mean), 2))
            for number, row, mean in zip(sites.number, within, actors, strict=True)
        ),
    )


def traces_of(data: Dataset, frames: Sequence[int]) -> list[Trace]:
    """Return the recorded traffic of the frames' scenes, where it is known."""
    scenes = sorted({data.keys[i].scene for i in frames})
    return [trace for scene in scenes if (trace := data.trace(scene)) is not None]


def _none() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    return np.zeros(0, dtype=np.int64), np.zeros((0, 3))

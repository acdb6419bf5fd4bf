"""Precision and recall of labels by messages beside tracks alone, by share of senders, accuracy and distance.

RUN is the folder of a run of recipes/runs/messages.yaml. Training frames of its region are labelled again, with the
pretrained network and the score threshold of the run: by tracks alone, by messages alone, and by both. A label is right
that matches a target at IoU 0.5 in 3D; targets are the cars in range with five returns or more. CAM: awareness messages
alone; CAM, CPM: those that record also send what they detect. *Drive* is the recall of cars that drive in the scene,
which alone can announce themselves, *park* that of the others.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flcav.arrays import Mask
from flcav.fusion.tracks import LEAST_SCORE, track_objects
from flcav.geometry import Boxes, concatenate, inverse
from flcav.machine.threads import use_threads
from flcav.network.awareness import MessageSettings, draw_connected
from flcav.network.ledger import BYTES_PER_MB
from flcav.perception.metrics import match
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import (
    FrameTruth,
    asked_of,
    choose_lidar,
    ground_truth,
    in_range,
    network_from_lidar,
)
from flcav.runs.arms import name_steps
from flcav.runs.frames import Frames
from flcav.runs.labels.heard import hear_messages
from flcav.runs.labels.tracks import label_tracked, read_window
from flcav.runs.recipe import EDGE, MAIN, load_run_recipe
from flcav.runs.results.training import Pretrained
from flcav.runs.training.learning import load_stage_network
from flcav.storage.markdown import format_table

RECIPE = Path(__file__).parents[1] / "recipes/runs/messages.yaml"
SHARES, DEVIATIONS_M = (0.1, 0.3, 0.6), (0.05, 0.5, 1.5)
WHOLE_M, RINGS_M = (0.0, np.inf), ((0.0, 20.0), (20.0, 35.0), (35.0, np.inf))  # distances of labels and targets
Row = tuple[str, str, str]


def main() -> None:
    """Label the frames of a run in each way, and print the table of their rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="label every Nth frame alone")
    asked = parser.parse_args()
    use_threads(1)
    begun, recipe, work = time.process_time(), load_run_recipe(RECIPE), asked.run / "work"
    (region,), names = recipe.with_role("federate"), name_steps(recipe)
    split = Frames.open(work / names.recording(region, EDGE, OBJECTS.name))
    pretrained = work / names.pretrain(MAIN, OBJECTS.name)
    network, threshold = load_stage_network(OBJECTS, pretrained), Pretrained.load(pretrained).track_threshold
    assert threshold is not None
    labels, truths = dict[Row, list[Boxes]](), list[FrameTruth]()
    heard_mb, drives = dict[Row, list[float]](), list[Mask]()
    for i in split.vehicles[:: asked.every]:
        frame, scene = split.data.frame(i), split.data.keys[i].scene
        truths.append(asked_of(frame, network.config))
        trace = split.data.trace(scene)
        assert trace is not None
        able = trace.actor[draw_connected(trace, MessageSettings(share=1.0), scene)]
        drives.append(np.isin(frame.annotations.track[ground_truth(frame, network.config).target], able))
        sweeps, world_from_lidar = read_window(network, split, i)
        bare = [replace(sweep, boxes=Boxes.empty()) for sweep in sweeps]
        for row, how in list_rows():
            heard = None if how is None else hear_messages(split, i, how, network)
            heard_mb.setdefault(row, []).append(0.0 if heard is None else heard.bytes / BYTES_PER_MB)
            known, alone = None if heard is None else heard.announced, row[0].startswith("messages")
            found = track_objects(bare if alone else sweeps, split.data.keys[i].time_s, (), LEAST_SCORE, known)
            found = found.transform(inverse(world_from_lidar))
            label = label_tracked({i: found}, threshold, network.config)
            boxes, move = label(i, frame, ()).boxes, network_from_lidar(frame, network.config, choose_lidar(frame))
            boxes = boxes[in_range(boxes, network.config)]
            boxes = boxes if move is None else boxes.transform(inverse(move))
            labels.setdefault(row, []).append(replace(boxes, score=np.ones(len(boxes))))
    rows = [[*row, *rate(found, truths, drives), f"{np.mean(heard_mb[row]):.3f}"] for row, found in labels.items()]
    rings = [f"{low:g} to {high:g} m" if np.isfinite(high) else f"from {low:g} m" for low, high in RINGS_M]
    header = ("labels", "share", "position, m", "precision", *(f"P, {ring}" for ring in rings), "recall")
    print(format_table((*header, *(f"R, {ring}" for ring in rings), "R, drive", "R, park", "MB a frame"), rows))
    targets, driving = sum(len(truth.targets) for truth in truths), sum(int(own.sum()) for own in drives)
    spent_s = time.process_time() - begun
    print(f"{len(truths)} frames, {targets} targets, {driving} of which drive; {spent_s:.0f} CPU-s")


def list_rows() -> Iterator[tuple[Row, MessageSettings | None]]:
    """Yield labels, share and deviation [m] of each row, and the settings of its messages."""
    yield ("tracks", "", ""), None
    for source, perceived in (("messages: CAM", False), ("tracks + CAM", False), ("tracks + CAM, CPM", True)):
        for share in SHARES:
            for deviation_m in DEVIATIONS_M[1:2] if perceived else DEVIATIONS_M:
                how = MessageSettings(share=share, position_m=deviation_m, perceived=perceived)
                yield (source, f"{share:g}", f"{deviation_m:g}"), how


def rate(found: Sequence[Boxes], truths: Sequence[FrameTruth], drives: Sequence[Mask]) -> list[str]:
    """Return precision, whole and by ring, and recall, whole, by ring, and of cars that drive or park."""
    rings = [[_lies(truth.targets, *ring) for truth in truths] for ring in RINGS_M]
    precision = [_precision([boxes[_lies(boxes, *ring)] for boxes in found], truths) for ring in (WHOLE_M, *RINGS_M)]
    every = [np.ones(len(truth.targets), np.bool_) for truth in truths]
    recall = [_recall(found, truths, chosen) for chosen in (every, *rings, drives, [~own for own in drives])]
    return [f"{value:.2f}" for value in (*precision, *recall)]


def _precision(found: Sequence[Boxes], truths: Sequence[FrameTruth]) -> float:
    hit = match(found, [truth.targets for truth in truths], [truth.neutral for truth in truths], 0.5).hit
    return float(hit.mean()) if len(hit) else float("nan")


def _recall(found: Sequence[Boxes], truths: Sequence[FrameTruth], chosen: Sequence[Mask]) -> float:
    targets = [truth.targets[own] for truth, own in zip(truths, chosen, strict=True)]
    others = [concatenate([truth.neutral, truth.targets[~own]]) for truth, own in zip(truths, chosen, strict=True)]
    hits = match(found, targets, others, 0.5)
    return float(hits.hit.sum() / max(hits.targets.sum(), 1))


def _lies(boxes: Boxes, low_m: float, high_m: float) -> Mask:
    distance = np.hypot(*boxes.center[:, :2].T)
    return (distance >= low_m) & (distance < high_m)


if __name__ == "__main__":
    main()

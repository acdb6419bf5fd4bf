"""Precision and recall of labels by messages beside tracks alone, by share of senders, accuracy and distance.

RUN is the folder of a finished run of recipes/runs/messages.yaml. The training frames of its region are labelled again,
with the pretrained network and the score threshold of the run: by tracks alone, by messages alone, and by both. A label
is right that matches a target at IoU 0.5 in 3D; targets are the cars in range with five returns or more.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flcav.dataset.ground import DatasetGround
from flcav.fusion.tracks import LEAST_SCORE, track_objects
from flcav.geometry import Boxes, concatenate, inverse
from flcav.machine.threads import use_threads
from flcav.network.awareness import MessageSettings
from flcav.perception.metrics import match
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth, asked_of, choose_lidar, in_range, network_from_lidar
from flcav.runs.frames import Frames
from flcav.runs.labels.heard import hear_messages
from flcav.runs.labels.tracks import label_tracked, read_window
from flcav.runs.recipe import EDGE, MAIN
from flcav.runs.results.run import Run
from flcav.runs.results.training import Pretrained
from flcav.runs.training.learning import load_stage_network
from flcav.storage.markdown import format_table

SHARES, DEVIATIONS_M = (0.1, 0.3, 0.6), (0.05, 0.5, 1.5)
RINGS_M = ((0.0, 15.0), (15.0, 30.0), (30.0, np.inf))  # distances by which the table divides labels and targets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    folder = parser.parse_args().run
    use_threads(1)
    begun, run = time.process_time(), Run.load(folder)
    (region,) = run.recipe.with_role("federate")
    split = Frames.open(folder / "work" / run.steps.recording(region, EDGE, OBJECTS.name))
    pretrained = folder / "work" / run.steps.pretrain(MAIN, OBJECTS.name)
    network, threshold = load_stage_network(OBJECTS, pretrained), Pretrained.load(pretrained).track_threshold
    assert threshold is not None
    labels: dict[tuple[str, str, str], list[Boxes]] = {}
    truths, sizes = [], dict[tuple[str, str], list[int]]()
    for i in split.vehicles:
        frame = split.data.frame(i)
        truths.append(asked_of(frame, network.config))
        sweeps, world_from_lidar = read_window(network, split, i)
        bare = [replace(sweep, boxes=Boxes.empty()) for sweep in sweeps]
        for (source, share, deviation_m), how in list_sources():
            heard = None if how is None else hear_messages(split, i, how, network)
            if heard is not None and source == "messages":
                sizes.setdefault((share, deviation_m), []).append(heard.bytes)
            known = None if heard is None else heard.announced
            seen = bare if source == "messages" else sweeps
            found = track_objects(seen, split.data.keys[i].time_s, (), LEAST_SCORE, known)
            ground = DatasetGround(split.data) if source == "messages" else None
            label = label_tracked({i: found.transform(inverse(world_from_lidar))}, threshold, network.config, ground)
            boxes, move = label(i, frame, ()).boxes, network_from_lidar(frame, network.config, choose_lidar(frame))
            boxes = boxes[in_range(boxes, network.config)]
            boxes = boxes if move is None else boxes.transform(inverse(move))
            labels.setdefault((source, share, deviation_m), []).append(replace(boxes, score=np.ones(len(boxes))))
    rows = []
    for key, found in labels.items():
        mb = f"{np.mean(sizes[key[1:]]) / 1e6:.3f}" if key[1:] in sizes else ""
        rows.append([*key, *rate(found, truths), mb])
    rings = [f"{low:g} to {high:g} m" if np.isfinite(high) else f"from {low:g} m" for low, high in RINGS_M]
    header = ("labels", "share", "position, m", "precision", "recall", *(f"{r}: P" for r in rings))
    print(format_table((*header, *(f"{r}: R" for r in rings), "MB heard a frame"), rows))
    targets = sum(len(truth.targets) for truth in truths)
    print(f"{len(truths)} frames, {targets} targets; {time.process_time() - begun:.0f} CPU-s")


def list_sources() -> Iterator[tuple[tuple[str, str, str], MessageSettings | None]]:
    """Yield source, share and deviation [m] of each row, and the settings of its messages."""
    yield ("tracks", "", ""), None
    for source in ("messages", "tracks+messages"):
        for share in SHARES:
            for deviation_m in DEVIATIONS_M:
                yield (
                    (source, f"{share:g}", f"{deviation_m:g}"),
                    MessageSettings(share=share, position_m=deviation_m),
                )


def rate(found: Sequence[Boxes], truths: Sequence[FrameTruth]) -> list[str]:
    """Return precision and recall of labels of frames, then precision by ring and recall by ring."""
    whole = match(found, [t.targets for t in truths], [t.neutral for t in truths], 0.5)
    rates = [_share(whole.hit), whole.hit.sum() / whole.targets.sum()]
    within, reached = [], []
    for low, high in RINGS_M:
        near = [boxes[_lies(boxes, low, high)] for boxes in found]
        hits = match(near, [t.targets for t in truths], [t.neutral for t in truths], 0.5)
        within.append(_share(hits.hit))
        own = [_lies(t.targets, low, high) for t in truths]
        others = [concatenate([t.neutral, t.targets[~mine]]) for t, mine in zip(truths, own, strict=True)]
        hits = match(found, [t.targets[mine] for t, mine in zip(truths, own, strict=True)], others, 0.5)
        reached.append(hits.hit.sum() / hits.targets.sum())
    return [f"{value:.2f}" for value in (*rates, *within, *reached)]


def _share(hit: np.ndarray) -> float:
    return float(hit.mean()) if len(hit) else float("nan")


def _lies(boxes: Boxes, low_m: float, high_m: float) -> np.ndarray:
    distance = np.hypot(*boxes.center[:, :2].T)
    return (distance >= low_m) & (distance < high_m)


if __name__ == "__main__":
    main()

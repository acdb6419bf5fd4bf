"""The steps of the experiment: trainings within megabytes of uploads, and tests with both sensors or with one."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain

import numpy as np
import torch

from flcav.arrays import Array
from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.experiments.study import open_split
from flcav.geometry import Boxes, concatenate
from flcav.network.ledger import BYTES_PER_MB
from flcav.perception.metrics import average_precision, match
from flcav.perception.objects.config import CONFIGURATIONS
from flcav.perception.objects.modalities import read_cloud
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import LOWEST_SCORE, detect_in
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth, asked_of
from flcav.perception.objects.velocities import (
    MOVING_M_S,
    LateFusion,
    fit_late_fusion,
    fuse_late,
    list_velocity_errors,
)
from flcav.perception.task import build_network
from flcav.perception.training.loop import train
from flcav.perception.training.run import WEIGHTS
from flcav.perception.weights import load_network, save_network
from flcav.runs.engine import Work
from flcav.sensors.frame import Frame
from flcav.statistics.streams import stream

CLASS = "Car"
NETWORKS: Mapping[str, str] = {  # arm -> name of its network
    "LiDAR": "pillars_far",
    "LiDAR and radar": "pillars_radar",
    "LiDAR, painted": "pillars_painted",
}
LIDAR, RADAR, PAINTED = NETWORKS
LATE, NO_RADAR, BLACK = "LiDAR, radar late", "LiDAR and radar, no radar", "LiDAR, painted, black picture"
ARMS = (LIDAR, RADAR, PAINTED, LATE, NO_RADAR, BLACK)
CONDITIONS = ("clear", "heavy_rain", "fog", "night")
ALL, FAR = "all", "beyond 40 m"
PARTS = (*CONDITIONS, ALL, FAR)
FAR_M, BORDER_M = 40.0, 2.0
CRITERIA = CONFIGURATIONS["pillars_radar"]  # whose targets every arm is tested on
COUNTED = 20  # samples whose messages are measured
MISSED, SHIFT_M = 0.3, 0.3  # of quick annotations: share of objects left out, deviation of a box along x and along y


@dataclass(frozen=True)
class Trained:
    """A training: what it took."""

    samples: int
    sample_mb: float  # message of a sample, uncompressed, mean [MB]
    packed_mb: float  # message of a sample, compressed, mean [MB]
    seconds: float  # CPU time of the training [s]


def train_arm(
    work: Work, *, arm: str, mb: float | None, quick: bool, seed: int, steps: int, train_on: Sequence[str]
) -> Json:
    """Train an arm's network on as many samples as `mb` megabytes hold (None: all), drawn by the seed.

    quick: whether annotators are quick: boxes are missed and shifted.
    """
    config = CONFIGURATIONS[NETWORKS[arm]]
    frames = [(data, i) for name in train_on for data in [open_split(work.inputs[name])] for i in range(len(data))]
    order = stream(seed, "sweeps").permutation(len(frames))
    packed = [next(iter(OBJECTS.pack_samples(frames[k][0], config, [frames[k][1]]))) for k in order[:COUNTED]]
    sample_mb = float(np.mean([len(each) for each in packed])) / BYTES_PER_MB
    small_mb = float(np.mean([len(each) for each in OBJECTS.compress_samples(packed)])) / BYTES_PER_MB
    chosen = order if mb is None else order[: int(mb / sample_mb)]
    samples = [OBJECTS.samples(frames[k][0], config, [frames[k][1]])[0] for k in chosen]
    if quick:
        rng = stream(seed, "annotators")
        samples = [annotate_quickly(each, rng) for each in samples]
    network = build_network(OBJECTS, config, seed)
    began = time.process_time()
    train(OBJECTS, network, samples, steps=steps, batch=2, seed=seed, progress=work.report)
    seconds = time.process_time() - began
    save_network(OBJECTS, network, work.folder / WEIGHTS)
    return asdict(Trained(len(samples), sample_mb, small_mb, seconds))


def annotate_quickly(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample with the labels of quick annotators: `MISSED` of them left out, the others `SHIFT_M` off."""
    kept = sample.boxes[rng.random(len(sample.boxes)) >= MISSED]
    shifts = np.column_stack((SHIFT_M * rng.standard_normal((len(kept), 2)), np.zeros(len(kept))))
    return replace(sample, boxes=replace(kept, center=kept.center + shifts))


def validate_arm(work: Work, *, trained: str, validate_on: Sequence[str]) -> Json:
    """Return the AP50 of a trained network on the validation frames."""
    network = load_network(OBJECTS, work.inputs[trained] / WEIGHTS)
    frames = [*read_frames([open_split(work.inputs[name]) for name in validate_on])]
    truths = [asked_of(frame, CRITERIA) for frame in frames]
    return precision(detect(network, frames), truths)


def test_arms(
    work: Work, *, trained: Mapping[str, str], tests: Sequence[str], scenes: tuple[int, int], validate_on: Sequence[str]
) -> Json:
    """Return AP50, by arm and part, and the median velocity error [m/s] of moving cars that are found, likewise.

    trained: the step of each network; tests: those of the recordings of `CONDITIONS`, in which the first and the last
    of `scenes`, exclusive, are the seed's.
    """
    networks = {arm: load_network(OBJECTS, work.inputs[step] / WEIGHTS) for arm, step in trained.items()}
    held = [*read_frames([open_split(work.inputs[name]) for name in validate_on])]
    fusion = fit_late_fusion(
        detect(networks[LIDAR], held),
        [read_cloud(frame, CRITERIA) for frame in held],
        [asked_of(frame, CRITERIA) for frame in held],
        CLASS,
    )
    by_condition: dict[str, list[Frame]] = {}
    for condition, name in zip(CONDITIONS, tests, strict=True):
        data = open_split(work.inputs[name])
        own = data.manifest.scenes[slice(*scenes)]
        by_condition[condition] = [data.frame(i) for i in data.select(scenes=own)]
    found: dict[str, list[list[Boxes]]] = {arm: [] for arm in ARMS}
    truths: list[list[FrameTruth]] = []
    for frames in by_condition.values():
        truths.append([asked_of(frame, CRITERIA) for frame in frames])
        for arm, boxes in detect_by_arm(networks, fusion, frames).items():
            found[arm].append(boxes)
    everything = [*chain(*truths)]
    answer: dict[str, Json] = {}
    for arm, boxes in found.items():
        joined = [*chain(*boxes)]
        parts = dict(zip(CONDITIONS, zip(boxes, truths, strict=True), strict=True))
        parts |= {ALL: (joined, everything), FAR: keep_far(joined, everything)}
        answer[arm] = {
            "ap50": {part: precision(*pair) for part, pair in parts.items()},
            "velocity_m_s": {part: median_error(*pair) for part, pair in parts.items()},
        }
    return answer


def detect_by_arm(
    networks: Mapping[str, Second], fusion: LateFusion, frames: Sequence[Frame]
) -> dict[str, list[Boxes]]:
    """Return the detections of every arm in each frame, LiDAR frame."""
    deaf = [replace(frame, radar={}) for frame in frames]
    dark = [
        replace(
            frame,
            images={name: replace(image, rgb=np.zeros_like(image.rgb)) for name, image in frame.images.items()},
        )
        for frame in frames
    ]
    alone = detect(networks[LIDAR], frames)
    return {
        LIDAR: alone,
        RADAR: detect(networks[RADAR], frames),
        PAINTED: detect(networks[PAINTED], frames),
        LATE: [
            fuse_late(boxes, read_cloud(frame, CRITERIA), fusion) for boxes, frame in zip(alone, frames, strict=True)
        ],
        NO_RADAR: detect(networks[RADAR], deaf),
        BLACK: detect(networks[PAINTED], dark),
    }


def detect(network: Second, frames: Sequence[Frame]) -> list[Boxes]:
    """Return the detections of a network in each frame, LiDAR frame."""
    torch.set_num_threads(1)
    return [detect_in(network, [frame], score_threshold=LOWEST_SCORE)[0] for frame in frames]


def read_frames(datasets: Sequence[Dataset]) -> Iterator[Frame]:
    """Yield the frames of datasets."""
    return (data.frame(i) for data in datasets for i in range(len(data)))


def precision(found: Sequence[Boxes], truths: Sequence[FrameTruth]) -> float:
    """Return AP|R40 in 3D at IoU 0.5."""
    sides = ([truth.targets for truth in truths], [truth.neutral for truth in truths])
    return float(average_precision(match(found, *sides, 0.5)))


def keep_far(found: Sequence[Boxes], truths: Sequence[FrameTruth]) -> tuple[list[Boxes], list[FrameTruth]]:
    """Return detections from `FAR_M` on, less a border, and truths in which nearer targets are neutral."""
    far = [boxes[_distance(boxes) >= FAR_M - BORDER_M] for boxes in found]
    aside = []
    for truth in truths:
        near = _distance(truth.targets) < FAR_M
        aside.append(
            replace(truth, targets=truth.targets[~near], neutral=concatenate([truth.neutral, truth.targets[near]]))
        )
    return far, aside


def median_error(found: Sequence[Boxes], truths: Sequence[FrameTruth]) -> float | None:
    """Return the median velocity error [m/s] of moving cars that are found; None without any."""
    pairs = [list_velocity_errors(boxes, truth.targets) for boxes, truth in zip(found, truths, strict=True)]
    errors, speeds = (np.concatenate(column) for column in zip(*pairs, strict=True))
    moving: Array = errors[np.abs(speeds) >= MOVING_M_S]
    return float(np.median(moving)) if len(moving) else None


def _distance(boxes: Boxes) -> Array:
    return np.linalg.norm(boxes.center[:, :2], axis=1)

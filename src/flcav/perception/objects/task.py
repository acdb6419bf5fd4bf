"""3D object detection by SECOND as a `Task`, its error registry, and its study recipes.

A miss is a target or faint object (see `flcav.perception.objects.truth`) without a detection. A false positive is a
detection that lies on no annotated object and has at least one LiDAR return in its box. Both are within the range of
the network.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from flcav.arrays import Array
from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, points_in_boxes, transform_points
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.errors import FALSE_POSITIVE, MISS, THRESHOLD, PerceptionError, Registry, measure_distance
from flcav.perception.metrics.detection import assign_targets, on_neutral
from flcav.perception.objects.augment import Cutouts, augment, cut_out_objects, paste_objects
from flcav.perception.objects.config import CONFIGURATIONS, SecondConfig
from flcav.perception.objects.evaluate import (
    ObjectsEvaluation,
    ObjectsOutcomes,
    break_down,
    count_cars,
    count_objects,
    score_detections,
)
from flcav.perception.objects.loss import assign_anchors, second_loss
from flcav.perception.objects.modalities import frames_beside
from flcav.perception.objects.model import Second, second
from flcav.perception.objects.predict import (
    calibrate,
    detect_frames,
    detect_in,
    detect_objects,
    measure_reliability,
    predict,
)
from flcav.perception.objects.samples import (
    RecordedSweeps,
    Sample,
    compare_rig,
    compress_sample,
    pack_sample,
    select_fitting_frames,
    unpack_sample,
)
from flcav.perception.objects.truth import choose_lidar, ground_truth, in_range, target_criteria
from flcav.perception.objects.velocities import measure_velocities
from flcav.perception.study import StudyRecipe, read_recipe
from flcav.perception.task import Finding, KnownLidar, Practice
from flcav.sensors.frame import Frame

TOWNS = ("suburb", "ring", "grid")  # towns of the study
TRACKS = "tracks"  # name of the test of tracking


OVERLAP = 0.5  # 3D IoU from which an object is detected


def find_errors(
    frames: Iterable[Frame], detections: Iterable[Boxes], config: SecondConfig, threshold: float = THRESHOLD
) -> Iterator[list[PerceptionError]]:
    """Yield the misses and false positives of each frame, for detections that score at least `threshold`.

    They are in world coordinates; duplicates over frames are included, see `flcav.perception.errors`. `detections` has
    one `Boxes` per frame, LiDAR frame. Raises ValueError where `detections` and `frames` differ in length.
    """
    for frame, found in zip(frames, detections, strict=True):
        found = found[np.flatnonzero(found.score >= threshold)] if found.score is not None else found
        matched = np.zeros(len(found), dtype=bool)
        missed = _misses(frame, found, matched, config)
        yield [*missed, *_false_positives(frame, found[~matched], config)]


def _misses(frame: Frame, found: Boxes, matched: np.ndarray, config: SecondConfig) -> list[PerceptionError]:
    """Return the missed objects, and set `matched` (N,) for detections that match or lie on an annotated object."""
    truth, annotations = ground_truth(frame, config), frame.annotations
    label = truth.boxes.label
    wanted = truth.target | truth.faint
    missed = wanted.copy()
    for name in config.classes:
        same_class, objects = np.flatnonzero(found.label == name), np.flatnonzero(wanted & (label == name))
        target = assign_targets(found[same_class], truth.boxes[objects], OVERLAP)
        matched[same_class[target >= 0]] = True
        missed[objects[target[target >= 0]]] = False
    matched |= on_neutral(found, truth.boxes)
    rows = zip(
        annotations.boxes.center.tolist(), label, truth.returns, annotations.occlusion, annotations.track, missed
    )
    return [
        PerceptionError(
            *(x, y, z, 1.0, MISS, str(name), int(returns), float(hidden), frame.scene, str(track)),
            distance_m=measure_distance(frame.world_from_agent, x, y),
        )
        for (x, y, z), name, returns, hidden, track, lost in rows
        if lost
    ]


def _false_positives(frame: Frame, found: Boxes, config: SecondConfig) -> list[PerceptionError]:
    name = choose_lidar(frame)
    found = found[in_range(found, config)]
    returns = points_in_boxes(frame.lidar[name], found).sum(1)
    world = transform_points(frame.world_from_sensor(name), found.center)
    return [
        PerceptionError(
            *(x, y, z, 1.0, FALSE_POSITIVE, str(label), int(count), float("nan"), frame.scene, ""),
            distance_m=measure_distance(frame.world_from_agent, x, y),
        )
        for (x, y, z), label, count in zip(world.tolist(), found.label, returns, strict=True)
        if count >= 1
    ]


def streets_study() -> StudyRecipe:
    """Return the study recipe of generated streets: five per town, and a third of the sweeps of `ObjectsTask.study`.

    Cars in those sweeps have flat ends.
    """
    recipe, drawn = read_recipe("objects"), read_recipe("streets")
    tested = {"split": "test", "scenes": 10, "spins_per_scene": 4}
    drawn_test = {"split": "test", "scenes": 10}
    return StudyRecipe(
        network="small",
        train=(
            *({**recipe, "town": town, "scenes": 5} for town in TOWNS),
            *({**drawn, "town": town, "seed": seed} for town in TOWNS for seed in (23, 25, 27, 29, 31)),
        ),
        validation={**drawn, "town": "suburb", "seed": 123, "split": "validation", "scenes": 2},
        tests={
            **{town: {**recipe, **tested, "town": town, "seed": 451} for town in TOWNS},
            "streets": {**drawn, **drawn_test, "town": "suburb", "seed": 453},
            "streets-arterial": {**drawn, **drawn_test, "town": "arterial", "seed": 455},
        },
        epochs=8,
        patience=8,
    )


KEPT = 500  # samples, in all, whose ground-truth databases are kept for further drawing


class ObjectsTask(ObjectsOutcomes):
    """3D object detection in LiDAR sweeps by SECOND, as a perception task (see `flcav.perception.task.Task`)."""

    name = "objects"
    family = "second"
    configurations = CONFIGURATIONS
    practice = Practice(batch=2, learning_rate=2e-3)
    recording: Mapping[str, Json] = {}
    labels = (
        *("road", "ideal-road", "road-average", "own-detections", "tracks", "road+tracks"),
        *("messages", "tracks+messages", "road+tracks+messages", "annotated"),
    )
    threshold = THRESHOLD

    def __init__(self) -> None:
        self._cut: list[tuple[Sequence[Sample], Cutouts]] = []  # latest samples with their ground-truth databases

    def study(self) -> StudyRecipe:
        """Return the study recipe: training in three towns; tests on other scenes of them, in weather, of tracking."""
        recipe = read_recipe("objects")
        tested = {**recipe, "split": "test", "scenes": 10, "spins_per_scene": 4}
        weather = {"classes": ["clear", "light_rain", "heavy_rain", "fog"], "turn_s": 4.0}
        sequences = {**tested, "spins_per_scene": 20, "every_s": 0.5, "cavs": 1}
        return StudyRecipe(
            network="small",
            train=tuple({**recipe, "town": town} for town in TOWNS),
            validation={**recipe, "town": "suburb", "seed": 121, "split": "validation", "scenes": 2},
            tests={
                **{town: {**tested, "town": town, "seed": 441} for town in TOWNS},
                "weathers": {**tested, "town": "suburb", "seed": 541, "weather": weather},
                TRACKS: {**sequences, "town": "suburb", "seed": 641},
            },
            epochs=8,
            patience=8,
        )

    def build(self, config: SecondConfig) -> Second:
        """Return a new SECOND network, with weights drawn by torch's global generator."""
        return second(config)

    def samples(self, data: Dataset, config: SecondConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return the sweeps of frames (None: all) with ground truth as labels, read on access.

        Raises `InputError` where one of the frames has no LiDAR.
        """
        return RecordedSweeps(data, config, data.numbers(frames))

    def fitting(self, data: Dataset, config: SecondConfig) -> Sequence[int]:
        """Return the frames whose LiDAR is mounted at about the height that the network expects.

        See `flcav.perception.objects.samples`. Raises `InputError` where there are LiDARs but none fits.
        """
        return select_fitting_frames(data, config)

    def compare_rig(self, data: Dataset, config: SecondConfig, frames: Sequence[int], trained: KnownLidar) -> str:
        """Return how the frames' LiDAR differs from that of the network's training, in words.

        See `flcav.perception.objects.samples`.
        """
        return compare_rig(data, config, frames, trained)

    def draw(self, samples: Sequence[Sample], index: int, config: SecondConfig, rng: np.random.Generator) -> Sample:
        """Return sample `index` augmented as `config.augmentation` says, starting with ground-truth sampling.

        The ground-truth database is built from all samples when the first of them is drawn.
        """
        how = config.augmentation
        sample = samples[index]
        if how.paste:
            sample = paste_objects(sample, self._cutouts(samples, config), how.paste, rng, how.alike)
        return augment(sample, how, rng)

    def _cutouts(self, samples: Sequence[Sample], config: SecondConfig) -> Cutouts:
        for known, cutouts in self._cut:
            if known is samples:
                return cutouts
        made = cut_out_objects((samples[number] for number in range(len(samples))), config)
        # The clients of a federation take turns in one process; others' samples are not kept in memory for long.
        while self._cut and sum(len(known) for known, _ in self._cut) + len(samples) > KEPT:
            del self._cut[0]
        self._cut.append((samples, made))
        return made

    def loss(self, network: Second, samples: Sequence[Sample]) -> Tensor:
        """Return the loss of SECOND on a batch, differentiable in the network's parameters."""
        targets = [assign_anchors(sample, network.config) for sample in samples]
        return second_loss(predict(network, [sample.points for sample in samples]), targets, network.config)

    def evaluate(
        self,
        network: Second,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        asked: SecondConfig | None = None,
        progress: Report = ignore_progress,
    ) -> ObjectsEvaluation:
        """Return AP and AOS per class, kind of overlap and IoU, with intervals over scenes; near cars; breakdown.

        `frames` are their numbers (None: all). `asked` is the network's configuration with a smaller range, see
        `narrow_range` in `flcav.perception.objects.truth`. Raises `InputError` where there are no frames, or one has no
        LiDAR.
        """
        data.check_labelled("objects")
        numbers, classes = data.numbers(frames), network.config.classes
        found, truths = detect_frames(
            network,
            map(frames_beside(data, network.config, numbers), numbers),
            asked,
            total=len(numbers),
            progress=progress,
        )
        return ObjectsEvaluation(
            frames=len(truths),
            scenes=len({truth.scene for truth in truths}),
            scores=score_detections(found, truths, classes),
            rules=target_criteria(asked or network.config),
            near=count_cars(found, truths, classes, around=network.config.around),
            counts=count_objects(found, truths, classes),
            slices=break_down(found, truths, classes),
            trust=measure_reliability(found, truths, classes),
            velocities=measure_velocities(found, truths, classes) or None,
        )

    def calibrate(self, network: Second, data: Dataset, frames: Sequence[int] | None = None) -> None:
        """Set the Platt scaling of the network's scores, fitted on frames (None: all) not used for training."""
        data.check_labelled("objects")
        numbers = data.numbers(frames)
        calibrate(network, map(frames_beside(data, network.config, numbers), numbers))

    def pack_samples(self, data: Dataset, config: SecondConfig, frames: Sequence[int]) -> Iterator[bytes]:
        """Yield the messages of frames, with their whole sweep and boxes."""
        RecordedSweeps(data, config, frames)  # raises for frames without a LiDAR
        read = frames_beside(data, config, frames)
        return (pack_sample(read(i), config) for i in frames)

    def compress_samples(self, messages: Iterable[bytes]) -> Iterator[bytes]:
        """Yield messages of `pack_samples` with compressed sweeps."""
        return map(compress_sample, messages)

    def unpack_samples(self, messages: Sequence[bytes], config: SecondConfig) -> list[Sample]:
        """Return the samples in messages of `pack_samples` or `compress_samples`."""
        return [unpack_sample(message, config) for message in messages]

    def infer(
        self,
        network: Second,
        path: Path,
        threshold: float = THRESHOLD,
        frames: Sequence[int] | None = None,
        *,
        mount: Array | None = None,
    ) -> Iterator[Finding]:
        """Yield the objects detected in each point cloud of `path`, see `flcav.perception.objects.predict`.

        `mount` (4, 4) [m] is that of the LiDAR of files; None: as the network expects.
        """
        yield from detect_objects(network, path, threshold, frames, mount)

    def register_errors(
        self,
        network: Second,
        data: Dataset,
        frames: Sequence[int] | None = None,
        threshold: float = THRESHOLD,
        progress: Report = ignore_progress,
    ) -> Registry:
        """Return the registry of the network's misses and false positives on frames (None: all).

        `threshold` is the lowest score of a detection. See `find_errors`.
        """
        data.check_labelled("objects")
        numbers = data.numbers(frames)
        read = frames_beside(data, network.config, numbers)

        def found() -> Iterator[Boxes]:
            for done, number in enumerate(numbers, start=1):
                yield from detect_in(network, [read(number)], score_threshold=threshold)
                progress(done, len(numbers), "")

        mistakes = find_errors(map(read, numbers), found(), network.config, threshold)
        return Registry.of(dict(zip(numbers, mistakes, strict=True)))


OBJECTS = ObjectsTask()

"""Training samples of the detector: LiDAR sweeps with labels, from recorded frames or from messages.

In a message the sweep is whole, 16 bytes per point, or compressed, with the boxes to learn from.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from flcav.arrays import Array, Array32, Mask
from flcav.config import InputError
from flcav.dataset.formats.rig import LidarRig, StatedLidar, UsualLidar, find_rig
from flcav.dataset.formats.sweeps import list_cloud_files, read_cloud_file
from flcav.dataset.ground import DatasetGround
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, transform_points
from flcav.interface.wording import plural
from flcav.network.ledger import Arrays, from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.agents import POLE, kind_of
from flcav.perception.objects.config import ECHO, SWEEP_COLUMNS, SecondConfig
from flcav.perception.objects.modalities import frames_beside, read_cloud, widen
from flcav.perception.objects.truth import (
    LEVEL_M,
    LEVEL_RAD,
    ground_truth,
    level_mount,
    network_from_lidar,
    turn_of,
)
from flcav.perception.task import KnownLidar
from flcav.perception.weights import find_recorded_lidar
from flcav.sensors.frame import Frame
from flcav.sensors.lidar.compression import decode_sweep, encode_sweep

RANGE_SLACK = 0.2  # relative difference of a LiDAR's range from that of the training that is not mentioned
KEPT_PAINTED = 500  # painted sweeps of a recording that are kept in memory: painting takes longer than reading
HEIGHT_SLACK_M = 0.5  # largest difference between a LiDAR's height and the one that a network expects


@dataclass(frozen=True)
class Sample:
    """A labelled LiDAR sweep, LiDAR frame."""

    points: Array32  # (N, C) x, y, z [m], intensity [0, 1], and what a second modality adds, see `modalities`
    boxes: Boxes  # (B,) objects to detect; label = detection class
    ignore: Boxes = field(default_factory=Boxes.empty)  # objects left out of the loss, neither positive nor negative
    free: Array32 | None = None  # (K, 2) positions x, y [m] without objects; None: everywhere outside boxes
    exact: Mask | None = None  # (B,) whether size and pose of the box are learned too; None: all
    own: Boxes | None = None  # the vehicle's detections, for a contrastive loss; None: none


def sample_from_frame(frame: Frame, config: SecondConfig, lidar: str | None = None) -> Sample:
    """Return the frame's sweep with its ground truth as labels.

    Objects with `MIN_RETURNS` returns or more are to be detected. Those with fewer, but some, are ignored, and so are
    lookalikes with any; objects without a return are background. Objects out of range are kept, since augmentation may
    move them into it; points that it cannot move into the range of `config` are left out.

    The sweep is moved to the height and direction that the network expects, see `network_from_lidar`. `lidar` is the
    name of the LiDAR; None: the frame's first. Raises `InputError` where the frame has none of that name.
    """
    whole = label_sweep(frame, config, lidar)
    return replace(whole, points=crop_to_range(whole.points, config))


def label_sweep(frame: Frame, config: SecondConfig, lidar: str | None = None) -> Sample:
    """Return the frame's sweep, whole, with its ground truth as labels, see `sample_from_frame`."""
    truth = ground_truth(frame, config, lidar)
    ignored = (truth.returns > 0) & ((truth.known & ~truth.enough) | truth.lookalike)
    whole = Sample(read_cloud(frame, config, lidar), truth.boxes[truth.enough], truth.boxes[ignored])
    return move_sample(whole, network_from_lidar(frame, config, lidar))


def move_sample(sample: Sample, move: Array | None) -> Sample:
    """Return the sample in the target frame of the rigid transform `move` (4, 4) [m]; for None unchanged."""
    if move is None:
        return sample
    free = sample.free
    if free is not None:
        free = transform_points(move, np.pad(free, ((0, 0), (0, 1))))[:, :2].astype(np.float32)
    return map_sample(sample, move_points(sample.points, move), lambda boxes: boxes.transform(move), free)


def map_sample(sample: Sample, points: Array32, moved: Callable[[Boxes], Boxes], free: Array32 | None) -> Sample:
    """Return the sample with other points (N, 4) and free positions (K, 2), and with `moved` boxes, LiDAR frame."""
    detected = None if sample.own is None else moved(sample.own)
    boxes, ignore = moved(sample.boxes), moved(sample.ignore)
    return replace(sample, points=points, boxes=boxes, ignore=ignore, free=free, own=detected)


def move_points(points: Array32, move: Array | None) -> Array32:
    """Return points (N, C), x, y, z [m] first, in the target frame of the rigid `move` (4, 4); None: unchanged."""
    return (
        points
        if move is None
        else np.column_stack((transform_points(move, points[:, :3]).astype(np.float32), points[:, 3:]))
    )


class RecordedSweeps(Sequence[Sample]):
    """Frames of a dataset as a sequence of samples with ground truth as labels, which are read on access.

    Raises `InputError` where one of the frames has no LiDAR, or the dataset no labels of objects, and as
    `frames_beside` does.
    """

    def __init__(self, data: Dataset, config: SecondConfig, frames: Sequence[int]) -> None:
        data.check_labelled("objects")
        if blind := [data.name(number) for number in frames if not data.lidars(number)]:
            raise InputError(
                f"{data.folder}: no LiDAR in {len(blind)} of {plural(len(frames), 'frame')}, as in {blind[0]}"
            )
        self._read, self._config, self._frames = frames_beside(data, config, frames), config, frames
        self._painted: dict[int, Sample] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        if index in self._painted:
            return self._painted[index]
        sample = sample_from_frame(self._read(self._frames[index]), self._config)
        if self._config.beside == "painted" and len(self._painted) < KEPT_PAINTED:
            self._painted[index] = sample
        return sample


def select_fitting_frames(data: Dataset, config: SecondConfig) -> Sequence[int]:
    """Return the numbers of the frames whose first LiDAR is mounted at the expected height, within `HEIGHT_SLACK_M`.

    The height is that above the ground (`flcav.dataset.ground`), the expected one is -config.ground_z_m. A vehicle's
    origin is on the ground, a pole's at its sensors. All frames are returned where none has a LiDAR; reading them as
    samples then raises.

    Raises `InputError` where there are LiDARs but none fits.
    """
    height_m: dict[int, float] = {}
    ground = DatasetGround(data)
    for number, key in enumerate(data.keys):
        if lidars := data.lidars(number):
            mounts = data.calibrations[key.agent].true.agent_from_sensor
            height_m[number] = float(mounts[lidars[0]][2, 3] + ground.height_of(number))
    expected_m = -config.ground_z_m
    fitting = [number for number, height in height_m.items() if abs(height - expected_m) <= HEIGHT_SLACK_M]
    if height_m and not fitting:
        found = {data.keys[number].agent: height for number, height in height_m.items()}
        heights = ", ".join(f"{agent}: {height:g} m" for agent, height in found.items())
        raise InputError(
            f"{data.folder}: no LiDAR is mounted {expected_m:g} m above the ground, as the network expects "
            f"({heights}); --agents all takes them as they are"
        )
    return fitting or range(len(data))


def compare_rig(data: Dataset, config: SecondConfig, frames: Sequence[int], trained: KnownLidar) -> str:
    """Return how the LiDAR of the frames' agents differs from that of the network's training, see `describe_rig`."""
    agents = {data.keys[i].agent: data.lidars(i)[0] for i in frames if data.lidars(i)}
    mounts = [
        data.calibrations[agent].assumed.agent_from_sensor[lidar]
        for agent, lidar in agents.items()
        if kind_of(agent) != POLE
    ]
    here = find_recorded_lidar(data.manifest.recipe, agents) if agents else KnownLidar()
    return describe_rig(mounts, here, config, trained)


def describe_rig(mounts: Sequence[Array], here: KnownLidar, config: SecondConfig, trained: KnownLidar) -> str:
    """Return how a LiDAR `here` differs from that of the network's training, in words.

    It may differ in its number of beams, its range as far as the network looks, its height above the ground and its
    direction; the last two are corrected (see `flcav.perception.objects.truth.network_from_lidar`). "" if it does not,
    or not in anything known. `mounts` are the transforms (4, 4) vehicle from LiDAR, as assumed by the vehicles.
    """
    moved = [mount for mount in mounts if level_mount(mount, config) is not None]
    heights = dict.fromkeys(f"{mount[2, 3]:.2f}" for mount in moved if abs(mount[2, 3] + config.ground_z_m) > LEVEL_M)
    turned = dict.fromkeys(f"{math.degrees(angle):.0f}" for mount in moved if (angle := turn_of(mount)) > LEVEL_RAD)
    differences = []
    if trained.beams is not None and here.beams is not None and not _covers(trained.beams, here.beams):
        differences.append(f"has {_span(here.beams)} beams, not {_span(trained.beams)}")
    if trained.range_m is not None and here.range_m is not None:
        seen_m, known_m = (min(far_m, config.reach_m) for far_m in (here.range_m, trained.range_m))
        if abs(seen_m - known_m) > RANGE_SLACK * known_m:
            differences.append(f"reaches {here.range_m:g} m, not {trained.range_m:g} m")
    if heights:
        differences.append(f"is {', '.join(heights)} m above the ground, not {-config.ground_z_m:g} m (corrected)")
    if turned:
        differences.append(f"is turned by {', '.join(turned)} degrees (corrected)")
    return f"unlike in the network's training the LiDAR {' and '.join(differences)}" if differences else ""


def find_rigs(paths: Sequence[Path], config: SecondConfig, lidar: StatedLidar) -> dict[Path, LidarRig]:
    """Return the LiDAR of point cloud files by their folder, given files and folders of them.

    It is the one that a network of `config` expects, unless the sweeps or `lidar` say otherwise. Raises `InputError` as
    `find_rig` and `list_cloud_files` do.
    """
    files = defaultdict[Path, list[Path]](list)
    for path in paths:
        files[path if path.is_dir() else path.parent] += list_cloud_files(path)
    usual = UsualLidar("the network's", -config.ground_z_m)
    return {folder: find_rig(sweeps, read_cloud_file, lidar, usual) for folder, sweeps in files.items()}


def compare_files_rig(rig: LidarRig, lidar: StatedLidar, config: SecondConfig, trained: KnownLidar) -> str:
    """Return how the LiDAR of files by `find_rigs` differs from that of a network's training, in words; "" if not."""
    here = KnownLidar() if rig.beams is None else KnownLidar((rig.beams, rig.beams))
    stated = [] if lidar.height_m is None else [rig.agent_from_lidar]  # the notes tell a height that is found
    return "; ".join(filter(None, (*rig.notes, describe_rig(stated, here, config, trained))))


def _covers(beams: tuple[int, int], others: tuple[int, int]) -> bool:
    return beams[0] <= others[0] and others[1] <= beams[1]


def _span(beams: tuple[int, int]) -> str:
    return str(beams[0]) if beams[0] == beams[1] else f"{beams[0]} to {beams[1]}"


def crop_to_range(points: Array32, config: SecondConfig) -> Array32:
    """Return the points (N', 4) of a sweep (N, 4) that global augmentation may move into the range of `config`.

    Global augmentation is mirroring, rotation, scaling, shifting, tilting and lifting; the bounds are approximate.
    """
    x0, _, z0, _, _, z1 = config.range_m
    most = config.augmentation
    x, side, z = points[:, 0], np.abs(points[:, 1]), points[:, 2]
    distance = np.hypot(x, side)
    toward = x * math.cos(most.turn_rad) + side * math.sin(most.turn_rad)
    ahead = np.where(side < x * math.tan(most.turn_rad), distance, toward)  # largest x by any turn
    grow = 1 / (1 - most.scale)
    kept = distance <= config.reach_m * grow + most.shift_m * math.sqrt(2)
    kept &= ahead >= min(x0 * grow, x0 / grow) - most.shift_m * math.sqrt(2)
    slack = most.lift_m + distance * math.sin(most.tilt_rad)
    kept &= (z >= min(z0 * grow, z0 / grow) - slack) & (z <= max(z1 * grow, z1 / grow) + slack)
    return points[kept]


def validate_points(points: Array32, origin: str | Path) -> Array32:
    """Return the points unchanged; raises `InputError` unless they are (N, 4), N >= 1, with finite numbers in range.

    `origin` is their file or frame, named in the message.
    """
    if points.ndim != 2 or points.shape[1] != 4:
        raise InputError(f"{origin}: a point cloud of shape {points.shape}; (N, 4) x, y, z, intensity is wanted")
    if not len(points):
        raise InputError(f"{origin}: the point cloud is empty")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(1).sum())
        raise InputError(f"{origin}: {bad} of {plural(len(points), 'point')} are not finite numbers")
    if bad := int(((points[:, 3] < 0) | (points[:, 3] > 1)).sum()):
        raise InputError(f"{origin}: {bad} of {plural(len(points), 'point')} have an intensity outside 0 to 1")
    return points


def pack_sample(frame: Frame, config: SecondConfig) -> bytes:
    """Return the message of a frame's sweep with its ground truth; raises `InputError` where it has no LiDAR."""
    sample = label_sweep(frame, config)
    boxes = {**pack_boxes(sample.boxes, "boxes"), **pack_boxes(sample.ignore, "ignore")}
    return pack_arrays({**pack_cloud(sample.points, config), **boxes})


def compress_sample(message: bytes) -> bytes:
    """Return a message of `pack_sample` with its sweep compressed, see `flcav.sensors.lidar.compression`."""
    arrays = unpack_arrays(message)
    return pack_arrays({**arrays, "points": encode_sweep(arrays["points"])})


def unpack_sample(message: bytes, config: SecondConfig) -> Sample:
    """Return the training sample in a message: that of `sample_from_frame`, to a centimetre if it is compressed."""
    arrays = unpack_arrays(message)
    points = crop_to_range(unpack_cloud(arrays, config), config)
    return Sample(points, unpack_boxes(arrays, "boxes"), unpack_boxes(arrays, "ignore"))


def pack_cloud(cloud: Array32, config: SecondConfig) -> Arrays:
    """Return a cloud as arrays of a message: the sweep, 16 bytes a point, and what the second modality adds.

    An echo takes 20 bytes (x, y, z, range rate, cross-section), a score of a painted point one, to 1/255.
    """
    echo = cloud[:, 3] == ECHO
    sweep: Arrays = {"points": np.ascontiguousarray(cloud[~echo, :SWEEP_COLUMNS])}
    if config.beside == "radar":
        return sweep | {"echoes": np.ascontiguousarray(np.delete(cloud[echo], 3, axis=1))}
    if config.beside == "painted":
        return sweep | {"scores": np.rint(cloud[:, SWEEP_COLUMNS:] * 255).astype(np.uint8)}
    return sweep


def unpack_cloud(arrays: Arrays, config: SecondConfig) -> Array32:
    """Return the cloud in a message: the inverse of `pack_cloud`, blind where the message has only a sweep."""
    sent = arrays["points"]
    sweep = decode_sweep(sent) if sent.dtype == np.uint8 else sent
    if config.beside == "radar" and "echoes" in arrays:
        return np.concatenate((widen(sweep, config.columns), np.insert(arrays["echoes"], 3, ECHO, axis=1)))
    if config.beside == "painted" and "scores" in arrays:
        return np.column_stack((sweep, arrays["scores"] / 255)).astype(np.float32)
    return widen(sweep, config.columns)


def pack_boxes(boxes: Boxes, name: str) -> Arrays:
    """Return boxes without scores as arrays of a message, with their speeds if known."""
    speed = {} if boxes.speed is None else {f"{name}.speed": boxes.speed.astype(np.float32)}
    return {name: boxes.array(), f"{name}.label": from_names(boxes.label.tolist()), **speed}


def unpack_boxes(arrays: Arrays, name: str) -> Boxes:
    """Return the boxes in a message: the inverse of `pack_boxes`."""
    boxes = Boxes.from_array(arrays[name], to_names(arrays[f"{name}.label"]))
    speed = arrays.get(f"{name}.speed")
    return boxes if speed is None else replace(boxes, speed=speed.astype(np.float64))

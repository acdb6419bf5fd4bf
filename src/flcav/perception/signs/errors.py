"""Error registry of the sign detector: missed signs and lights, and false positives, with positions in the town."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from flcav.arrays import Array, Ints
from flcav.config import InputError
from flcav.dataset.rectangles import CLASSES, HALF_PX, select_rectangles
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.errors import FALSE_POSITIVE, MISS, PerceptionError, Registry, measure_distance
from flcav.perception.images import check_picture
from flcav.perception.metrics.detection import match_greedily
from flcav.perception.ops.boxes import rectangle_iou
from flcav.perception.signs.model import SignDetector, SignsConfig
from flcav.perception.signs.predict import SignDetections, detect_in_picture
from flcav.perception.signs.samples import find_targets, size_px
from flcav.sensors.frame import Frame
from flcav.sensors.lens import unproject_pixels
from flcav.world.rays.embree import Solid
from flcav.world.static import SignsAndSignals, build_static_world, list_signs_and_signals

OVERLAP = 0.5  # least IoU of a true positive
WITHIN = 0.5  # least share of a detection on a neutral (too small or cut off) box that excuses it


def register_sign_errors(
    network: SignDetector,
    data: Dataset,
    frames: Sequence[int],
    threshold: float,
    progress: Report = ignore_progress,
) -> Registry:
    """Return the missed signs and lights of the town, once each, and the false positives of each scene.

    Detections that score below `threshold` are ignored. A miss has the position of the sign in the town. A false
    positive has that of the first hit, in the static mesh of the town, of the ray through its centre; without a hit it
    is dropped, and counted. Raises `InputError` where the dataset's town is unknown, or none of the frames has a
    camera.
    """
    town = data.town()
    if town is None:
        raise InputError(f"{data.folder}: its town is not known, so that signs have no place in it")
    things, mesh = list_signs_and_signals(town), build_static_world(town).mesh
    solid = Solid(mesh.vertices, mesh.faces)
    pairs = [(number, camera) for number in frames for camera in data.cameras(number)]
    if not pairs:
        raise InputError(f"{data.folder}: no camera pictures in its frames; record it with cameras")
    mistakes: dict[int, list[PerceptionError]] = {}
    dropped = 0
    for done, (number, camera) in enumerate(pairs, start=1):
        frame = data.frame(number)
        picture = check_picture(data.plane(number, camera, "rgb"), f"{data.folder} {frame.key}")
        found = detect_in_picture(network, picture, threshold=threshold)
        height, width = picture.shape[:2]
        misses, false = _mistakes(frame, camera, found, (width, height), network.config)
        meets = list(_meets(frame, camera, found, false, solid, network.config))
        dropped += sum(error is None for error in meets)
        of_frame = mistakes.setdefault(number, [])
        of_frame += [*_misses(frame, camera, misses, things), *(error for error in meets if error is not None)]
        progress(done, len(pairs), "")
    return Registry.of(mistakes, dropped=dropped, standing=True)


def _mistakes(
    frame: Frame, camera: str, found: SignDetections, size: tuple[int, int], config: SignsConfig
) -> tuple[Ints, Ints]:
    """Return the annotation rows of the missed signs of an image, and the indices of the false positives."""
    shown = select_rectangles(frame, camera, "signs", min_pixels=1)
    names = [CLASSES["signs"][number] for number in shown.label]
    wanted = find_targets(shown.box, size, config) & np.array([name in config.classes for name in names], dtype=bool)
    overlap = rectangle_iou(torch.from_numpy(found.box), torch.from_numpy(shown.box)).numpy()
    same = np.array([[config.classes[label] == name for name in names] for label in found.label], dtype=bool)
    matched = match_greedily(np.where(same.reshape(overlap.shape) & wanted, overlap, 0.0), OVERLAP)
    false = [
        number
        for number in np.flatnonzero(matched < 0)
        if size_px(found.box[[number]])[0] >= config.smallest_px and not _on(found.box[number], shown.box[~wanted])
    ]
    missed = wanted.copy()
    missed[matched[matched >= 0]] = False
    return shown.row[missed], np.array(false, dtype=np.int64)


def _on(box: Array, others: Array) -> bool:
    """Return whether at least the share `WITHIN` of a box (4,) lies inside one of the other boxes (K, 4)."""
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    return bool(((high - low).clip(min=0).prod(1) >= WITHIN * (box[2:] - box[:2]).prod()).any())


def _misses(frame: Frame, camera: str, rows: Ints, things: SignsAndSignals) -> Iterator[PerceptionError]:
    signs = frame.annotations.signs[camera]
    shown = select_rectangles(frame, camera, "signs", min_pixels=1)
    for row in rows.tolist():
        thing = int(signs.thing[row])
        label = CLASSES["signs"][shown.label[int(np.flatnonzero(shown.row == row)[0])]]
        x, y, z = things.position[thing].tolist()
        track = f"{signs.kind[row]}{thing}"
        yield PerceptionError(
            *(x, y, z, 1.0, MISS, label, 0, float("nan"), frame.scene, track),
            distance_m=measure_distance(frame.world_from_agent, x, y),
        )


def _meets(
    frame: Frame, camera: str, found: SignDetections, numbers: Ints, solid: Solid, config: SignsConfig
) -> Iterator[PerceptionError | None]:
    """Yield each false positive at the point where its ray hits the town, None for a ray without a hit."""
    if not len(numbers):
        return
    calibration = frame.calibration
    middle = (found.box[numbers, :2] + found.box[numbers, 2:]) / 2 - HALF_PX
    plane = unproject_pixels(calibration.intrinsics[camera], calibration.distortion.get(camera, np.zeros(5)), middle)
    rays = np.concatenate((plane, np.ones((len(plane), 1))), axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    world_from_camera = frame.world_from_sensor(camera)
    distance = solid.trace(world_from_camera, np.nan_to_num(rays).astype(np.float32)).distance
    for number, ray, metres in zip(numbers, rays, distance, strict=True):
        if not (np.isfinite(ray).all() and np.isfinite(metres)):
            yield None
            continue
        x, y, z = (world_from_camera[:3, :3] @ ray * metres + world_from_camera[:3, 3]).tolist()
        label = config.classes[found.label[number]]
        yield PerceptionError(
            *(x, y, z, 1.0, FALSE_POSITIVE, label, 0, float("nan"), frame.scene, ""),
            distance_m=measure_distance(frame.world_from_agent, x, y),
        )

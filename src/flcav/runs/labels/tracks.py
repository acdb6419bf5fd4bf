"""Labels from tracks: a vehicle labels its frames after the drive, from the sweeps that it recorded around them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flcav.arrays import Array
from flcav.dataset.ground import DatasetGround
from flcav.fusion.announced import Announced
from flcav.fusion.average import BoxReport, PoseSource
from flcav.fusion.labels import cell_centers, find_free_ground, label_by_tracks
from flcav.fusion.road import RoadView
from flcav.fusion.tracks import LEAST_SCORE, VehicleSweep, track_objects
from flcav.geometry import Boxes, concatenate, inverse, transform_points
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import LOWEST_SCORE, detect_in
from flcav.perception.objects.samples import Sample, crop_to_range
from flcav.perception.objects.truth import asked_of, choose_lidar, detection_labels, in_range
from flcav.runs.frames import Frames, list_window
from flcav.runs.labels.pseudo_labels import EXACT, LabelFrame, find_precise_score
from flcav.runs.labels.sightings import navigate
from flcav.sensors.frame import Frame
from flcav.storage.files import write_bytes

TRACKS = "tracks.msgpack"
PRECISION = 0.95  # least precision of labels by tracks, on validation frames of the towns of pretraining
WINDOW_S, WINDOW_EVERY_S = 1.0, 0.2  # half width and period of the sweeps that are recorded around a frame [s]


def label_tracked(
    tracks: Mapping[int, Boxes], threshold: float, config: SecondConfig, ground: DatasetGround | None = None
) -> LabelFrame:
    """Return the labelling of frames by `tracks`, in the frame of their LiDAR, that score `threshold` or more.

    With the `ground` only what the vehicle sees to be free is background, as where tracks are of some vehicles alone.
    """

    def label(i: int, frame: Frame, views: Sequence[RoadView]) -> Sample:
        lidar, free = choose_lidar(frame), None
        if ground is not None:
            cells, points = cell_centers(config), crop_to_range(frame.lidar[lidar], config)
            free = cells[find_free_ground(frame, points, cells, lidar, ground.relief)]
        return label_by_tracks(frame, tracks[i], threshold, views, config, lidar, free)

    return label


def track_frame(
    network: Second,
    split: Frames,
    i: int,
    views: Sequence[RoadView] = (),
    poses: PoseSource = EXACT,
    announced: Announced | None = None,
    detects: bool = True,
) -> Boxes:
    """Return the tracks at frame `i` that score `LEAST_SCORE` or more, in the frame of its LiDAR.

    They join the detections of `network` in the sweeps that the vehicle recorded within `WINDOW_S` of the frame, placed
    by the `poses` of its navigation, the boxes in the `views` of road sensors at the spin, and the vehicles that
    `announced` themselves; unless the network `detects`, they have no detections.
    """
    sweeps, world_from_lidar = read_window(network if detects else None, split, i, poses)
    at_s = split.data.keys[i].time_s
    reported = [_classify(view.boxes, network.config) for view in views]
    others = [BoxReport(f"pole {number}", at_s, boxes) for number, boxes in enumerate(reported)]
    # Back by the navigation's pose, not the true one: an error common to all sweeps of the vehicle cancels.
    return track_objects(sweeps, at_s, others, LEAST_SCORE, announced).transform(inverse(world_from_lidar))


def read_window(
    network: Second | None, split: Frames, i: int, poses: PoseSource = EXACT
) -> tuple[list[VehicleSweep], Array]:
    """Return the sweeps that a vehicle recorded within `WINDOW_S` of frame `i`, and its LiDAR's pose (4, 4) there [m].

    Their boxes are the detections of `network`; without one they have none.
    """
    data = split.data
    sweeps = list[VehicleSweep]()
    known = dict[int, Array]()  # world_from_lidar by frame
    for number in list_window(split, (i,), WINDOW_S):
        frame = data.frame(number)
        lidar = choose_lidar(frame)
        world_from_lidar = navigate(data, number, poses)[0] @ frame.assumed.agent_from_sensor[lidar]
        known[number] = world_from_lidar
        found = Boxes.empty() if network is None else detect_in(network, [frame], score_threshold=LOWEST_SCORE)[0]
        points = transform_points(world_from_lidar, frame.lidar[lidar][:, :3].astype(np.float64))
        boxes = found.transform(world_from_lidar)
        origin = world_from_lidar[:3, 3]
        sweeps.append(VehicleSweep(data.keys[number].time_s, boxes, points, origin))
    return sweeps, known[i]


def save_tracks(tracks: Mapping[int, Boxes], folder: Path, heard: Mapping[int, int] = {}) -> None:
    """Write the tracks of frames, by number, into a step's folder, with the bytes that were `heard` around them."""
    boxes = concatenate([*tracks.values()])
    frame = np.repeat(np.array([*tracks], dtype=np.int64), [len(found) for found in tracks.values()])
    arrays = {"frames": np.array([*tracks], dtype=np.int64), "frame": frame, "boxes": boxes.array()}
    arrays |= {"score": np.zeros(0) if boxes.score is None else boxes.score, "label": from_names(boxes.label.tolist())}
    if heard:
        arrays["heard"] = np.array([heard[i] for i in tracks], dtype=np.int64)
    write_bytes(folder / TRACKS, pack_arrays(arrays))


def load_tracks(folder: Path) -> dict[int, Boxes]:
    """Read the tracks of frames, by frame number, from a step's folder: the inverse of `save_tracks`."""
    arrays = unpack_arrays((folder / TRACKS).read_bytes())
    boxes = Boxes.from_array(arrays["boxes"], to_names(arrays["label"]), arrays["score"])
    return {i: boxes[arrays["frame"] == i] for i in arrays["frames"].tolist()}


def load_heard(folder: Path) -> dict[int, int]:
    """Return the bytes of messages that were heard around frames, by number; none where labels are without messages."""
    arrays = unpack_arrays((folder / TRACKS).read_bytes())
    return dict(zip(arrays["frames"].tolist(), arrays.get("heard", np.zeros(0, np.int64)).tolist()))


def fit_track_threshold(network: Second, splits: Sequence[Frames], report: Report = ignore_progress) -> float:
    """Return the score threshold of labels: the lowest with a precision of `PRECISION` on validation frames, or 1."""
    frames = [(split, i) for split in splits for i in split.vehicles]
    truths = [asked_of(split.data.frame(i), network.config) for split, i in frames]

    def found() -> Iterator[Boxes]:
        for done, (split, i) in enumerate(frames, start=1):
            tracks = track_frame(network, split, i)
            yield tracks[in_range(tracks, network.config)]
            report(done, len(frames), "labels")

    return find_precise_score([*found()], truths, PRECISION)


def _classify(boxes: Boxes, config: SecondConfig) -> Boxes:
    """Return the boxes of road sensors that belong to the network's classes; their labels are actor categories."""
    label = detection_labels(boxes.label, config.classes)
    return replace(boxes, label=label)[label != ""]

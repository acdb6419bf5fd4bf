"""Labelled sweeps as messages: whole and uncompressed, 16 bytes a point, with the boxes to learn from."""

from flcav.geometry import Boxes
from flcav.network.ledger import Arrays, from_names, pack_arrays, to_names, unpack_arrays
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample, crop_to_range, label_sweep
from flcav.sensors.frame import Frame


def pack_sweep(frame: Frame, config: SecondConfig) -> bytes:
    """Return the message of a frame's sweep with its ground truth; raises `InputError` where it has no LiDAR."""
    sample = label_sweep(frame, config)
    return pack_arrays(
        {"points": sample.points, **pack_boxes(sample.boxes, "boxes"), **pack_boxes(sample.ignore, "ignore")}
    )


def unpack_sweep(message: bytes, config: SecondConfig) -> Sample:
    """Return the training sample in a message: that of `sample_from_frame`."""
    arrays = unpack_arrays(message)
    points = crop_to_range(arrays["points"], config)
    return Sample(points, unpack_boxes(arrays, "boxes"), unpack_boxes(arrays, "ignore"))


def pack_boxes(boxes: Boxes, name: str) -> Arrays:
    """Return boxes without scores as two arrays of a message."""
    return {name: boxes.array(), f"{name}.label": from_names(boxes.label.tolist())}


def unpack_boxes(arrays: Arrays, name: str) -> Boxes:
    """Return the boxes in a message: the inverse of `pack_boxes`."""
    return Boxes.from_array(arrays[name], to_names(arrays[f"{name}.label"]))

"""Labelled images of signs as messages: the files as recorded, and the boxes in them."""

from flcav.dataset.store import Dataset
from flcav.network.ledger import pack_arrays, unpack_arrays
from flcav.perception.images import check_picture, pack_pictures, unpack_pictures
from flcav.perception.signs.config import SignsConfig
from flcav.perception.signs.samples import Sample, sample_from_frame

BOXES = ("boxes", "label", "ignore")  # fields of a sample, and names of arrays after the camera's


def pack_frame(data: Dataset, number: int, config: SignsConfig) -> bytes:
    """Return the message of a frame: its images with their boxes."""
    frame, arrays = data.frame(number), dict(pack_pictures(data, number))
    for camera in frame.images:
        picture = check_picture(data.plane(number, camera, "rgb"), f"{data.folder} {frame.key}")
        sample = sample_from_frame(frame, camera, picture, config)
        arrays |= {f"{camera}.{field}": getattr(sample, field) for field in BOXES}
    return pack_arrays(arrays)


def unpack_frame(message: bytes) -> list[Sample]:
    """Return the samples in a message: those of `sample_from_frame` for each camera."""
    arrays = unpack_arrays(message)
    return [
        Sample(picture, *(arrays[f"{camera}.{field}"] for field in BOXES))
        for camera, picture in unpack_pictures(arrays).items()
    ]

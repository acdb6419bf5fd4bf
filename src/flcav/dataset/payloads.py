"""Encoding and decoding of measurement files (payloads): point clouds, images, depth, radar detections.

All encodings are lossless except that of depth, which rounds the mantissa to DEPTH_BITS. They were chosen by size and
CPU time, see `benchmarks/bench_recording.py`.

flcav's pictures are upright, turned by the orientation in their EXIF data (JEITA CP-3451, tag 274): a phone stores the
rows of its sensor, and how it was held.
"""

import io
import math
import struct
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from PIL import ExifTags, Image

from flcav.config import InputError, check_is_file
from flcav.dataset.layout import payload_path
from flcav.sensors.frame import Frame

DEPTH_BITS = 14  # bits kept of a depth's mantissa: rounds by up to 3 mm at 100 m
_DROPPED = 23 - DEPTH_BITS
PLANES = {"rgb": "webp", "depth_m": "depth.zst", "semantic": "semantic.png", "instance": "instance.png"}
PICTURES = ("webp", "png", "jpg", "jpeg")  # of colour images: recorded ones are WebP, imported ones as they were
POINTS, TIMES, RADAR, INFRARED = "bin", "times.bin", "radar.bin", "infrared.png"
LARGEST_PX = 8192  # sides of an image, as those of a `Lens`
TAIL = 4096  # bytes at the end of a JPEG or PNG in which its end marker is sought
COLUMNS = {POINTS: 4, TIMES: 1, RADAR: 5}  # of little-endian float32 in row-major order


class Payload(NamedTuple):
    """A measurement file of a frame: its path relative to the dataset folder, and its contents."""

    path: str
    data: bytes | memoryview


def encode_payloads(frame: Frame, left_out: Collection[str] = ()) -> Iterator[Payload]:
    """Yield the encoded measurement files of a frame: those of its LiDARs, cameras, infrared cameras and radars.

    The points and colour images of the sensors in `left_out` are left out.
    """
    for name, points in frame.lidar.items():
        if name not in left_out:
            yield Payload(payload_path(name, frame.key, POINTS), encode_rows(points))
    for name, times in frame.point_times.items():
        yield Payload(payload_path(name, frame.key, TIMES), encode_rows(times))
    for name in frame.images:
        if name not in left_out:
            for plane, suffix in PLANES.items():
                if (pixels := getattr(frame.images[name], plane)) is not None:
                    yield Payload(payload_path(name, frame.key, suffix), encode_plane(plane, pixels))
    for name, image in frame.infrared.items():
        yield Payload(payload_path(name, frame.key, INFRARED), encode_png(image))
    for name, detections in frame.radar.items():
        yield Payload(payload_path(name, frame.key, RADAR), encode_rows(detections))


def encode_rows(rows: NDArray[np.float32]) -> memoryview:
    """Return measurements (N, C) or (N,) of a LiDAR or radar as little-endian float32 bytes, row-major.

    The buffer is not copied where it already has this form.
    """
    return np.ascontiguousarray(rows, dtype="<f4").reshape(-1).view(np.uint8).data


def encode_plane(plane: str, pixels: NDArray) -> bytes:
    """Return the encoded file of one of the PLANES of a `CameraImage`: lossless WebP, Zstandard or PNG."""
    if plane == "rgb":
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, "webp", lossless=True, quality=0, method=0)
        return data.getvalue()
    return encode_depth(pixels) if plane == "depth_m" else encode_png(pixels)


def encode_depth(depth_m: NDArray[np.float32]) -> bytes:
    """Return depths (H, W) [m] as Zstandard-compressed bytes, with the mantissa rounded to DEPTH_BITS.

    The compressed content is a NumPy .npy file of (4, H, W) uint8: the byte planes of little-endian float32, least
    significant first.
    """
    bits = np.ascontiguousarray(depth_m, dtype="<f4").view("<u4")
    # Round half up in the integer representation; infinite depths keep their bits. Byte planes compress better.
    rounded = (bits + np.uint32(1 << (_DROPPED - 1))) & np.uint32(0xFFFFFFFF << _DROPPED & 0xFFFFFFFF)
    planes = np.where(np.isfinite(depth_m), rounded, bits).astype("<u4").view(np.uint8)
    data = io.BytesIO()
    np.save(data, np.ascontiguousarray(planes.reshape(*depth_m.shape, 4).transpose(2, 0, 1)))
    return pa.Codec("zstd", compression_level=1).compress(data.getvalue(), asbytes=True)


def read_rows(path: Path, suffix: str, expected: int) -> NDArray[np.float32]:
    """Return the float32 rows (expected, C) of a LiDAR or radar file; C is the entry of COLUMNS for `suffix`.

    Raises `InputError` where the file is missing or of another length.
    """
    row_bytes = 4 * COLUMNS[suffix]
    try:
        if (size := path.stat().st_size) != expected * row_bytes and not path.is_dir():
            raise InputError(f"{path}: {size} bytes where {expected} points take {expected * row_bytes}")
        check_is_file(path, None)
        return np.fromfile(path, "<f4", expected * COLUMNS[suffix]).reshape(-1, COLUMNS[suffix])
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{path}: missing from the dataset") from None


def read_plane(path: Path, plane: str) -> NDArray:
    """Return one of the PLANES of a `CameraImage`, (H, W) or, for "rgb", (H, W, 3).

    Raises `InputError` where the file is missing or not an image of this kind.
    """
    if plane == "depth_m":
        return _read_depth(path)
    return read_image(path, np.uint16 if plane == "instance" else np.uint8, channels=3 if plane == "rgb" else 1)


def read_image(path: Path, dtype: type[np.generic], channels: int = 1) -> NDArray:
    """Return the pixels of a PNG, WebP or JPEG file as `dtype`, (H, W), or (H, W, channels) for several channels.

    They are upright. Raises `InputError` where the file is missing, is not such an image, or has another number of
    channels.
    """
    try:
        with open_image(path) as image:
            bands = len(image.getbands())
            pixels = np.asarray(turn_upright(image))
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{path}: missing from the dataset") from None
    except InputError:
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: not a readable image ({error})") from None
    if bands != channels:
        raise InputError(f"{path}: not a readable image (it has {bands} channels, not {channels})")
    return pixels.astype(dtype)


def open_image(file: Path | io.BytesIO) -> Image.Image:
    """Open a PNG, WebP or JPEG image without decoding it; raises `InputError` where a side exceeds LARGEST_PX."""
    if isinstance(file, Path) and file.exists():
        check_is_file(file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # such images are refused below
        image = Image.open(file, formats=("PNG", "WEBP", "JPEG"))
    if max(image.size) > LARGEST_PX:
        image.close()
        size = f"{image.width} x {image.height}"
        raise InputError(f"{file}: a picture of {size} pixels; sides of at most {LARGEST_PX} are wanted")
    return image


def check_image(path: Path) -> None:
    """Raise `InputError` where an image file is missing, truncated or not of a kind in PICTURES, without decoding it.

    A PNG ends in its chunk IEND (ISO/IEC 15948, 11.2.5), a JPEG in the marker FFD9 (ITU-T T.81, B.1.1.3), after which
    some programs write more; the length of a WebP is in its header (RFC 9649, 2.3).
    """
    check_is_file(path)
    with path.open("rb") as file:
        head = file.read(12)
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - TAIL))
        tail = file.read()
    if head.startswith(b"\x89PNG"):
        whole = b"IEND" in tail
    elif head.startswith(b"\xff\xd8"):
        whole = b"\xff\xd9" in tail
    elif head.startswith(b"RIFF") and head.endswith(b"WEBP"):
        whole = size >= 8 + int.from_bytes(head[4:8], "little")
    else:
        raise InputError(f"{path}: not an image, or a truncated one")
    if not whole:
        raise InputError(f"{path}: a truncated image")


def _read_depth(path: Path) -> NDArray[np.float32]:
    """Return the depths (H, W) [m] that `encode_depth` wrote; never decompress more than the header announces."""
    try:
        if path.exists():
            check_is_file(path)
        with pa.CompressedInputStream(pa.OSFile(str(path)), "zstd") as stream:
            if (version := np.lib.format.read_magic(stream)) != (1, 0):
                raise ValueError(f"version {version} of .npy")
            shape, by_column, dtype = np.lib.format.read_array_header_1_0(stream)
            fits = len(shape) == 3 and shape[0] == 4 and all(0 <= side <= LARGEST_PX for side in shape)
            if by_column or dtype != np.uint8 or not fits:
                raise ValueError(f"it holds {dtype} of shape {shape}")
            size = math.prod(shape)
            if len(data := stream.read(size + 1)) != size:
                raise ValueError("its length is not that of its header")
        planes = np.frombuffer(data, np.uint8).reshape(shape)
        return np.ascontiguousarray(planes.transpose(1, 2, 0)).view("<f4")[..., 0]
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{path}: missing from the dataset") from None
    except Exception as error:  # np.load evaluates the header as a Python literal, which may raise anything
        raise InputError(f"{path}: not a readable depth image ({error})") from None


def encode_png(pixels: NDArray) -> bytes:
    """Return a PNG file of (H, W, 3) RGB pixels, or of (H, W) grey levels of 8 or 16 bits."""
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "png", compress_level=1)
    return data.getvalue()


TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
ON_SIDE = (5, 6, 7, 8)  # orientations that exchange width and height


def turn_upright(image: Image.Image) -> Image.Image:
    """Return an opened, not yet decoded image, turned upright."""
    turn = TURNS.get(_orientation(image))
    return image if turn is None else image.transpose(turn)


def measure_upright(image: Image.Image) -> tuple[int, int]:
    """Return width and height [px] of the upright image, without decoding it."""
    width, height = image.size
    return (height, width) if _orientation(image) in ON_SIDE else (width, height)


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation, or 1 where there is none that can be read without decoding the pixels."""
    if "exif" not in image.info:
        return 1
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    except (SyntaxError, ValueError, OSError, struct.error):  # damaged; the pixels need not be
        return 1
    return orientation if isinstance(orientation, int) else 1

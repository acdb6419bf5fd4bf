"""Pictures as networks take them: read from whatever a user names, checked, resized."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageEnhance, UnidentifiedImageError

from flcav.config import InputError
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.sensors.frame import Frame

Picture = NDArray[np.uint8]  # (H, W, 3) sRGB

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
SMALLEST_PX, LARGEST_PX = 32, 8192  # side of a picture


def pictures(path: Path, frames: Sequence[int] | None = None) -> Iterator[tuple[Path, Picture]]:
    """Yield the pictures of a PNG, JPEG or WebP file, a folder of them, or `frames` of a dataset folder (None: all).

    Each comes with its own path.

    Raises `InputError` for anything else, and for a picture that is damaged, not RGB or of a size out of bounds.
    """
    if (path / MANIFEST).is_file():
        data = Dataset.open(path)
        return ((path / f"{frame.key}/{camera}", rgb) for frame, camera, rgb in recorded(data, frames))
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        if not files:
            raise InputError(f"{path}: neither a dataset nor a folder with {', '.join(SUFFIXES)} files")
        return ((file, read_picture(file)) for file in files)
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder")
    return iter([(path, read_picture(path))])


def recorded(data: Dataset, frames: Sequence[int] | None = None) -> Iterator[tuple[Frame, str, Picture]]:
    """Yield the pictures in frames of a dataset, with frame and camera; raises `InputError` where there is none."""
    seen = False
    for number in data.numbers(frames):
        frame = data.frame(number)
        for camera in data.cameras(number):
            seen = True
            rgb = data.plane(number, camera, "rgb")  # the image's other planes are not read
            yield frame, camera, checked_picture(rgb, f"{data.folder} {frame.key}/{camera}")
    if not seen:
        raise InputError(f"{data.folder}: no camera pictures in its frames; record it with cameras")


def read_picture(path: Path) -> Picture:
    """Return an RGB picture file; raises `InputError` for anything else."""
    try:
        with Image.open(path, formats=("PNG", "JPEG", "WEBP")) as image:
            channels, mode = len(image.getbands()), image.mode
            if mode not in ("RGB", "P"):
                raise InputError(f"{path}: a picture of {channels} channels ({mode}); 3 are wanted: red, green, blue")
            pixels = np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a picture, or a damaged one") from None
    return checked_picture(pixels, path)


def checked_picture(pixels: NDArray[np.uint8], origin: str | Path) -> Picture:
    """Return the picture, or raise `InputError` where a network can do nothing with it."""
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise InputError(f"{origin}: a picture of shape {pixels.shape}; (H, W, 3) red, green, blue is wanted")
    height, width = pixels.shape[:2]
    if not (min(height, width) >= SMALLEST_PX and max(height, width) <= LARGEST_PX):
        bounds = f"{SMALLEST_PX} to {LARGEST_PX}"
        raise InputError(f"{origin}: a picture of {width} x {height} pixels; sides of {bounds} are wanted")
    return pixels


def resized(picture: Picture, width: int, height: int) -> Picture:
    """Return the picture at another size; when it shrinks, each pixel is the weighted mean of those it covers."""
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR))


def recoloured(picture: Picture, gain: float, saturation: float) -> Picture:
    """Return the picture `gain` times as bright and its colours `saturation` times as far from grey."""
    coloured = ImageEnhance.Color(Image.fromarray(picture)).enhance(saturation)
    return np.asarray(ImageEnhance.Brightness(coloured).enhance(gain))

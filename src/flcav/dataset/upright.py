"""Pictures turned upright, as the orientation in their EXIF data says (JEITA CP-3451, tag 274).

A phone stores the rows of its sensor and how it was held. Sizes and coordinates of pixels are those of the upright
picture everywhere in flcav.
"""

import struct

from PIL import ExifTags, Image

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
    """Return an image that was opened and not yet decoded, upright."""
    turn = TURNS.get(_orientation(image))
    return image if turn is None else image.transpose(turn)


def measure_upright(image: Image.Image) -> tuple[int, int]:
    """Return width and height [px] of the image upright; it is not decoded."""
    width, height = image.size
    return (height, width) if _orientation(image) in ON_SIDE else (width, height)


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation, 1 where there is none, or none that is read before the pixels are."""
    if "exif" not in image.info:
        return 1
    try:
        found = image.getexif().get(ExifTags.Base.Orientation, 1)
    except (SyntaxError, ValueError, OSError, struct.error):  # damaged; the pixels need not be
        return 1
    return found if isinstance(found, int) else 1

"""Pictures as PNG files."""

from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

FAST = 1  # zlib level: 3 times as fast as the default for files 10 % larger


def png(pixels: NDArray[np.uint8]) -> bytes:
    """Return a PNG of (H, W, 3) red, green, blue or (H, W) grey levels; without loss."""
    data = BytesIO()
    Image.fromarray(pixels).save(data, "png", compress_level=FAST)
    return data.getvalue()

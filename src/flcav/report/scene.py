"""The script `scene.js`, which draws sweeps and towns in three dimensions in any page, with three.js inside.

It is the bundle of `planner/web/src/scene`.
"""

import base64
import gzip
from pathlib import Path

SCENE = Path(__file__).with_name("scene.js")


def pack(text: str) -> str:
    """Return a text as base64 of its gzip, which a page unpacks when it is wanted; equal texts give equal ones."""
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()

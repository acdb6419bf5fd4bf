"""Where a run recipe's paths lead: towns, datasets and histories beside it, or in the working directory."""

import os
from pathlib import Path


def find_place(name: str, beside: Path) -> Path | None:
    """Return the file or folder `name` in the folder `beside`, or else in the working directory; None for neither."""
    sought = (beside / name, Path.cwd() / name)
    return next((path for path in sought if os.path.exists(path)), None)  # noqa: PTH110 - which takes any name

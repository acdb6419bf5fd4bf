"""Datasets: recording, reading, validation, and export to other formats."""

from typing import TYPE_CHECKING

from flcav.interface.lazy import lazy_names

if TYPE_CHECKING:
    from flcav.dataset.recording.recorder import record
    from flcav.dataset.store import Dataset
    from flcav.dataset.validation import validate

PLACES = {
    "validate": "flcav.dataset.validation",
    "record": "flcav.dataset.recording.recorder",
    "Dataset": "flcav.dataset.store",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)

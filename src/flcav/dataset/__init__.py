"""Datasets: recording, reading, validation, export to other formats and import of them."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.dataset.formats.conversion import export, import_dataset
    from flcav.dataset.formats.formats import EXPORTS, IMPORTS
    from flcav.dataset.formats.reading import ImportFormat, LogSource, annotate
    from flcav.dataset.formats.rig import StatedLidar, UsualLidar, find_rig
    from flcav.dataset.formats.writing import Exported, ExportFormat, ExportOptions, read_frame
    from flcav.dataset.recording.recorder import record
    from flcav.dataset.store import Dataset
    from flcav.dataset.validation import validate

PLACES = {
    "validate": "flcav.dataset.validation",
    "record": "flcav.dataset.recording.recorder",
    "Dataset": "flcav.dataset.store",
    "EXPORTS": "flcav.dataset.formats.formats",
    "export": "flcav.dataset.formats.conversion",
    "ExportOptions": "flcav.dataset.formats.writing",
    "Exported": "flcav.dataset.formats.writing",
    "ExportFormat": "flcav.dataset.formats.writing",
    "read_frame": "flcav.dataset.formats.writing",
    "IMPORTS": "flcav.dataset.formats.formats",
    "import_dataset": "flcav.dataset.formats.conversion",
    "ImportFormat": "flcav.dataset.formats.reading",
    "LogSource": "flcav.dataset.formats.reading",
    "annotate": "flcav.dataset.formats.reading",
    "find_rig": "flcav.dataset.formats.rig",
    "StatedLidar": "flcav.dataset.formats.rig",
    "UsualLidar": "flcav.dataset.formats.rig",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)

"""Registry of the dataset formats: `EXPORTS` and `IMPORTS` list those of the package; a user's is `module:NAME`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from flcav.plugins import load_named

if TYPE_CHECKING:
    from flcav.dataset.formats.reading import ImportFormat
    from flcav.dataset.formats.writing import ExportFormat

EXPORTS: Mapping[str, str] = {  # name -> module:NAME, so that listing the formats imports none
    "kitti": "flcav.dataset.formats.kitti.write:EXPORT",
    "yolo": "flcav.dataset.formats.yolo:EXPORT",
    "coco": "flcav.dataset.formats.coco:EXPORT",
    "nuscenes": "flcav.dataset.formats.nuscenes.write:EXPORT",
    "opv2v": "flcav.dataset.formats.opv2v.write:EXPORT",
    "mcap": "flcav.dataset.formats.mcap:EXPORT",
    "culane": "flcav.dataset.formats.culane:EXPORT",
}
IMPORTS: Mapping[str, str] = {
    "kitti": "flcav.dataset.formats.kitti.read:IMPORT",
    "kitti-tracking": "flcav.dataset.formats.kitti.tracking:IMPORT",
    "nuscenes": "flcav.dataset.formats.nuscenes.read:IMPORT",
    "argoverse2": "flcav.dataset.formats.argoverse2:IMPORT",
    "opv2v": "flcav.dataset.formats.opv2v.read:IMPORT",
    "dair-v2x": "flcav.dataset.formats.roadside:DAIR",
    "tumtraf": "flcav.dataset.formats.roadside:TUMTRAF",
    "carlaflcav": "flcav.dataset.formats.carlaflcav:IMPORT",
}


def export_format(name: str) -> "ExportFormat":
    """Return the format of that name to write: one in `EXPORTS`, or a user's as `module:NAME`.

    Raises `InputError` for an unknown name, and where the user's module is missing or has no format of that name.
    """
    from flcav.dataset.formats.writing import ExportFormat

    return load_named("export format", name, EXPORTS, ExportFormat)


def import_format(name: str) -> "ImportFormat":
    """Return the format of that name to read: one in `IMPORTS`, or a user's as `module:NAME`.

    Raises `InputError` for an unknown name, and where the user's module is missing or has no format of that name.
    """
    from flcav.dataset.formats.reading import ImportFormat

    return load_named("import format", name, IMPORTS, ImportFormat)

"""A dataset in another format's layout: a folder that is whole, or not there."""

import contextlib
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from flcav.config import InputError
from flcav.dataset.formats.coco import export_coco
from flcav.dataset.formats.exporter import Exporter, ExportOptions
from flcav.dataset.formats.kitti.export import export_kitti
from flcav.dataset.formats.mcap import export_mcap
from flcav.dataset.formats.nuscenes import export_nuscenes
from flcav.dataset.formats.opv2v import export_opv2v
from flcav.dataset.formats.yolo import export_yolo
from flcav.dataset.store import Dataset
from flcav.progress import Report, silent

EXPORTERS: Mapping[str, Exporter] = {
    "kitti": export_kitti,
    "yolo": export_yolo,
    "coco": export_coco,
    "nuscenes": export_nuscenes,
    "opv2v": export_opv2v,
    "mcap": export_mcap,
}
DEFAULTS = ExportOptions()


def export(
    dataset: Dataset, name: str, out: Path, options: ExportOptions = DEFAULTS, *, progress: Report = silent
) -> Counter[str]:
    """Write `dataset` in the format `name` to the new or empty folder `out`; returns counts of what was written.

    Raises `InputError` for an unknown format, a folder that holds files, and a dataset that lacks what the format
    needs. However it ends early, `out` does not appear.
    """
    if name not in EXPORTERS:
        raise InputError(f"format '{name}': unknown; known formats: {', '.join(EXPORTERS)}")
    with _new_folder(out) as folder:
        return EXPORTERS[name](dataset, folder, options, progress)


@contextlib.contextmanager
def _new_folder(path: Path) -> Iterator[Path]:
    """Yield a hidden sibling of `path` to fill: renamed to `path` on success, removed on any failure."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; an export needs a folder")
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: holds other files; export into a new or empty folder")
    part = path.absolute().with_name(f".{path.absolute().name}.part")
    shutil.rmtree(part, ignore_errors=True)  # of an export that was killed
    part.mkdir(parents=True)
    try:
        yield part
        if path.is_dir():
            path.rmdir()
        part.rename(path)
    except OSError as error:
        if error.strerror and error.filename is None:
            error.filename = str(path)
        raise
    finally:
        shutil.rmtree(part, ignore_errors=True)

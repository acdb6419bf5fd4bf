"""Export of a dataset to a format of the field, into a folder that appears only when it is complete."""

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from flcav.config import InputError
from flcav.dataset.formats.coco import export_coco
from flcav.dataset.formats.exporter import Exported, Exporter, ExportOptions
from flcav.dataset.formats.kitti.write import export_kitti
from flcav.dataset.formats.mcap import export_mcap
from flcav.dataset.formats.nuscenes import export_nuscenes
from flcav.dataset.formats.opv2v.write import export_opv2v
from flcav.dataset.formats.yolo import export_yolo
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.locks import LOCK, only_writer
from flcav.storage.files import flush_tree

DEFAULTS = ExportOptions()


@dataclass(frozen=True)
class Format:
    """An export format: its exporter, and the options that apply to it."""

    write: Exporter
    options: tuple[str, ...]  # fields of `ExportOptions` that apply


FORMATS: Mapping[str, Format] = {
    "kitti": Format(export_kitti, ("validation", "min_points", "calibration")),
    "yolo": Format(export_yolo, ("labels", "validation", "min_pixels")),
    "coco": Format(export_coco, ("validation", "min_pixels")),
    "nuscenes": Format(export_nuscenes, ("validation", "calibration")),
    "opv2v": Format(export_opv2v, ("validation", "min_points", "calibration")),
    "mcap": Format(export_mcap, ("calibration",)),
}


def export(
    dataset: Dataset, name: str, out: Path, options: ExportOptions = DEFAULTS, *, progress: Report = ignore_progress
) -> Exported:
    """Write `dataset` in the format `name`, one of FORMATS, to the new or empty folder `out`; return counts.

    Raises `InputError` for an unknown format, an option that is set but does not apply to the format, a folder that is
    not empty, and a dataset that lacks what the format needs. After any failure no partial output is left.
    """
    if name not in FORMATS:
        raise InputError(f"format '{name}': unknown; known formats: {', '.join(FORMATS)}")
    taken = FORMATS[name].options
    if refused := options.model_fields_set.difference(taken):
        flags = [f"--{option.replace('_', '-')}" for option in (min(refused), *taken)]
        raise InputError(f"format '{name}': has no use for {flags[0]}; it takes {', '.join(flags[1:])}")
    with only_writer(out), _new_folder(out) as folder:
        return FORMATS[name].write(dataset, folder, options, progress)


@contextlib.contextmanager
def _new_folder(path: Path) -> Iterator[Path]:
    """Yield a hidden folder beside `path` to write into; it is renamed to `path` on success and removed on failure.

    Raises `InputError` where `path` is a file or a folder that is not empty.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; an export needs a folder")
    if path.is_dir() and any(each.name != LOCK for each in path.iterdir()):
        raise InputError(f"{path}: holds other files; export into a new or empty folder")
    part = path.absolute().with_name(f".{path.absolute().name}.part")
    shutil.rmtree(part, ignore_errors=True)  # leftover of a killed export
    part.mkdir(parents=True)
    try:
        yield part
        flush_tree(part)
        if path.is_dir():
            path.rmdir()
        part.rename(path)
    except OSError as error:
        if error.strerror and error.filename is None:
            error.filename = str(path)
        raise
    finally:
        shutil.rmtree(part, ignore_errors=True)

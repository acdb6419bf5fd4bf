"""Export of a dataset to a format of the field, into a folder that appears only when it is complete."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from flcav.config import InputError
from flcav.dataset.formats.exporter import Exported, ExportOptions
from flcav.dataset.formats.formats import export_format
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.locks import LOCK, only_writer
from flcav.storage.files import flush_tree

DEFAULTS = ExportOptions()


def export(
    dataset: Dataset, name: str, out: Path, options: ExportOptions = DEFAULTS, *, progress: Report = ignore_progress
) -> Exported:
    """Write `dataset` in the format `name` to the new or empty folder `out`; return counts.

    Raises `InputError` for an unknown format, an option that is set but does not apply to the format, a folder that is
    not empty, and a dataset that lacks what the format needs. After any failure no partial output is left.

    Args:
        dataset: the dataset.
        name: a name of `EXPORTS`, or a user's own format as `module:NAME`.
        out: new or empty folder.
        options: options that the format takes.
        progress: callback for the frames written so far and in total.
    """
    chosen = export_format(name)
    if refused := options.model_fields_set.difference(chosen.options):
        flag, *taken = (f"--{option.replace('_', '-')}" for option in (min(refused), *chosen.options))
        raise InputError(f"format '{name}': has no use for {flag}; it takes {', '.join(taken) or 'no options'}")
    with only_writer(out), _new_folder(out) as folder:
        return chosen.write(dataset, folder, options, progress)


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

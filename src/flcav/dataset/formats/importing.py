"""Import of datasets of other formats, by reading them as a source of frames and recording that."""

from collections.abc import Callable
from pathlib import Path

from flcav.config import InputError
from flcav.dataset.formats.formats import IMPORTS, import_format
from flcav.dataset.formats.reading import LogSource
from flcav.dataset.layout import WORK
from flcav.dataset.recording.recorder import drop_unbegun, record
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.locks import only_writer
from flcav.sources.source import Source


def import_dataset(
    name: str,
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    posed: Callable[[LogSource], Source] = lambda source: source,
    progress: Report = ignore_progress,
) -> tuple[str, ...]:
    """Record the dataset of the format `name` in `folder` as one of flcav's in `out`.

    Points and pictures that are in an encoding of flcav's are linked to, others are rewritten. Returns sentences on
    what the files do not have. Raises `InputError` where `folder` is missing, of another format or damaged, and as
    `record` does; scenes that were complete by then stay in `out`, and the same call goes on from there.

    Args:
        name: a name of `IMPORTS`, or a user's own format as `module:NAME`.
        folder: folder of that format, as it is distributed.
        out: new or empty folder for the dataset.
        split: split whose scenes are taken; None: all.
        posed: what gives the frames other poses, such as `flcav.fusion.odometry.DrivenSource`.
        progress: callback for the frames recorded so far and in total.
    """
    chosen = import_format(name)
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is a file, and a folder is wanted' if folder.exists() else 'no such folder'}")
    if chosen.signs and not _shows(folder, chosen.signs):
        for other in IMPORTS:
            if _shows(folder, import_format(other).signs):
                raise InputError(f"{folder}: is no folder of '{name}' but of '{other}'")
    with only_writer(out):
        begun = (out / WORK).exists()  # by an earlier call
        try:
            source = chosen.read(folder, split)
            record(posed(source), out, progress=progress)
        except (ValueError, OSError) as error:
            if not begun:
                drop_unbegun(out)
            if isinstance(error, InputError | OSError):
                raise
            raise InputError(f"{folder}: cannot be imported ({error})") from None  # names that a dataset cannot hold
    return source.notes


def _shows(folder: Path, signs: tuple[str, ...]) -> bool:
    return any(next(folder.glob(sign), None) is not None for sign in signs)

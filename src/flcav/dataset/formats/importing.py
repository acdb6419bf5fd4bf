"""Import of datasets of other formats, by reading them as a source of frames and recording that."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from flcav.config import InputError, Json
from flcav.dataset.checks.frames import check_triggers
from flcav.dataset.checks.scenes import EmptyBoxes
from flcav.dataset.formats.formats import IMPORTS, import_format
from flcav.dataset.formats.reading import LogSource
from flcav.dataset.layout import WORK
from flcav.dataset.recording.recorder import drop_unbegun, record
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.locks import only_writer
from flcav.sensors.frame import Frame
from flcav.sources.source import Source
from flcav.world.trace import Trace


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
    what the files do not have, and on what in them contradicts itself. Raises `InputError` where `folder` is missing,
    of another format or damaged, and as `record` does; scenes that were complete by then stay in `out`, and the same
    call goes on from there.

    Args:
        name: a name of `IMPORTS`, or a user's own format as `module:NAME`.
        folder: folder of that format, as it is distributed.
        out: new or empty folder for the dataset.
        split: split whose scenes are taken; None: all.
        posed: what gives the frames other poses, such as `flcav.fusion.registration.DrivenSource`.
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
            checked = _Checked(posed(source))
            record(checked, out, progress=progress)
        except (ValueError, OSError) as error:
            if not begun:
                drop_unbegun(out)
            if isinstance(error, InputError | OSError):
                raise
            raise InputError(f"{folder}: cannot be imported ({error})") from None  # names that a dataset cannot hold
    return (*source.notes, *checked.problems())


@dataclass(frozen=True)
class _Checked:
    """A source whose poses and boxes are checked as its frames are recorded."""

    source: Source
    boxes: EmptyBoxes = field(default_factory=EmptyBoxes)
    strays: list[str] = field(default_factory=list)  # sentences on poses, one for each

    def problems(self) -> Iterator[str]:
        """Yield sentences on what contradicts itself in the frames so far."""
        if self.strays:
            more = f" (and {len(self.strays) - 1} more)" if len(self.strays) > 1 else ""
            yield f"{self.strays[0]}{more}"
        yield from self.boxes.problems()

    def describe(self) -> Mapping[str, Json]:
        return self.source.describe()

    def scenes(self) -> Sequence[str]:
        return self.source.scenes()

    def frame_count(self, scene: str) -> int:
        return self.source.frame_count(scene)

    def frames(self, scene: str) -> Iterator[Frame]:
        for frame in self.source.frames(scene):
            yield frame
            self.boxes.add(frame)
            self.strays.extend(check_triggers(frame))

    def trace(self, scene: str) -> Trace | None:
        return self.source.trace(scene)


def _shows(folder: Path, signs: tuple[str, ...]) -> bool:
    return any(next(folder.glob(sign), None) is not None for sign in signs)

"""Import of datasets in other formats, which are read as a source of frames and recorded; and export to a folder."""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flcav.arrays import Array32
from flcav.config import InputError, Json
from flcav.dataset.formats.formats import IMPORTS, export_format, import_format
from flcav.dataset.formats.mounting import find_other_frame
from flcav.dataset.formats.reading import LogSource
from flcav.dataset.formats.rig import UNSTATED, StatedLidar
from flcav.dataset.formats.writing import Exported, ExportOptions
from flcav.dataset.frame_checks import check_triggers
from flcav.dataset.ground import POLE
from flcav.dataset.layout import WORK
from flcav.dataset.recording.recorder import drop_unbegun, record
from flcav.dataset.scene_checks import EmptyBoxes, SharedPoints
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.locks import LOCK, only_writer
from flcav.sensors.frame import Frame
from flcav.sources.source import Source
from flcav.storage.files import flush_tree
from flcav.world.trace import Trace

LOOKED = 10  # sweeps whose ground is looked for


def import_dataset(
    name: str,
    folder: Path,
    out: Path,
    *,
    split: str | None = None,
    posed: Callable[[LogSource], Source] = lambda source: source,
    lidar: StatedLidar = UNSTATED,
    progress: Report = ignore_progress,
) -> tuple[str, ...]:
    """Record the dataset of the format `name` in `folder` as one of flcav's in `out`.

    Points and pictures whose encoding is one of flcav's are linked to, others are rewritten. Returns sentences on what
    the files lack and where they contradict themselves. Raises `InputError` where `folder` is missing, of another
    format or damaged, and as `record` does; scenes that were complete by then stay in `out`, and the same call resumes
    from there. Also where labels and points are not in one frame, or points not in metres, x ahead, y left, z up; then
    nothing stays.

    Args:
        name: a name in `IMPORTS`, or a user's format as `module:NAME`.
        folder: folder of that format, as it is distributed.
        out: new or empty folder for the dataset.
        split: split whose scenes are taken; None: all.
        posed: function that gives the frames other poses, such as `flcav.fusion.registration.DrivenSource`.
        lidar: height and beams of the LiDAR, for formats that do not say them; by default as the sweeps show.
        progress: callback for the frames recorded so far and in total.
    """
    chosen = import_format(name)
    if lidar != UNSTATED and not chosen.takes_lidar:
        raise InputError(f"format '{name}': has no use for --lidar-height and --beams: its files say them")
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is a file, and a folder is wanted' if folder.exists() else 'no such folder'}")
    if chosen.signs and not _shows(folder, chosen.signs):
        for other in IMPORTS:
            if _shows(folder, import_format(other).signs):
                raise InputError(f"{folder}: is no folder of '{name}' but of '{other}'")
    with only_writer(out):
        begun = (out / WORK).exists()  # by an earlier call
        source: LogSource | None = None
        try:
            source = chosen.read(folder, split, lidar) if chosen.takes_lidar else chosen.read(folder, split)
            checked = _Checked(posed(source), folder)
            record(checked, out, progress=progress)
        except (ValueError, OSError) as error:
            if not begun:
                drop_unbegun(out, whole=isinstance(error, _OtherFrame))
            if isinstance(error, _OtherFrame) and source is not None:
                raise InputError("; ".join((str(error), *source.contradictions))) from None
            if isinstance(error, InputError | OSError):
                raise
            raise InputError(f"{folder}: cannot be imported ({error})") from None  # names that a dataset cannot hold
    return (*source.notes, *checked.problems())


class _OtherFrame(InputError):
    """Labels or points of another frame, in all of a folder."""


@dataclass(frozen=True)
class _Checked:
    """A source whose poses, boxes and points are checked as its frames are recorded."""

    source: Source
    folder: Path
    boxes: EmptyBoxes = field(default_factory=EmptyBoxes)
    shared: SharedPoints = field(default_factory=SharedPoints)
    sweeps: list[Array32] = field(default_factory=list)  # some of vehicles', (N, 3) x ahead, y left, z up [m]
    strays: list[str] = field(default_factory=list)  # a sentence per inconsistent pose

    def problems(self) -> Iterator[str]:
        """Yield sentences on the contradictions found in the frames so far."""
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
            self.shared.add(frame)
            self.strays.extend(check_triggers(frame))
            if not frame.agent.startswith(POLE) and len(self.sweeps) < LOOKED:
                self.sweeps.extend(  # as in the vehicle's axes, about the LiDAR
                    cloud[:, :3] @ frame.agent_from_sensor[name][:3, :3].T.astype(np.float32)
                    for name, cloud in frame.lidar.items()
                )
        if scene == self.source.scenes()[-1]:
            self._check_frames()

    def _check_frames(self) -> None:
        """Raise `InputError` where points are in another frame than the calibration says, or labels than the points."""
        try:
            if other := find_other_frame(self.sweeps, placed=True):
                raise InputError(f"{self.folder}: {other}")
            self.boxes.refuse(self.folder)
            self.shared.refuse(self.folder)
        except InputError as error:
            raise _OtherFrame(str(error)) from None

    def trace(self, scene: str) -> Trace | None:
        return self.source.trace(scene)


def _shows(folder: Path, signs: tuple[str, ...]) -> bool:
    return any(next(folder.glob(sign), None) is not None for sign in signs)


DEFAULTS = ExportOptions()


def export(
    dataset: Dataset, name: str, out: Path, options: ExportOptions = DEFAULTS, *, progress: Report = ignore_progress
) -> Exported:
    """Write `dataset` in the format `name` to the new or empty folder `out`; return counts.

    Raises `InputError` for an unknown format, an option that is set but does not apply to the format, a folder that is
    not empty, and a dataset that lacks what the format needs. No partial output is left after a failure.

    Args:
        dataset: the dataset.
        name: a name in `EXPORTS`, or a user's format as `module:NAME`.
        out: new or empty folder.
        options: options for the format.
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
    """Yield a hidden folder next to `path` to write into; rename it to `path` on success, remove it on failure.

    Raises `InputError` where `path` is a file or a folder that is not empty.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; an export needs a folder")
    if path.is_dir() and any(entry.name != LOCK for entry in path.iterdir()):
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

"""Import of datasets of other formats, by reading them as a source of frames and recording that."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from flcav.config import InputError
from flcav.dataset.formats.argoverse2.read import Argoverse2Source
from flcav.dataset.formats.kitti.read import KittiSource
from flcav.dataset.formats.nuscenes.read import NuscenesSource
from flcav.dataset.formats.opv2v.read import Opv2vSource
from flcav.dataset.formats.reading import LogSource
from flcav.dataset.layout import WORK
from flcav.dataset.recording.recorder import drop_unbegun, record
from flcav.interface.progress import Report, ignore_progress
from flcav.machine.locks import only_writer


class Readable(NamedTuple):
    """A format that can be imported: how to open a folder of it, and the files that tell it from others."""

    read: Callable[[Path, str | None], LogSource]  # folder, split (None: all)
    signs: tuple[str, ...]  # patterns of paths, of which a folder of this format has one


READABLE: Mapping[str, Readable] = {
    "kitti": Readable(KittiSource, ("training/velodyne", "testing/velodyne")),
    "nuscenes": Readable(NuscenesSource, ("v1.0-*/sample.json", "sample.json", "samples/LIDAR_TOP")),
    "argoverse2": Readable(Argoverse2Source, ("sensors/lidar", "*/sensors/lidar", "*/*/sensors/lidar")),
    "opv2v": Readable(Opv2vSource, ("data_protocol.yaml", "*/data_protocol.yaml", "*/*/data_protocol.yaml")),
}


def import_dataset(
    name: str, folder: Path, out: Path, *, split: str | None = None, progress: Report = ignore_progress
) -> tuple[str, ...]:
    """Record the dataset of the format `name`, one of READABLE, in `folder` as one of flcav's in `out`.

    Points and pictures that are in an encoding of flcav's are linked to, others are rewritten. Only the scenes of
    `split` are taken, all for None. Returns sentences on what the files do not have. Raises `InputError` where `folder`
    is missing, of another format or damaged, and as `record` does; scenes that were complete by then stay in `out`, and
    the same call goes on from there.
    """
    if name not in READABLE:
        raise InputError(f"format '{name}': cannot be imported; known formats: {', '.join(READABLE)}")
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is a file, and a folder is wanted' if folder.exists() else 'no such folder'}")
    shown = [each for each in READABLE if _shows(folder, each)]
    if shown and name not in shown:
        raise InputError(f"{folder}: is no folder of '{name}' but of '{shown[0]}'")
    with only_writer(out):
        begun = (out / WORK).exists()  # by an earlier call
        try:
            source = READABLE[name].read(folder, split)
            record(source, out, progress=progress)
        except (ValueError, OSError) as error:
            if not begun:
                drop_unbegun(out)
            if isinstance(error, InputError | OSError):
                raise
            raise InputError(f"{folder}: cannot be imported ({error})") from None  # names that a dataset cannot hold
    return source.notes


def _shows(folder: Path, name: str) -> bool:
    return any(next(folder.glob(sign), None) is not None for sign in READABLE[name].signs)

"""Mending of a dataset: the parts of which a file is missing or of another size are recorded anew.

Sizes are compared, not contents, for that takes as long as reading the dataset: `flcav validate` does. Tables are
compared by hash. What is put in place has the hash that was recorded.
"""

import shutil
from collections import defaultdict
from collections.abc import Callable, Collection
from pathlib import Path, PurePosixPath

from flcav.config import InputError, path_within
from flcav.dataset.layout import TOWN, WORK, navigation_path, read_manifest, table_path, town_path, trace_path
from flcav.dataset.recording.jobs import LOGS, PAYLOADS, TRAFFIC, split_scene
from flcav.dataset.tables import list_files, read_table
from flcav.sources.source import Source, TownSource
from flcav.storage.files import flush_all, sha256, write_bytes


def find_damage(out: Path) -> set[str]:
    """Return the files of the dataset in `out`, all but its tables, that are missing or of another size."""
    manifest = read_manifest(out)
    listed = list_files(out, manifest)
    kept = {name: size for name, (size, _) in listed.items() if name not in manifest.tables}
    return {name for name, size in kept.items() if _size(path_within(out, name, out)) != size}


def has_damaged_table(out: Path) -> bool:
    """Return whether a table of the dataset in `out` is missing or altered."""
    tables = read_manifest(out).tables
    return any(_size(out / name) != own.bytes or sha256(out / name) != own.sha256 for name, own in tables.items())


def mend(source: Source, out: Path, damaged: Collection[str], record: Callable[[], None]) -> None:
    """Put the files `damaged` of the dataset in `out` in place again.

    `record` performs the remaining jobs of the source below `.recording`; these are the parts that have a damaged file.
    Raises `InputError` for a file that is not recorded as it was, by other versions of packages.
    """
    work, listed = out / WORK, list_files(out, read_manifest(out))
    shutil.rmtree(work, ignore_errors=True)
    made = _make_parts(source, out, damaged, record)
    if isinstance(source, TownSource):
        folder = town_path(str(source.describe()["town"]))
        for name, data in source.town_files().items() if any(name.startswith(f"{TOWN}/") for name in damaged) else ():
            made[f"{folder}/{name}"] = work / TOWN / name
            write_bytes(work / TOWN / name, data)
    for name in damaged:
        if name not in made or sha256(made[name]) != listed[name][1]:
            raise InputError(f"{out / name}: damaged, and not recorded as it was; remove {out} to record it anew")
    for name in damaged:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        made[name].replace(out / name)
    flush_all({(out / name).parent for name in damaged})
    shutil.rmtree(work)


def _make_parts(source: Source, out: Path, damaged: Collection[str], record: Callable[[], None]) -> dict[str, Path]:
    """Record the parts that have a damaged file; return the new files by their names in the dataset."""
    frames = read_table(out / table_path("frames"), "frames").to_pydict()
    keys: dict[str, list[str]] = defaultdict(list)
    for scene, key in zip(frames["scene"], frames["key"]):
        keys[scene].append(key)
    names = [PurePosixPath(name).name for name in damaged]
    touched = {name[:end] for name in names for end, letter in enumerate(name) if letter == "."}
    parts = [part for scene in source.scenes() for part in split_scene(source, scene)]
    for part in parts:
        whole = len(keys[part.scene]) == source.frame_count(part.scene)  # else no frame's part is known, as of windows
        own = keys[part.scene][part.first : part.first + part.frames] if whole else keys[part.scene]
        moving = {trace_path(part.scene), navigation_path(part.scene)}
        if touched.isdisjoint(own) and (part.number or moving.isdisjoint(damaged)):
            part.folder(out / WORK).mkdir(parents=True)  # as if it were recorded
    (out / WORK).mkdir(exist_ok=True)
    record()
    made = {trace_path(scene): out / WORK / scene / TRAFFIC for scene in keys}
    made |= {navigation_path(scene): out / WORK / scene / LOGS for scene in keys}
    made = {name: path for name, path in made.items() if path.exists()}
    folders = [part.folder(out / WORK) / PAYLOADS for part in parts]
    return made | {name: folder / name for name in damaged for folder in folders if (folder / name).exists()}


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None

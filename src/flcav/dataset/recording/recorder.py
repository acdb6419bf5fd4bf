"""Resumable recording of a source into a dataset folder, with the same bytes for any engine and number of workers.

Parts of scenes are first written below the hidden folder `.recording`. When all are complete, their files are moved
into the dataset, their tables are concatenated, and the manifest is written last. An interruption at any point loses
only the parts in progress. A part is on disk before it counts as complete, and all parts before the manifest.

A finished dataset with missing or damaged files is mended: the parts to which they belong are recorded again.
"""

import json
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flcav.config import InputError, Json, path_within, read_json
from flcav.dataset.layout import (
    CALIBRATION,
    FILES,
    FORMAT,
    LEVEL_FORMAT,
    MANIFEST,
    TOWN,
    WORK,
    navigation_path,
    package_versions,
    read_manifest,
    table_path,
    town_path,
    trace_path,
)
from flcav.dataset.recording.jobs import (
    HEADER,
    JOINED,
    LOGS,
    PAYLOADS,
    TRAFFIC,
    check_scenes,
    find_pending,
    record_scenes,
    split_scene,
    start_actors,
    start_processes,
)
from flcav.dataset.tables import FILES_SCHEMA, SCHEMAS, TILTS, join_tables, list_files, read_table, write_rows
from flcav.interface.notebook import resumable
from flcav.interface.progress import DAMAGED, Report, print_progress
from flcav.machine.locks import LOCK, only_writer
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import CarlaRecipe, Recipe, load_recipe
from flcav.sources.source import Isolated, Source, TownSource
from flcav.storage.files import flush_all, sha256, write_bytes, write_json

Header = Mapping[str, Mapping[str, Json]]  # "recipe" -> description of the source, "versions" -> of packages

ENGINES = {"processes": start_processes, "ray": start_actors}


@resumable
def record(
    source: Source | Recipe | Path | str,
    out: Path | str,
    *,
    jobs: int = 1,
    engine: str = "processes",
    progress: Report = print_progress,
) -> bool:
    """Record a source, or the built-in simulator with a recipe or a recipe's YAML file, into the folder `out`.

    Returns True if anything was recorded, False if `out` already held this very dataset. An interrupted recording of
    the same source is resumed. A dataset in which files are missing or have another size, or tables another checksum,
    is mended, see `mend`. Raises `InputError` where `out` holds anything else, is being written by another process or
    cannot be mended, or where `jobs`, `engine` or the recipe is wrong; ValueError where the name of a scene is unsafe
    as a folder, before anything is touched; OSError where `out` cannot be written.

    Args:
        source: source of frames, recipe of the built-in simulator, or its YAML file.
        out: folder of the dataset; new, empty, or with a recording of the same source.
        jobs: number of workers.
        engine: kind of workers, one of `ENGINES`: processes of this machine, or actors of a Ray cluster.
        progress: callback for the frames recorded so far and in total.

    >>> from flcav import Recipe, record
    >>> recipe = Recipe(town="ring", cavs=1, spins_per_scene=1, warmup_s=5.0)
    >>> record(recipe, "ring"), record(recipe, "ring")
    (True, False)
    """
    if jobs < 1:
        raise InputError(f"jobs = {jobs}: must be at least 1")
    if engine not in ENGINES:
        raise InputError(f"engine '{engine}': unknown; known engines: {', '.join(ENGINES)}")
    if isinstance(source, Path | str):
        source = load_recipe(source)
    if isinstance(source, Recipe):
        source = open_source(source)
    if isinstance(source, Isolated) and (jobs, engine) != (1, "processes"):
        raise InputError(f"jobs = {jobs}, engine '{engine}': this source has one world, which one process records")
    out = Path(out)
    check_scenes(source.scenes())
    header: Header = json.loads(json.dumps({"recipe": source.describe(), "versions": package_versions()}))
    try:
        with only_writer(out):
            write = partial(_write, source, out / WORK, jobs, engine, progress)
            if begun := _claim(out, header):
                try:
                    write()
                except InputError:
                    drop_unbegun(out)
                    raise
                _assemble(source, out, header)
            if damaged := find_damaged_files(out):
                more = f" (and {len(damaged) - 1} more)" if len(damaged) > 1 else ""
                progress(0, 1, f"{out / min(damaged)} {DAMAGED}{more}, recorded anew")
                mend(source, out, damaged, write)
    except OSError as error:
        if error.strerror and error.filename is None:  # errors of writes have no file name
            error.filename = str(out)
        raise
    return begun or bool(damaged)


def drop_unbegun(out: Path, *, whole: bool = False) -> None:
    """Remove what a failed recording left in `out` where no part was completed; otherwise it can be resumed.

    With `whole`, completed parts are removed, too.
    """
    work = out / WORK
    if work.is_dir() and (whole or not any(p.is_dir() and p.suffix != ".part" for p in work.glob("*/*"))):
        shutil.rmtree(work)
        if not any(out.iterdir()):
            out.rmdir()


def _write(source: Source, work: Path, jobs: int, engine: str, progress: Report) -> None:
    """Record all remaining parts below `.recording`."""
    total = sum(source.frame_count(scene) for scene in source.scenes())
    missing = sum(part.frames for scene in source.scenes() for part in find_pending(source, scene, work))
    start = time.perf_counter()

    def wrote(count: int) -> None:
        rate = count / max(time.perf_counter() - start, 1e-9)
        progress(total - missing + count, total, f"{rate:.1f} frames/s")

    with ENGINES[engine](source, work, jobs, wrote) as workers:
        record_scenes(source, workers, work)


def _claim(out: Path, header: Header) -> bool:
    """Prepare `out` for this recording; return False if it already holds the finished dataset, with intact tables.

    A dataset with a damaged table counts as a recording that has just begun. Raises `InputError` where `out` is a file,
    or holds another dataset, another recording or other files.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; a dataset needs a folder")
    if (out / MANIFEST).exists():
        _refuse_other(out, "holds another dataset", {"recipe": read_manifest(out).recipe}, header)
        shutil.rmtree(out / WORK, ignore_errors=True)
        if not has_damaged_table(out):
            return False
        write_json(out / WORK / HEADER, header)
        (out / MANIFEST).unlink()
        return True
    begun = out / WORK / HEADER
    if begun.exists():
        _refuse_other(out, "holds the unfinished recording of another", _read_header(begun), header)
    elif out.exists() and any(path.name not in (WORK, LOCK) for path in out.iterdir()):
        raise InputError(f"{out}: holds other files; record into a new or empty folder")
    else:
        write_json(begun, header)
    return True


def _read_header(path: Path) -> Header:
    held: Any = read_json(path)
    if not isinstance(held, dict) or not all(isinstance(part, dict) for part in held.values()):
        raise InputError(f"{path}: not the recipe of a recording; remove {path.parent} to begin anew")
    return held


def _refuse_other(out: Path, what: str, held: Header, wanted: Header) -> None:
    different = [
        name
        for part in held
        for name in sorted(held[part].keys() | wanted[part].keys())
        if held[part].get(name) != wanted[part].get(name)
    ]
    if different:
        raise InputError(f"{out}: {what} (different: {', '.join(different)}); record into another folder")


def _assemble(source: Source, out: Path, header: Header) -> None:
    """Assemble the dataset from the parts below `.recording`; this can be repeated after an interruption."""
    work = out / WORK
    scenes = list(source.scenes())
    joined = work / JOINED
    joined.mkdir(exist_ok=True)
    folders = [part.folder(work) for scene in scenes for part in split_scene(source, scene)]
    listings = [work / table_path(FILES)] if _write_town(source, work, out) else []
    listings += [listing for scene in scenes if (listing := _move_traffic(work / scene, scene, out))]
    moved: set[str] = set()
    for folder in folders:
        listings.append(folder / table_path(FILES))
        for name in pq.ParquetFile(listings[-1]).read()["path"].to_pylist():
            if name in moved:
                raise ValueError(f"{name}: a file of two frames")
            moved.add(name)
            if (folder / PAYLOADS / name).exists():
                _move(folder / PAYLOADS / name, out / name)

    join_tables(listings, FILES_SCHEMA, joined / table_path(FILES))
    rows = {
        name: join_tables([folder / table_path(name) for folder in folders], schema, joined / table_path(name))
        for name, schema in SCHEMAS.items()
    }
    write_json(joined / CALIBRATION, _calibrations(folders))
    if not rows[TILTS]:
        (joined / table_path(TILTS)).unlink()
    held = [name for name in (*SCHEMAS, FILES) if rows.get(name, 1) or name != TILTS]
    names = (CALIBRATION, *map(table_path, held))
    manifest = {
        "format": FORMAT if rows[TILTS] else LEVEL_FORMAT,
        **header,
        "scenes": scenes,
        "counts": {
            "scenes": len(scenes),
            "frames": rows["frames"],
            "annotations": rows["annotations"],
            "points": int(_values(joined / table_path("frames"), "points").to_numpy().sum()),
            "images": len(_values(joined / table_path("frames"), "cameras")),
            "payload_bytes": int(_values(joined / table_path(FILES), "bytes").to_numpy().sum()),
        },
        "tables": {name: {"bytes": (joined / name).stat().st_size, "sha256": sha256(joined / name)} for name in names},
    }
    for name in names:
        _move(joined / name, out / name)
    flush_all([*(out / name for name in names), out, *(path for path in out.iterdir() if path.is_dir())])
    write_json(work / MANIFEST, manifest)
    _move(work / MANIFEST, out / MANIFEST)
    flush_all([out])
    shutil.rmtree(work)


def _write_town(source: Source, work: Path, out: Path) -> bool:
    """Write the source's town files and their listing; return whether it has any."""
    files = source.town_files() if isinstance(source, TownSource) else {}
    if not files:
        return False
    folder = town_path(str(source.describe()["town"]))
    for name, data in files.items():
        write_bytes(out / folder / name, data)
    _list({f"{folder}/{name}": out / folder / name for name in files}, work)
    return True


def _list(files: Mapping[str, Path], folder: Path) -> None:
    """Write the listing of `files`, which maps paths in the dataset to files, into `folder`."""
    rows = [(name, path.stat().st_size, sha256(path)) for name, path in files.items()]
    write_rows(pa.table(dict(zip(FILES_SCHEMA.names, zip(*rows))), schema=FILES_SCHEMA), folder / table_path(FILES))


def _move_traffic(folder: Path, scene: str, out: Path) -> Path | None:
    """Move the traffic of a scene, and its navigation logs, into the dataset; return the file of their listing.

    Returns None where there is no traffic.
    """
    traffic = folder / TRAFFIC
    listing = folder / table_path(FILES)
    if traffic.exists():
        made = {trace_path(scene): traffic, navigation_path(scene): folder / LOGS}
        held = {name: path if path.exists() else out / name for name, path in made.items()}  # else moved earlier
        _list({name: path for name, path in held.items() if path.exists()}, folder)
        for name in reversed(made):  # the traffic last: its move marks the scene as done
            if made[name].exists():
                _move(made[name], out / name)
    return listing if listing.exists() else None


def _calibrations(folders: list[Path]) -> dict[str, Json]:
    """Return the content of the calibration file, the union over all parts; raises ValueError where parts differ."""
    calibrations: dict[str, Json] = {}
    for folder in folders:
        for agent, calibration in json.loads((folder / CALIBRATION).read_text()).items():
            if calibrations.setdefault(agent, calibration) != calibration:
                raise ValueError(f"{folder.parent.name}: {agent} is calibrated otherwise than in another scene")
    return calibrations


def _values(path: Path, column: str) -> pa.Array:
    """Return the values of a column of a Parquet file, for a column of lists their concatenated elements."""
    values = pq.ParquetFile(path).read(columns=[column])[column].combine_chunks()
    return values.flatten() if isinstance(values, pa.ListArray) else values


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    source.replace(target)


def open_source(recipe: Recipe, beside: Path | None = None) -> Source:
    """Return the source of a recipe's frames; `beside` is the recipe's folder, to which a town's path may be relative.

    Raises `InputError` where the recipe and its town do not match, and where CARLA's client is not installed.
    """
    if isinstance(recipe, CarlaRecipe):
        from flcav.carla.recording.source import CarlaSource  # CARLA's client is an optional dependency

        return CarlaSource(recipe, beside)
    return EmbeddedSource(recipe, beside)


def find_damaged_files(out: Path) -> set[str]:
    """Return the files of the dataset in `out`, without its tables, that are missing or of another size."""
    manifest = read_manifest(out)
    listed = list_files(out, manifest)
    kept = {name: size for name, (size, _) in listed.items() if name not in manifest.tables}
    return {name for name, size in kept.items() if _size(path_within(out, name, out)) != size}


def has_damaged_table(out: Path) -> bool:
    """Return whether a table of the dataset in `out` is missing or altered."""
    tables = read_manifest(out).tables
    return any(_size(out / name) != table.bytes or sha256(out / name) != table.sha256 for name, table in tables.items())


def mend(source: Source, out: Path, damaged: Collection[str], record: Callable[[], None]) -> None:
    """Restore the `damaged` files of the dataset in `out`.

    `record` performs the remaining jobs of the source below `.recording`: those of the parts that have a damaged file.
    Raises `InputError` for a file that cannot be recorded identically, because package versions differ.
    """
    work = out / WORK
    listed = list_files(out, read_manifest(out))
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
    """Record the parts that have a damaged file; return the new files by their path in the dataset."""
    frames = read_table(out / table_path("frames"), "frames").to_pydict()
    keys: dict[str, list[str]] = defaultdict(list)
    for scene, key in zip(frames["scene"], frames["key"]):
        keys[scene].append(key)
    names = [PurePosixPath(name).name for name in damaged]
    touched = {name[:end] for name in names for end, letter in enumerate(name) if letter == "."}
    parts = [part for scene in source.scenes() for part in split_scene(source, scene)]
    for part in parts:
        whole = len(keys[part.scene]) == source.frame_count(part.scene)  # else frames can't be assigned to parts
        part_keys = keys[part.scene][part.first : part.first + part.frames] if whole else keys[part.scene]
        moving = {trace_path(part.scene), navigation_path(part.scene)}
        if touched.isdisjoint(part_keys) and (part.number or moving.isdisjoint(damaged)):
            part.folder(out / WORK).mkdir(parents=True)  # counts as recorded, so that it is skipped
    (out / WORK).mkdir(exist_ok=True)
    record()
    made = {trace_path(scene): out / WORK / scene / TRAFFIC for scene in keys}
    made |= {navigation_path(scene): out / WORK / scene / LOGS for scene in keys}
    made = {name: path for name, path in made.items() if path.exists()}
    folders = [part.folder(out / WORK) / PAYLOADS for part in parts]
    return made | {name: folder / name for name in damaged for folder in folders if (folder / name).exists()}


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None

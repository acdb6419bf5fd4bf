"""Any source to a dataset folder: resumable, and the same bytes whatever the number of jobs.

Everything is first written below the hidden `.recording`: a scene appears there when it is whole. When all have, their
files move into the folder, their tables are joined, and the manifest comes last. An interruption at any point costs
the scenes that were under way.
"""

import json
import shutil
import time
from pathlib import Path
from typing import Any

import pyarrow as pa

from flcav.config import InputError
from flcav.dataset.layout import (
    CALIBRATION,
    FORMAT,
    MANIFEST,
    WORK,
    package_versions,
    read_manifest,
    table_path,
)
from flcav.dataset.scenes import FILES
from flcav.dataset.tables import SCHEMAS, read_table, write_table
from flcav.dataset.workers import write_scenes
from flcav.files import sha256, write_json
from flcav.progress import Report, silent
from flcav.sources.source import Source

HEADER = "recipe.json"


def record(source: Source, out: Path, *, jobs: int = 1, progress: Report = silent) -> bool:
    """Record `source` into the folder `out`; returns whether there was anything to do.

    False says that `out` already held this very dataset. A folder whose recording was interrupted is finished.
    Raises `InputError` where `out` holds anything else, `OSError` where it cannot be written.
    """
    if jobs < 1:
        raise InputError(f"jobs = {jobs}: must be at least 1")
    header = json.loads(json.dumps({"recipe": source.describe(), "versions": package_versions()}))
    try:
        if not _claim(out, header):
            return False
        _write(source, out, jobs, progress)
        _assemble(out, list(source.scenes()), header)
    except OSError as error:
        if error.strerror and error.filename is None:  # a write does not know its file
            error.filename = str(out)
        raise
    return True


def _write(source: Source, out: Path, jobs: int, progress: Report) -> None:
    """Write the scenes that are not there yet below `.recording`."""
    work = out / WORK
    counts = {scene: source.frame_count(scene) for scene in source.scenes()}
    pending = [scene for scene in counts if not (work / scene).is_dir()]
    total = sum(counts.values())
    kept = total - sum(counts[scene] for scene in pending)
    start = time.perf_counter()

    def wrote(count: int) -> None:
        rate = count / (time.perf_counter() - start)
        progress(kept + count, total, f"{rate:.1f} frames/s")

    write_scenes(source, pending, work, jobs, wrote)


def _claim(out: Path, header: dict[str, Any]) -> bool:
    """Make `out` the folder of this recording; False where it is finished already."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; a dataset needs a folder")
    if (out / MANIFEST).exists():
        _refuse_other(out, "holds another dataset", {"recipe": read_manifest(out)["recipe"]}, header)
        shutil.rmtree(out / WORK, ignore_errors=True)
        return False
    begun = out / WORK / HEADER
    if begun.exists():
        _refuse_other(out, "holds the unfinished recording of another", json.loads(begun.read_text()), header)
    elif out.exists() and any(path.name != WORK for path in out.iterdir()):
        raise InputError(f"{out}: holds other files; record into a new or empty folder")
    else:
        write_json(begun, header)
    return True


def _refuse_other(out: Path, what: str, held: dict[str, Any], wanted: dict[str, Any]) -> None:
    different = [
        name
        for part in held
        for name in sorted(held[part].keys() | wanted[part].keys())
        if held[part].get(name) != wanted[part].get(name)
    ]
    if different:
        raise InputError(f"{out}: {what} (different: {', '.join(different)}); record into another folder")


def _assemble(out: Path, scenes: list[str], header: dict[str, Any]) -> None:
    """Make the dataset of the scenes below `.recording`; may be repeated after an interruption."""
    work = out / WORK
    files: dict[str, dict[str, Any]] = {}
    calibration: dict[str, Any] = {}
    for scene in scenes:
        part = work / scene
        listing = json.loads((part / f"{FILES}.json").read_text())
        for name in listing:
            if (part / FILES / name).exists():
                _move(part / FILES / name, out / name)
        files |= listing
        for agent, mounts in json.loads((part / CALIBRATION).read_text()).items():
            if calibration.setdefault(agent, mounts) != mounts:
                raise ValueError(f"{scene}: the sensors of {agent} are mounted otherwise than in another scene")

    tables = {
        name: pa.concat_tables([read_table(work / scene / table_path(name), name) for scene in scenes])
        for name in SCHEMAS
    }
    for name, table in tables.items():
        write_table(table, work / table_path(name))
    write_json(work / CALIBRATION, calibration)
    for name in (CALIBRATION, *map(table_path, SCHEMAS)):
        path = work / name
        files[name] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
        _move(path, out / name)

    points = tables["frames"]["points"].combine_chunks().values
    manifest = {
        "format": FORMAT,
        **header,
        "scenes": scenes,
        "counts": {
            "scenes": len(scenes),
            "frames": len(tables["frames"]),
            "annotations": len(tables["annotations"]),
            "points": sum(points.to_pylist()),
        },
        "files": files,
    }
    write_json(work / MANIFEST, manifest)
    _move(work / MANIFEST, out / MANIFEST)
    shutil.rmtree(work)


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    source.replace(target)

"""Every check of one dataset folder: its files against the manifest, then what they hold."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from flcav.config import InputError
from flcav.dataset.frame_checks import check_points, check_traffic, check_values
from flcav.dataset.layout import MANIFEST, FrameKey, points_path, read_manifest, trace_path
from flcav.dataset.store import Dataset
from flcav.files import sha256
from flcav.progress import Report, silent
from flcav.world.trace import Trace


def validate(path: Path | str, *, progress: Report = silent) -> list[str]:
    """Return the problems of the dataset in the folder `path`, one sentence each; none is the good case.

    Raises `InputError` where there is no finished dataset at all.
    """
    folder = Path(path)
    manifest = read_manifest(folder)
    damaged = {name: problem for name, entry in manifest["files"].items() if (problem := _damage(folder, name, entry))}
    problems = [f"{folder / name}: {problem}" for name, problem in damaged.items()]
    problems += _extra_files(folder, manifest)
    try:
        dataset = Dataset.open(folder)
    except InputError as error:
        return [*problems, str(error)]
    problems += check_order(dataset.keys)
    problems += _other_counts(dataset)

    traces: dict[str, Trace | None] = {}
    for i, key in enumerate(dataset.keys):
        if key.scene not in traces:
            traces = {key.scene: _trace(dataset, key.scene, damaged)}
        try:
            frame = dataset.frame(i)
        except InputError as error:
            if not damaged.keys() & {points_path(name, dataset.name(i)) for name in dataset.lidars(i)}:
                problems.append(str(error))
            continue
        trace = traces[key.scene]
        problems += check_values(frame)
        problems += check_points(frame)
        problems += [] if trace is None else check_traffic(frame, trace)
        progress(i + 1, len(dataset), "")
    return problems


def check_order(keys: Sequence[FrameKey]) -> list[str]:
    """Return where time does not run: forward from spin to spin, one time per spin, each agent once in each."""
    problems = []
    agents: dict[tuple[str, int], set[str]] = defaultdict(set)
    last: dict[str, FrameKey] = {}
    for key in keys:
        name = f"scene '{key.scene}', spin {key.index}, {key.agent}"
        before = last.get(key.scene, key)
        if key.index < before.index or key.time_s < before.time_s:
            problems.append(f"{name}: time runs backward, from {before.time_s} s at spin {before.index}")
        elif (key.index == before.index) != (key.time_s == before.time_s):
            problems.append(f"{name}: time {key.time_s} s does not go with {before.time_s} s at spin {before.index}")
        if key.agent in agents[key.scene, key.index]:
            problems.append(f"{name}: recorded more than once")
        agents[key.scene, key.index].add(key.agent)
        last[key.scene] = key
    return problems


def _damage(folder: Path, name: str, entry: dict[str, Any]) -> str | None:
    path = folder / name
    if not path.is_file():
        return "missing"
    size = path.stat().st_size
    if size != entry["bytes"]:
        return f"truncated or grown: {size} bytes, recorded were {entry['bytes']}"
    return None if sha256(path) == entry["sha256"] else "altered: its hash is not the recorded one"


def _extra_files(folder: Path, manifest: dict[str, Any]) -> Iterator[str]:
    known = {MANIFEST, *manifest["files"]}
    for path in sorted(folder.rglob("*")):
        if not path.is_dir() and path.relative_to(folder).as_posix() not in known:
            yield f"{path}: not part of the dataset"


def _other_counts(dataset: Dataset) -> Iterator[str]:
    scenes = list(dict.fromkeys(key.scene for key in dataset.keys))
    if scenes != dataset.manifest["scenes"]:
        yield f"{dataset.folder / MANIFEST}: its scenes are not those of the frames"
    if len(dataset) != dataset.manifest["counts"]["frames"]:
        yield f"{dataset.folder / MANIFEST}: counts {dataset.manifest['counts']['frames']} frames of {len(dataset)}"


def _trace(dataset: Dataset, scene: str, damaged: dict[str, str]) -> Trace | None:
    """Return a scene's traffic where there is any and it can be trusted."""
    name = trace_path(scene)
    if name in damaged or name not in dataset.manifest["files"]:
        return None
    return Trace.load(dataset.folder / name)

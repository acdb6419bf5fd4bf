"""Validation of a dataset folder, and leakage between datasets of different splits.

The files are checked against the manifest (size, checksum), then their contents by `frame_checks` and `scene_checks`.
"""

import os
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from flcav.config import InputError, parse_config, path_within
from flcav.dataset.frame_checks import (
    check_calibrations,
    check_images,
    check_measurements,
    check_points,
    check_sweeps,
    check_traffic,
    check_triggers,
    check_values,
)
from flcav.dataset.layout import MANIFEST, FrameKey, Manifest, navigation_path, read_manifest, trace_path
from flcav.dataset.scene_checks import BlockedViews, EmptyBoxes, check_motion, find_copies
from flcav.dataset.store import Dataset
from flcav.dataset.tables import list_files
from flcav.interface.progress import Report, print_progress
from flcav.interface.wording import make_printable, plural
from flcav.sensors.frame import Frame
from flcav.sensors.rig import CalibrationError
from flcav.storage.files import sha256
from flcav.world.trace import Trace


def validate(path: Path | str, *, progress: Report = print_progress) -> list[str]:
    """Return the problems of the dataset in the folder `path`, one sentence each; empty for a valid dataset.

    Raises `InputError` where `path` holds no finished dataset, or one whose recipe has a wrong `calibration_error`.

    >>> from flcav import validate
    >>> validate("data")
    []
    """
    folder = Path(path)
    manifest = read_manifest(folder)
    listed = list_files(folder, manifest)
    damaged = {name: problem for name, entry in listed.items() if (problem := _damage(folder, name, *entry))}
    problems = [f"{folder / make_printable(name)}: {problem}" for name, problem in damaged.items()]
    problems += _extra_files(folder, listed)
    try:
        dataset = Dataset.open(folder, checked=False)
    except InputError as error:
        return [*problems, str(error)]
    problems += check_order(dataset.keys)
    problems += find_leaks({str(folder): manifest}) + find_copies([folder])
    problems += _other_counts(dataset)
    stated = manifest.recipe.get("calibration_error") or {}
    error = parse_config(CalibrationError, stated, f"{folder / MANIFEST}: calibration_error of the recipe")
    problems += check_calibrations(dataset.calibrations, error)

    traces: dict[str, Trace | None] = {}
    sight, empty = BlockedViews(), EmptyBoxes()
    for i, key in enumerate(dataset.keys):
        if key.scene not in traces:
            trace = _trace(dataset, key.scene, damaged)
            traces = {key.scene: trace}
            problems += check_motion(key.scene, trace) if trace is not None else ()
        try:
            frame = dataset.frame(i)
            problems += _frame_problems(frame, traces[key.scene], imported=manifest.imported is not None)
            sight.add(frame)
            empty.add(frame)
        except InputError as error:  # a file that cannot be read
            if not any(str(error).startswith(str(folder / name)) for name in damaged):
                problems.append(str(error))
        progress(i + 1, len(dataset), "")
    problems += _log_problems(dataset, damaged)
    return [*problems, *sight.problems(), *empty.problems()]


def _log_problems(dataset: Dataset, damaged: Collection[str]) -> Iterator[str]:
    """Yield a sentence for each navigation log that cannot be read or does not cover its vehicle's frames."""
    for scene in dataset.manifest.scenes:
        if navigation_path(scene) in damaged:
            continue
        try:
            logs = dataset.navigation_logs(scene)
        except InputError as error:
            yield str(error)
            continue
        for agent, log in logs.items():
            times_s = np.array([dataset.keys[i].time_s for i in dataset.select(scenes=[scene], agents=[agent])])
            if not log.covers(times_s).all():
                yield (
                    f"{dataset.folder / navigation_path(scene)}: the log of '{agent}' goes from {log.begin_s:.1f} to "
                    f"{log.end_s:.1f} s, its frames from {times_s[0]:.1f} to {times_s[-1]:.1f} s"
                )


def _frame_problems(frame: Frame, trace: Trace | None, *, imported: bool) -> Iterator[str]:
    yield from check_values(frame, imported=imported)
    yield from check_triggers(frame)
    if not imported:  # KITTI has only the part of each spin that the camera sees
        yield from check_sweeps(frame)
    yield from check_points(frame, trace, imported=imported)
    yield from check_measurements(frame)
    yield from check_images(frame, imported=imported)
    if trace is not None:
        yield from check_traffic(frame, trace)


def check_order(keys: Sequence[FrameKey]) -> list[str]:
    """Return a sentence for each frame that is out of order.

    Within a scene spins and times increase together, and an agent has one frame per spin.
    """
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


def _damage(folder: Path, name: str, recorded_bytes: int, recorded_hash: str) -> str | None:
    try:
        path = path_within(folder, name, folder)
    except InputError:
        return "no name of a file within the dataset"
    if not os.path.isfile(path):  # noqa: PTH113 - False for a name that is too long for any file, too
        return "missing"
    size = path.stat().st_size
    if size != recorded_bytes:
        return f"truncated or grown: {size} bytes, recorded were {recorded_bytes}"
    return None if sha256(path) == recorded_hash else "altered: its hash is not the recorded one"


def _extra_files(folder: Path, listed: Collection[str]) -> Iterator[str]:
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_dir() and name != MANIFEST and name not in listed:
            yield f"{path}: not part of the dataset"


def _other_counts(dataset: Dataset) -> Iterator[str]:
    scenes = list(dict.fromkeys(key.scene for key in dataset.keys))
    if scenes != dataset.manifest.scenes:
        yield f"{dataset.folder / MANIFEST}: its scenes are not those of the frames"
    if len(dataset) != dataset.manifest.counts.frames:
        yield f"{dataset.folder / MANIFEST}: counts {plural(dataset.manifest.counts.frames, 'frame')} of {len(dataset)}"


def _trace(dataset: Dataset, scene: str, damaged: Collection[str]) -> Trace | None:
    """Return the traffic of a scene; None if it was not recorded or its file is among the `damaged`."""
    return None if trace_path(scene) in damaged else dataset.trace(scene)


def find_leaks(manifests: Mapping[str, Manifest]) -> list[str]:
    """Return a sentence for each pair of datasets of different splits that share traffic; `manifests` are by name.

    Frames of a scene show the same cars at the same places, so a scene belongs in one split. The same holds for a
    traffic seed of a town, which gives the same traffic in every recipe, and for an imported recording, identified by
    its folder's name. A sentence is also returned for each recording that is in several splits of one dataset.
    """
    repeated = [sentence for name, manifest in manifests.items() for sentence in _repeated(name, manifest)]
    return repeated + [sentence for pair in combinations(manifests.items(), 2) for sentence in _shared(*pair)]


def _recordings(manifest: Manifest) -> dict[str, list[str]]:
    """Return the scenes of a dataset by recording: the scene itself or, for an imported one, its folder's name."""
    folders = manifest.recipe.get("folders")
    recordings: dict[str, list[str]] = defaultdict(list)
    for scene in manifest.scenes:
        recordings[str(folders.get(scene, scene)) if isinstance(folders, Mapping) else scene].append(scene)
    return recordings


def _repeated(name: str, manifest: Manifest) -> Iterator[str]:
    split_of = manifest.split_of
    for recording, scenes in _recordings(manifest).items():
        if len(splits := {split_of.get(scene, "") for scene in scenes}) > 1:
            quoted = " and ".join(f"'{split}'" for split in sorted(splits))
            yield f"{name}: leakage, '{recording}' is in the splits {quoted}, as the scenes {', '.join(scenes)}"


def _shared(one: tuple[str, Manifest], other: tuple[str, Manifest]) -> Iterator[str]:
    (name, manifest), (other_name, other_manifest) = one, other
    recipe, other_recipe = manifest.recipe, other_manifest.recipe
    split, other_split = recipe.get("split"), other_recipe.get("split")
    if split == other_split:
        return
    where = f"{name} (split '{split}') and {other_name} (split '{other_split}')"
    scenes = sorted(_recordings(manifest).keys() & _recordings(other_manifest).keys())
    if scenes:
        yield f"{where}: leakage, they share {plural(len(scenes), 'scene')}, the first is '{scenes[0]}'"
    elif "seed" in recipe and (recipe.get("town"), recipe["seed"]) == (
        other_recipe.get("town"),
        other_recipe.get("seed"),
    ):
        yield f"{where}: leakage, they share the traffic seed {recipe.get('seed')} in '{recipe.get('town')}'"

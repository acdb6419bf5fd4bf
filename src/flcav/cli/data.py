"""`flcav record`, `validate`, `import` and `export`: datasets."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from flcav.cli.options import BEAMS, ENGINE, LIDAR_HEIGHT, OWN, EngineName, join_choices
from flcav.cli.terminal import echo, one_line, when_interrupted
from flcav.dataset.formats.formats import EXPORTS, IMPORTS, export_format
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from flcav.dataset.formats.writing import LeftOut


@when_interrupted()
def record(
    recipe: Path = typer.Argument(help="Recipe (YAML): town, traffic, vehicles, poles, sensors."),
    out: Path = typer.Option(..., "--out", help="Folder of the dataset; an interrupted recording goes on."),
    frames: int | None = typer.Option(None, "--frames", help="Record exactly this many frames instead."),
    seed: int | None = typer.Option(None, "--seed", help="Seed instead of the recipe's."),
    jobs: int = typer.Option(1, "--jobs", help="Workers; the dataset is the same whatever their number."),
    engine: EngineName = ENGINE,
) -> None:
    """Record a dataset: traffic in a town, seen by the sensors of vehicles and poles, with ground truth."""
    from flcav.dataset.layout import read_manifest, trace_path
    from flcav.dataset.recording.recorder import open_source
    from flcav.dataset.recording.recorder import record as write
    from flcav.interface import progress
    from flcav.sources.recipe import find_recipe, load_recipe, parse_recipe
    from flcav.storage.files import check_writable
    from flcav.world.trace import Trace

    check_writable(out)
    recipe = find_recipe(recipe)
    changes = {name: value for name, value in (("frames", frames), ("seed", seed)) if value is not None}
    wanted = load_recipe(recipe)
    wanted = parse_recipe(wanted.model_dump() | changes, str(recipe))
    source = open_source(wanted, recipe.parent)
    with progress.show_progress(f"record {out}") as report:
        written = write(source, out, jobs=jobs, engine=engine, progress=report)
    manifest = read_manifest(out)
    counts = manifest.counts
    done = "recorded" if written else "already recorded, nothing to do:"
    size_mb = (counts.payload_bytes + sum(entry.bytes for entry in manifest.tables.values())) / 1e6
    echo(
        f"{out}: {done} {plural(counts.frames, 'frame')} of {plural(counts.scenes, 'scene')}, "
        f"{plural(counts.annotations, 'annotation')}, {plural(counts.points, 'point')}, "
        f"{plural(counts.images, 'image')}, {size_mb:.1f} MB"
    )
    if wanted.scenarios:
        happened = [event.kind for scene in manifest.scenes for event in Trace.load(out / trace_path(scene)).events]
        planned = counts.scenes * len(wanted.scenarios)
        by_kind = ", ".join(f"{happened.count(kind)} {kind}" for kind in sorted(set(happened)))
        echo(f"corner cases: {len(happened)} of {planned} found their moment ({by_kind or 'none'})")


def validate(
    folders: list[Path] = typer.Argument(metavar="DIR...", help="Datasets; several are also checked for leakage."),
) -> None:
    """Check datasets: files, tables, boxes against points and traffic, leakage between splits. Exit 1 on a problem."""
    from flcav.dataset.layout import read_manifest
    from flcav.dataset.scene_checks import find_copies
    from flcav.dataset.validation import find_leaks
    from flcav.dataset.validation import validate as problems_of
    from flcav.interface import progress

    manifests = {folder: read_manifest(folder) for folder in folders}
    problems = find_leaks({str(folder): manifest for folder, manifest in manifests.items()}) + find_copies(folders)
    for folder in folders:
        with progress.show_progress(f"validate {folder}") as report:
            problems += problems_of(folder, progress=report)
    for problem in dict.fromkeys(problems):  # copies within a dataset are found by both
        echo(one_line(problem))
    if problems:
        raise typer.Exit(1)
    echo(f"{plural(sum(manifest.counts.frames for manifest in manifests.values()), 'frame')}, no problems")


def import_(
    format: str = typer.Argument(metavar="FORMAT", help=f"What to read: {join_choices(IMPORTS)}, {OWN}."),
    folder: Path = typer.Argument(metavar="DIR", help="A folder of that format, as it is distributed."),
    out: Path = typer.Option(..., "--out", help="New or empty folder for the dataset."),
    split: str | None = typer.Option(None, "--split", help="One split of it alone, such as val; by default all."),
    estimate_poses: bool = typer.Option(
        False, "--estimate-poses", help="Vehicles' poses by LiDAR odometry, for drives that come without."
    ),
    lidar_height: float | None = LIDAR_HEIGHT,
    beams: int | None = BEAMS,
) -> None:
    """Make a dataset of recordings in another format: docs/formats.md says what of it is kept.

    Files that need no conversion are linked to, so they have to stay where they are.
    """
    from flcav.dataset.formats.conversion import import_dataset
    from flcav.dataset.formats.rig import StatedLidar
    from flcav.dataset.layout import read_manifest
    from flcav.dataset.scene_checks import find_copies
    from flcav.dataset.validation import find_leaks
    from flcav.interface import progress

    with progress.show_progress(f"import {out}") as report:
        how: Any = {"lidar": StatedLidar(lidar_height, beams)}
        if estimate_poses:
            from flcav.fusion.registration import DrivenSource

            how["posed"] = DrivenSource
        notes = import_dataset(format, folder, out, split=split, progress=report, **how)
    manifest = read_manifest(out)
    counts = manifest.counts
    echo(
        f"{out}: imported {plural(counts.scenes, 'scene')}, {plural(counts.frames, 'frame')}, "
        f"{plural(counts.annotations, 'object')}, {plural(counts.points, 'point')}, {plural(counts.images, 'image')}"
    )
    for note in notes:
        echo(one_line(f"{folder}: {note}"))
    for leak in find_leaks({str(out): manifest}) + find_copies([out]):
        echo(one_line(leak), err=True)


def export(
    format: str = typer.Argument(metavar="FORMAT", help=f"What to write: {join_choices(EXPORTS)}, {OWN}."),
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    out: Path = typer.Option(..., "--out", help="New or empty folder."),
    labels: str | None = typer.Option(
        None, "--labels", help="yolo: what is labelled, signs (and lights; the default) or actors."
    ),
    validation: float | None = typer.Option(
        None, "--validation", help="All but mcap: share of the scenes kept for validation; 0.2 by default."
    ),
    min_pixels: int | None = typer.Option(
        None, "--min-pixels", help="yolo, coco: what shows fewer pixels is not labelled; 1 by default."
    ),
    min_points: int | None = typer.Option(
        None, "--min-points", help="kitti, opv2v: what has fewer LiDAR points is not labelled; 1 by default."
    ),
    calibration: str | None = typer.Option(
        None, "--calibration", help="All but yolo, coco, culane: true (the default), or assumed by the agents."
    ),
) -> None:
    """Write a dataset in a format that other software reads: docs/formats.md has the tables."""
    from flcav.config import parse_config
    from flcav.dataset.formats.conversion import export as write
    from flcav.dataset.formats.writing import ExportOptions
    from flcav.dataset.store import Dataset
    from flcav.interface import progress

    values = {
        "labels": labels,
        "validation": validation,
        "min_pixels": min_pixels,
        "min_points": min_points,
        "calibration": calibration,
    }
    given = {name: value for name, value in values.items() if value is not None}
    checked = parse_config(ExportOptions, given, "export")
    export_format(format)  # reports a wrong name before a wrong folder
    dataset = Dataset.open(folder)
    with progress.show_progress(f"export {out}") as report:
        exported = write(dataset, format, out, checked, progress=report)
    size_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    echo(f"{out}: exported {_format_counts(exported.counts)}, {size_mb:.1f} MB")
    for line in _format_left_out(exported.left_out):
        echo(line)


def _format_counts(counts: Counter[str]) -> str:
    return ", ".join(plural(number, what.removesuffix("s").replace("_", " ")) for what, number in counts.items())


def _format_left_out(left_out: "Counter[LeftOut]") -> list[str]:
    """Return a line for each reason, with what was left out for it."""
    lines = []
    for why in dict.fromkeys(each.why for each in left_out):
        counts, which = Counter[str](), dict[str, None]()
        for each, number in left_out.items():
            if each.why == why and number:
                counts[each.what] += number
                which[each.which] = None
        if counts:
            named = ", ".join(filter(None, which))
            lines.append(f"left out {_format_counts(counts)}: {why}" + f" ({named})" * bool(named))
    return lines

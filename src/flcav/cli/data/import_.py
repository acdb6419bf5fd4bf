"""`flcav import`: a dataset of another format as one of flcav's."""

from pathlib import Path
from typing import Any

import typer

from flcav.cli.options import OWN, join_choices
from flcav.cli.terminal import echo, one_line
from flcav.dataset.formats.formats import IMPORTS
from flcav.interface.wording import plural


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("import")(import_)


def import_(
    format: str = typer.Argument(metavar="FORMAT", help=f"What to read: {join_choices(IMPORTS)}, {OWN}."),
    folder: Path = typer.Argument(metavar="DIR", help="A folder of that format, as it is distributed."),
    out: Path = typer.Option(..., "--out", help="New or empty folder for the dataset."),
    split: str | None = typer.Option(None, "--split", help="One split of it alone, such as val; by default all."),
    estimate_poses: bool = typer.Option(
        False, "--estimate-poses", help="Vehicles' poses by LiDAR odometry, for drives that come without."
    ),
) -> None:
    """Make a dataset of recordings in another format: docs/formats.md says what of it is kept.

    Files that need no conversion are linked to, so they have to stay where they are.
    """
    from flcav.dataset.formats.conversion import import_dataset
    from flcav.dataset.layout import read_manifest
    from flcav.dataset.scene_checks import find_copies
    from flcav.dataset.validation import find_leaks
    from flcav.interface import progress

    with progress.show_progress(f"import {out}") as report:
        how: Any = {}
        if estimate_poses:
            from flcav.fusion.odometry import DrivenSource

            how = {"posed": DrivenSource}
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

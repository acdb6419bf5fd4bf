"""`flcav export`: convert a dataset to another format."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import OWN, join_choices
from flcav.cli.terminal import echo
from flcav.dataset.formats.formats import EXPORTS, export_format
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from flcav.dataset.formats.writing import LeftOut


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(export)


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
        None, "--calibration", help="All but yolo, coco: true (the default), or assumed by the agents."
    ),
) -> None:
    """Write a dataset in a format that other software reads: docs/formats.md has the tables."""
    from flcav.config import parse_config
    from flcav.dataset.formats.conversion import export as write
    from flcav.dataset.formats.writing import ExportOptions
    from flcav.dataset.store import Dataset
    from flcav.interface import progress

    every = {
        "labels": labels,
        "validation": validation,
        "min_pixels": min_pixels,
        "min_points": min_points,
        "calibration": calibration,
    }
    asked = {name: value for name, value in every.items() if value is not None}
    options = parse_config(ExportOptions, asked, "export")
    export_format(format)  # a wrong name is told before a wrong folder
    dataset = Dataset.open(folder)
    with progress.show_progress(f"export {out}") as report:
        exported = write(dataset, format, out, options, progress=report)
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

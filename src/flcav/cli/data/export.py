"""`flcav export`: convert a dataset to another format."""

from collections import Counter, defaultdict
from pathlib import Path

import typer

from flcav.cli.options import Format, join_choices


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(export)


def export(
    format: Format = typer.Argument(metavar="FORMAT", help=f"What to write: {join_choices(Format)}."),
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
    from flcav import progress
    from flcav.config import parse_config
    from flcav.dataset.formats.export import export as write
    from flcav.dataset.formats.exporter import ExportOptions
    from flcav.dataset.store import Dataset

    every = {
        "labels": labels,
        "validation": validation,
        "min_pixels": min_pixels,
        "min_points": min_points,
        "calibration": calibration,
    }
    asked = {name: value for name, value in every.items() if value is not None}
    options = parse_config(ExportOptions, asked, "export")
    dataset = Dataset.open(folder)
    with progress.show_progress(f"export {out}") as report:
        exported = write(dataset, format, out, options, progress=report)
    size_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    written = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in exported.counts.items())
    typer.echo(f"{out}: exported {written}, {size_mb:.1f} MB")
    for line in _left_out(exported.left_out):
        typer.echo(line)


def _left_out(left_out: Counter[tuple[str, str]]) -> list[str]:
    """Return a line for each reason for which frames were left out."""
    frames: dict[str, list[str]] = defaultdict(list)
    count: Counter[str] = Counter()
    for (why, which), number in left_out.items():
        frames[why].append(which)
        count[why] += number
    return [f"{count[why]} frames left out, {why}: {', '.join(which)}" for why, which in frames.items()]

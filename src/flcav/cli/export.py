"""flcav export: a dataset in another format."""

from pathlib import Path

import typer

from flcav.cli.choices import Format, listed


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(export)


def export(
    format: Format = typer.Argument(metavar="FORMAT", help=f"What to write: {listed(Format)}."),
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    out: Path = typer.Option(..., "--out", help="New or empty folder."),
    labels: str = typer.Option("signs", "--labels", help="What YOLO labels: signs (and lights) or actors."),
    validation: float = typer.Option(0.2, "--validation", help="Share of the scenes kept for validation."),
    min_pixels: int = typer.Option(1, "--min-pixels", help="2D labels of what shows fewer pixels are left out."),
    calibration: str = typer.Option("true", "--calibration", help="Which to write: true, or assumed by the agents."),
) -> None:
    """Write a dataset in a format that other software reads: docs/formats.md has the tables."""
    from flcav import progress
    from flcav.config import parse_config
    from flcav.dataset.formats.export import export as write
    from flcav.dataset.formats.exporter import ExportOptions
    from flcav.dataset.store import Dataset

    asked = {"labels": labels, "validation": validation, "min_pixels": min_pixels, "calibration": calibration}
    options = parse_config(ExportOptions, asked, "export")
    dataset = Dataset.open(folder)
    with progress.live(f"export {out}") as report:
        counts = write(dataset, format, out, options, progress=report)
    size_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    written = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())
    typer.echo(f"{out}: exported {written}, {size_mb:.1f} MB")

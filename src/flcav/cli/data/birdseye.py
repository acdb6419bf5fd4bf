"""`flcav birdseye`: bird's-eye view of a frame as a picture."""

from pathlib import Path

import typer

from flcav.cli.options import check_finite, check_png
from flcav.cli.terminal import echo
from flcav.interface.wording import plural


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(birdseye)


def birdseye(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    out: Path = typer.Option(..., "--out", callback=check_png, help="The PNG file to write."),
    frame: str | None = typer.Option(
        None, "--frame", help="Key of the frame, as the point clouds are named; else the first."
    ),
    range_m: float = typer.Option(
        50.0, "--range", min=5.0, max=500.0, callback=check_finite, help="How far from the agent to show [m]."
    ),
    tracks: bool = typer.Option(False, "--tracks", help="Also the path of every annotated actor over the scene."),
) -> None:
    """Draw a frame of a dataset from above: points by height, radar echoes, boxes, the agent."""
    from flcav.dataset.store import Dataset
    from flcav.report import style
    from flcav.report.pictures.birdseye import birdseye, view_frame
    from flcav.storage.files import write_bytes

    dataset = Dataset.open(folder)
    seen = dataset.frame(0 if frame is None else dataset.number(frame))
    view = view_frame(dataset, seen, range_m=range_m, tracks=tracks)
    write_bytes(out, style.png(birdseye(view)))
    echo(f"{out}: {seen.key}, {plural(len(view.points), 'point')}, {plural(len(seen.annotations), 'annotated actor')}")

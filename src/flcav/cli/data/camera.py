"""`flcav camera`: pictures of a frame's cameras, with annotations."""

from pathlib import Path

import typer

from flcav.cli.options import check_png
from flcav.cli.terminal import echo


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(camera)


def camera(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    out: Path = typer.Option(..., "--out", callback=check_png, help="The PNG file to write."),
    frame: str | None = typer.Option(
        None, "--frame", help="Key of the frame, as the pictures are named; else the first that has any."
    ),
    name: str | None = typer.Option(None, "--camera", help="Name of the camera; else all of the frame, side by side."),
    boxes: bool = typer.Option(False, "--boxes", help="Draw the boxes of annotated actors that show, and the signs."),
) -> None:
    """Draw what the cameras of a frame saw, infrared ones too."""
    from flcav.config import InputError
    from flcav.dataset.store import Dataset
    from flcav.report import style
    from flcav.report.pictures.camera import arrange_cameras, camera_sheet, make_shot
    from flcav.storage.files import write_bytes

    dataset = Dataset.open(folder)
    names = [[*dataset.cameras(i), *dataset.infrareds(i)] for i in range(len(dataset))]
    number = next((i for i, found in enumerate(names) if found), 0) if frame is None else dataset.number(frame)
    if not names[number]:
        whose = "no frame has a" if frame is None else f"frame {frame} has no"
        raise InputError(f"{folder}: {whose} camera's picture")
    seen = dataset.frame(number)
    if name is not None and name not in names[number]:
        raise InputError(f"{folder}: no camera '{name}' in {seen.key}; it has {', '.join(names[number])}")
    rows = arrange_cameras(seen, names[number] if name is None else [name])
    shots = [[make_shot(seen, each) for each in row] for row in rows]
    write_bytes(out, style.png(camera_sheet(f"{seen.key} · {seen.time_s:.1f} s", shots, boxes=boxes)))
    echo(f"{out}: {seen.key}, {', '.join(each for row in rows for each in row)}")

"""`flcav birdseye`: bird's-eye view of a frame as a picture."""

from pathlib import Path

import typer

from flcav.cli.options import check_finite
from flcav.wording import plural


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(birdseye)


def birdseye(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    out: Path = typer.Option(..., "--out", help="The PNG file to write."),
    frame: str | None = typer.Option(
        None, "--frame", help="Key of the frame, as the point clouds are named; else the first."
    ),
    range_m: float = typer.Option(
        50.0, "--range", min=5.0, max=500.0, callback=check_finite, help="How far from the agent to show [m]."
    ),
) -> None:
    """Draw a frame of a dataset from above: its points by height, its boxes, its agent."""
    import numpy as np

    from flcav.dataset.ground import Ground
    from flcav.dataset.store import Dataset
    from flcav.files import write_bytes
    from flcav.geometry import inverse, transform_points
    from flcav.perception.agents import POLE, kind_of
    from flcav.report import style
    from flcav.report.pictures.birdseye import View, birdseye
    from flcav.world.shapes import SHAPES

    sedan = next(shape for shape in SHAPES["car"] if shape.name == "sedan")
    dataset = Dataset.open(folder)
    number = 0 if frame is None else dataset.number(frame)
    seen = dataset.frame(number)
    clouds = [transform_points(seen.agent_from_sensor[name], cloud[:, :3]) for name, cloud in seen.lidar.items()]
    points, ground = np.concatenate(clouds).astype(np.float64), Ground(dataset)
    if ground.relief is None:
        points[:, 2] += ground.height_of(number)
    else:
        points[:, 2] = ground.relief.above(transform_points(seen.world_from_agent, points))
    view = View(
        points=points,
        truth=seen.annotations.boxes.transform(inverse(seen.world_from_agent)),
        returns=seen.annotations.returns,
        title=f"{seen.key} · {seen.time_s:.1f} s",
        range_m=range_m,
        agent_size=None if kind_of(seen.agent) == POLE else (sedan.length, sedan.width),
    )
    write_bytes(out, style.png(birdseye(view)))
    typer.echo(f"{out}: {seen.key}, {plural(len(points), 'point')}, {plural(len(seen.annotations), 'annotated actor')}")

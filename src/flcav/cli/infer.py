"""flcav infer: a network on point clouds."""

import json
from pathlib import Path

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(infer)


def infer(
    task: str = typer.Argument(help="What to find: objects."),
    inputs: list[Path] = typer.Argument(help="KITTI .bin files, folders of them, or dataset folders."),
    weights: Path | None = typer.Option(None, "--weights", help="Weights (safetensors) that flcav train wrote."),
    threshold: float = typer.Option(0.3, "--threshold", min=0.0, max=1.0, help="Lowest score shown."),
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Find objects in point clouds: boxes in the LiDAR frame, x forward, y left, z up, metres and radians."""
    from flcav.cli.tasks import task_named, weights_given

    learned = task_named(task)
    network = learned.load(weights_given(weights, task))
    results = [result for path in inputs for result in learned.infer(network, path, threshold)]
    if as_json:
        typer.echo(json.dumps({"inputs": results}, allow_nan=False))
        return
    for result in results:
        typer.echo(f"{result['path']}: {len(result['boxes'])} objects")
        for box in result["boxes"]:
            place = f"at ({box['x']:.1f}, {box['y']:.1f}, {box['z']:.1f}) m, yaw {box['yaw']:.2f} rad"
            size = f"{box['length']:.1f} x {box['width']:.1f} x {box['height']:.1f} m"
            typer.echo(f"  {box['class']:<11}{box['score']:.2f}  {place}, {size}")

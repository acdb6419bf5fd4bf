"""flcav infer: a network on what sensors saw."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.choices import Device, TaskName, listed
from flcav.cli.options import AGENTS, THREADS
from flcav.threads import use_threads

if TYPE_CHECKING:
    from flcav.perception.task import Finding


SCORED = ("signs", "objects")  # tasks whose findings have a score each


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(infer)


def infer(
    task: TaskName = typer.Argument(metavar="TASK", help=f"What to find: {listed(TaskName)}."),
    inputs: list[Path] = typer.Argument(
        help="KITTI .bin files (objects) or PNG, JPEG and WebP files, folders of them, or dataset folders."
    ),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; by default those of the package."
    ),
    threshold: float = typer.Option(0.3, "--threshold", min=0.0, max=1.0, help="signs, objects: lowest score shown."),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    pictures: Path | None = typer.Option(None, "--pictures", help="Folder for a picture of each input with findings."),
    agents: str | None = AGENTS,
    threads: int = THREADS,
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Run a network on files or datasets.

    Boxes of objects are in the LiDAR frame: x forward, y left, z up, metres and radians. Boxes of signs are in pixels
    from the upper left corner of the picture. Paths are in the world's frame, all modes with their probabilities,
    with "constant_velocity" beside them and "truth" where the recording goes on for long enough.
    """
    use_threads(threads)
    from flcav.cli.refusals import refuse_unused
    from flcav.cli.tasks import network_of, task_named
    from flcav.config import InputError
    from flcav.dataset.layout import MANIFEST
    from flcav.dataset.store import Dataset
    from flcav.files import check_writable
    from flcav.perception.agents import choose_frames

    if math.isnan(threshold):
        raise InputError("--threshold nan: a score from 0 to 1 is wanted")
    if pictures is not None:
        check_writable(pictures)
    learned = task_named(task)
    if task not in SCORED:
        refuse_unused(f"infer {task}", "threshold")
    network = network_of(learned, weights, device)
    recorded = [path for path in inputs if (path / MANIFEST).is_file()]
    if agents is not None and not recorded:
        raise InputError(f"--agents {agents}: only datasets have agents, and none is among the inputs")
    chosen = {path: choose_frames(learned, network.config, Dataset.open(path), agents) for path in recorded}
    frames = {path: choice.frames for path, choice in chosen.items()}
    findings = (found for path in inputs for found in learned.infer(network, path, threshold, frames.get(path)))
    results = []
    for number, finding in enumerate(findings):
        results.append({"path": str(finding.path), **finding.result})
        if pictures is not None:
            _draw(task, finding, pictures / f"{number:05d}_{finding.path.stem}.png")
    if as_json:
        datasets = [{"path": str(path), **choice.summary()} for path, choice in chosen.items()]
        typer.echo(json.dumps({"datasets": datasets, "inputs": results}, allow_nan=False))
        return
    for path, choice in chosen.items():
        typer.echo(f"{path}: {choice.sentence}")
    for result in results:
        typer.echo("\n  ".join([f"{result['path']}:", *learned.finding_lines(result)]))


def _draw(task: str, finding: "Finding", path: Path) -> None:
    from flcav.files import write_bytes
    from flcav.report import style
    from flcav.report.inference import DRAWINGS

    write_bytes(path, style.png(DRAWINGS[task](finding)))

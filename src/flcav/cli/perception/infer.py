"""`flcav infer`: run a network on files or datasets."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import AGENTS, ANY_TASK, AROUND, THREADS, Device, check_finite, refuse_unused
from flcav.cli.terminal import echo, only_writer_of, print_json
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.perception.task import Finding


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(infer)


@only_writer_of("pictures")
def infer(
    task: str = typer.Argument(metavar="TASK", help=f"What to find: {ANY_TASK}."),
    inputs: list[Path] = typer.Argument(
        help="Point clouds of KITTI, nuScenes, PCD (objects) or PNG, JPEG and WebP files, folders of them, or datasets."
    ),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; by default those of the package."
    ),
    threshold: float | None = typer.Option(
        None,
        "--threshold",
        min=0.0,
        max=1.0,
        callback=check_finite,
        help="signs, objects: lowest score shown; 0.3 if not given.",
    ),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    pictures: Path | None = typer.Option(None, "--pictures", help="Folder for a picture of each input with findings."),
    agents: str | None = AGENTS,
    around: bool = AROUND,
    threads: int = THREADS,
    as_json: bool = typer.Option(False, "--json", help="One JSON object on stdout."),
) -> None:
    """Run a network on files or datasets.

    Boxes of objects are in the LiDAR frame: x forward, y left, z up, metres and radians. Boxes of signs are in pixels
    from the upper left corner of the picture. Paths are in the world's frame, all modes with their probabilities,
    with "constant_velocity" beside them and "truth" where the recording goes on for long enough.
    """
    use_threads(threads)
    from flcav.perception import networks
    from flcav.perception.task import Scores
    from flcav.perception.tasks import task_named
    from flcav.storage.files import check_writable

    if pictures is not None:
        check_writable(pictures)
    learned = task_named(task)
    if not isinstance(learned, Scores):
        refuse_unused(f"infer {task}", "threshold")
    found = networks.infer(
        learned, inputs, weights, threshold=threshold, around=around, agents=agents, device=device, threads=threads
    )
    findings = []
    for number, finding in enumerate(found):
        findings.append((str(finding.path), finding.result))
        if pictures is not None:
            _draw(finding, pictures / f"{number:05d}_{finding.path.stem}.png")
    if as_json:
        datasets = [{"path": str(path), **choice.summary()} for path, choice in found.chosen.items()]
        results = [{"path": path, **result.as_json()} for path, result in findings]
        print_json({"datasets": datasets, "inputs": results})
        return
    for path, choice in found.chosen.items():
        echo(f"{path}: {choice.sentence}")
    for path, result in findings:
        echo("\n  ".join([f"{path}:", *result.lines()]))


def _draw(finding: "Finding", path: Path) -> None:
    from flcav.report import style
    from flcav.report.pictures.inference import draw
    from flcav.storage.files import write_bytes

    write_bytes(path, style.png(draw(finding)))

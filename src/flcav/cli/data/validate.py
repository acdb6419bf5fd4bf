"""`flcav validate`: all checks of datasets."""

from pathlib import Path

import typer

from flcav.cli.terminal import echo, one_line
from flcav.interface.wording import plural


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(validate)


def validate(
    folders: list[Path] = typer.Argument(metavar="DIR...", help="Datasets; several are also checked for leakage."),
) -> None:
    """Check datasets: files, tables, boxes against points and traffic, leakage between splits. Exit 1 on a problem."""
    from flcav.dataset.layout import read_manifest
    from flcav.dataset.scene_checks import find_copies
    from flcav.dataset.validation import find_leaks
    from flcav.dataset.validation import validate as problems_of
    from flcav.interface import progress

    manifests = {folder: read_manifest(folder) for folder in folders}
    problems = find_leaks({str(folder): manifest for folder, manifest in manifests.items()}) + find_copies(folders)
    for folder in folders:
        with progress.show_progress(f"validate {folder}") as report:
            problems += problems_of(folder, progress=report)
    for problem in dict.fromkeys(problems):  # copies within a dataset are found by both
        echo(one_line(problem))
    if problems:
        raise typer.Exit(1)
    echo(f"{plural(sum(manifest.counts.frames for manifest in manifests.values()), 'frame')}, no problems")

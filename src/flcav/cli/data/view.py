"""`flcav view`: show a scene of a dataset in Rerun."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

import typer

from flcav.cli.terminal import echo
from flcav.interface.wording import plural


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(view)


def view(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset."),
    scene: str | None = typer.Option(None, "--scene", help="Name of the scene; else the first."),
    save: Path | None = typer.Option(None, "--save", help="Write this .rrd file instead of opening the viewer."),
) -> None:
    """Show a scene in Rerun: points, images, boxes, tracks, map, radar. Needs the extra `view`."""
    from flcav.config import InputError
    from flcav.dataset.store import Dataset
    from flcav.interface import progress
    from flcav.interface.wording import format_install_command
    from flcav.storage.files import atomic_path

    if find_spec("rerun") is None:
        raise InputError(f"flcav view needs Rerun, which is not installed: {format_install_command('view')}")
    if save is not None and save.suffix != ".rrd":
        raise InputError(f"--save {save}: must be the name of an .rrd file")
    if save is None and sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        raise InputError("flcav view has no display to open the viewer on: write a file with --save FILE.rrd instead")
    import rerun  # pyright: ignore[reportMissingImports]

    from flcav.report.pictures.rerun_log import blueprint, log_scene

    dataset = Dataset.open(folder)
    scenes = dataset.manifest.scenes
    if scene is not None and scene not in scenes:
        raise InputError(f"{folder}: no scene '{scene}'; it has {', '.join(scenes)}")
    shown = scene or scenes[0]
    selected = dataset.select(scenes=[shown])
    first = [i for i in selected if dataset.keys[i].index == dataset.keys[selected[0]].index]
    layout = blueprint([dataset.frame(i) for i in first])
    recording = rerun.RecordingStream("flcav", recording_id=shown)

    def log() -> None:
        with progress.show_progress(f"view {shown}") as report:
            log_scene(recording, dataset, selected, dataset.town(), report)
        recording.flush()

    if save is None:
        try:
            recording.spawn(default_blueprint=layout)
            log()
        except RuntimeError as error:
            reason = str(error).partition("\n")[0]
            raise InputError(
                f"flcav view has no viewer to show it in ({reason.rstrip('.')}): use --save FILE.rrd instead"
            ) from None
        return
    with atomic_path(save) as temporary:
        recording.save(temporary, default_blueprint=layout)
        log()
        recording.disconnect()
    echo(f"{save}: scene {shown}, {plural(len(selected), 'frame')}, {save.stat().st_size / 1e6:.1f} MB")

"""`flcav birdseye`, `camera` and `view`: a recorded frame as a picture, and recordings in Rerun's viewer."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import check_finite, check_png, refuse_unused
from flcav.cli.terminal import echo
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from flcav.dataset.store import Dataset


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
    shots = [[make_shot(seen, shown) for shown in row] for row in rows]
    write_bytes(out, style.png(camera_sheet(f"{seen.key} · {seen.time_s:.1f} s", shots, boxes=boxes)))
    echo(f"{out}: {seen.key}, {', '.join(shown for row in rows for shown in row)}")


def open_shown(folder: Path) -> "Dataset":
    """Return the dataset in a folder, or of a run's folder the test frames of its first federating region and task."""
    from flcav.dataset.store import Dataset
    from flcav.runs.frames import Frames
    from flcav.runs.results.run import Run
    from flcav.runs.running import WORK

    if not (folder / Run.file).is_file():
        return Dataset.open(folder)
    run = Run.load(folder)
    region, task = run.recipe.with_role("federate")[0], next(iter(run.recipe.tasks))
    return Frames.open(folder / WORK / run.steps.recording(region, "test", task)).data


def view(
    folder: Path = typer.Argument(metavar="DIR", help="A dataset, or the folder of a run, for its test frames."),
    scene: str | None = typer.Option(None, "--scene", help="Name of the scene; else the first."),
    save: Path | None = typer.Option(None, "--save", help="Write this .rrd file instead of opening the viewer."),
    animate: Path | None = typer.Option(
        None,
        "--animate",
        help="Write this .webp or .gif instead: eight seconds of a run's misses, pole, rounds and megabytes.",
    ),
) -> None:
    """Show a scene in Rerun: points, images, boxes, tracks, map, radar. Needs the extra `view`."""
    from flcav.config import InputError

    if animate is not None:
        refuse_unused("--animate", "scene", "save")
        from flcav.report.pages.loop_film import write_loop

        frames, seconds = write_loop(folder, animate)
        echo(f"{animate}: {plural(frames, 'frame')}, {seconds:g} s, {animate.stat().st_size / 1e6:.1f} MB")
        return
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

    dataset = open_shown(folder)
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

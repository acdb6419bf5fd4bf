"""`flcav record`: record a dataset by a recipe."""

from pathlib import Path

import typer

from flcav.cli.options import ENGINE, EngineName
from flcav.cli.terminal import echo, when_interrupted
from flcav.interface.wording import plural


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(record)


@when_interrupted()
def record(
    recipe: Path = typer.Argument(help="Recipe (YAML): town, traffic, vehicles, poles, sensors."),
    out: Path = typer.Option(..., "--out", help="Folder of the dataset; an interrupted recording goes on."),
    frames: int | None = typer.Option(None, "--frames", help="Record exactly this many frames instead."),
    seed: int | None = typer.Option(None, "--seed", help="Seed instead of the recipe's."),
    jobs: int = typer.Option(1, "--jobs", help="Workers; the dataset is the same whatever their number."),
    engine: EngineName = ENGINE,
) -> None:
    """Record a dataset: traffic in a town, seen by the sensors of vehicles and poles, with ground truth."""
    from flcav.dataset.layout import read_manifest, trace_path
    from flcav.dataset.recording.recorder import open_source
    from flcav.dataset.recording.recorder import record as write
    from flcav.interface import progress
    from flcav.sources.recipe import find_recipe, load_recipe, parse_recipe
    from flcav.storage.files import check_writable
    from flcav.world.trace import Trace

    check_writable(out)
    recipe = find_recipe(recipe)
    changes = {name: value for name, value in (("frames", frames), ("seed", seed)) if value is not None}
    asked = load_recipe(recipe)
    asked = parse_recipe(asked.model_dump() | changes, str(recipe))
    source = open_source(asked, recipe.parent)
    with progress.show_progress(f"record {out}") as report:
        written = write(source, out, jobs=jobs, engine=engine, progress=report)
    manifest = read_manifest(out)
    counts = manifest.counts
    done = "recorded" if written else "already recorded, nothing to do:"
    size_mb = (counts.payload_bytes + sum(entry.bytes for entry in manifest.tables.values())) / 1e6
    echo(
        f"{out}: {done} {plural(counts.frames, 'frame')} of {plural(counts.scenes, 'scene')}, "
        f"{plural(counts.annotations, 'annotation')}, {plural(counts.points, 'point')}, "
        f"{plural(counts.images, 'image')}, {size_mb:.1f} MB"
    )
    if asked.scenarios:
        happened = [event.kind for scene in manifest.scenes for event in Trace.load(out / trace_path(scene)).events]
        asked_for = counts.scenes * len(asked.scenarios)
        each = ", ".join(f"{happened.count(kind)} {kind}" for kind in sorted(set(happened)))
        echo(f"corner cases: {len(happened)} of {asked_for} found their moment ({each or 'none'})")

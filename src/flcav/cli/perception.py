"""`flcav train`, `evaluate`, `infer` and `errors`: networks on recorded frames, and their errors in a town."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import (
    AGENTS,
    ANY_TASK,
    AROUND,
    BEAMS,
    LIDAR_HEIGHT,
    THREADS,
    Device,
    check_finite,
    check_png,
    refuse_unused,
)
from flcav.cli.terminal import Answer, answer_json, echo, only_writer_of, when_interrupted
from flcav.interface.wording import plural
from flcav.machine.threads import use_threads

if TYPE_CHECKING:
    from flcav.perception.errors import Registry
    from flcav.perception.task import Finding
    from flcav.world.map.town import Town


def train(
    task: str = typer.Argument(metavar="TASK", help=f"What to learn: {ANY_TASK}."),
    data: list[Path] = typer.Option(..., "--data", help="Dataset folder; may be given several times."),
    out: Path = typer.Option(
        ..., "--out", help="Folder of the weights; an interrupted training goes on, a finished one is left alone."
    ),
    validation: Path | None = typer.Option(
        None,
        "--validation",
        help="Dataset of other scenes: keeps the epoch that is best on it, may stop early, calibrates scores.",
    ),
    network: str | None = typer.Option(
        None,
        "--network",
        help="Which of the task's networks: docs/tasks.md names them; by default its first.",
    ),
    epochs: int = typer.Option(10, "--epochs", min=1, help="Passes through the data."),
    patience: int = typer.Option(5, "--patience", min=1, help="Epochs without a better validation before it stops."),
    seed: int = typer.Option(0, "--seed", min=0, help="Initial weights, order and augmentation."),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    agents: str | None = AGENTS,
    threads: int = THREADS,
) -> None:
    """Train a network on recorded frames with their ground truth; writes OUT/weights.safetensors and its card.

    Curves for TensorBoard go to OUT/events.
    """
    use_threads(threads)
    from flcav.cli.options import refuse_unused
    from flcav.dataset.store import Dataset
    from flcav.interface import progress
    from flcav.perception.device import select_device
    from flcav.perception.tasks import task_named
    from flcav.perception.training.run import CHECKPOINT, WEIGHTS, TrainingRequest, prepare_training, train_prepared

    if validation is None:
        refuse_unused("a training without --validation", "patience")
    learner, place = task_named(task), select_device(device)
    held = Dataset.open(validation) if validation else None
    request = TrainingRequest(
        [Dataset.open(folder) for folder in data], held, network, epochs, patience, seed, place, agents
    )

    def kept() -> str:
        saved = out / CHECKPOINT
        return f"the same command goes on from {saved}" if saved.exists() else "nothing saved yet"

    with when_interrupted(kept):
        prepared = prepare_training(learner, request, out)
        if prepared.finished is not None:
            train_prepared(prepared)  # writes the card if it is missing
            echo(f"{out / WEIGHTS}: trained with these settings before, nothing to do")
            return
        echo("\n".join(prepared.lines()))
        with progress.show_progress(f"train {task}") as report:
            trained = train_prepared(prepared, report)
    card = trained.card
    summary = f"{out / WEIGHTS}: trained on {plural(card.samples, 'sample')}, {plural(card.learning.steps, 'step')}"
    echo(f"{summary}, mean loss of the last epoch {card.learning.loss:.3f}")
    if trained.evaluation is not None:
        echo("\n".join(["on the validation data:", *trained.evaluation.lines()]))


@answer_json
def evaluate(
    task: str = typer.Argument(metavar="TASK", help=f"What was learned: {ANY_TASK}."),
    data: Path = typer.Option(..., "--data", help="Dataset folder; objects: or one in KITTI's layout."),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; packaged, the default: those of the package."
    ),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    tracks: bool = typer.Option(False, "--tracks", help="objects: also MOTA, AMOTA and id switches of their tracks."),
    agents: str | None = AGENTS,
    around: bool = AROUND,
    within: str | None = typer.Option(
        None,
        "--range",
        metavar="AHEAD,SIDE",
        help="objects: ask only for those so many metres ahead and to either side, as 48,24; by default the network's "
        "range. Networks of different ranges are compared so.",
    ),
    lidar_height: float | None = LIDAR_HEIGHT,
    beams: int | None = BEAMS,
    threads: int = THREADS,
) -> Answer:
    """Evaluate a network on recorded frames.

    Accuracy of weather, mAP of signs, average precision of objects, errors of predicted paths. Objects in a folder of
    KITTI are counted as its benchmark does: easy, moderate, hard.
    """
    use_threads(threads)
    from flcav.dataset.formats.rig import StatedLidar
    from flcav.interface import progress
    from flcav.perception import networks
    from flcav.perception.tasks import task_named

    learned = task_named(task)
    with progress.show_progress(f"evaluate {learned.name}") as report:
        found = networks.evaluate(
            learned,
            data,
            weights,
            agents=agents,
            within=within,
            around=around,
            tracks=tracks,
            lidar=StatedLidar(lidar_height, beams),
            device=device,
            threads=threads,
            progress=report,
        )
    origin = networks.origin_of(learned, weights)
    yield vars(origin) | found.chosen.summary() | dict(found.numbers)
    yield "\n".join([found.chosen.sentence, str(origin), *found.lines])


@only_writer_of("pictures")
@answer_json
def infer(
    task: str = typer.Argument(metavar="TASK", help=f"What to find: {ANY_TASK}."),
    inputs: list[Path] = typer.Argument(
        help="Point clouds of KITTI, nuScenes, PCD (objects) or PNG, JPEG and WebP files, folders of them, or datasets."
    ),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; packaged, the default: those of the package."
    ),
    threshold: float | None = typer.Option(
        None,
        "--threshold",
        min=0.0,
        max=1.0,
        callback=check_finite,
        help="signs, objects, road: lowest score shown; if not given 0.3, of the lane lines of road 0.6.",
    ),
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
    pictures: Path | None = typer.Option(None, "--pictures", help="Folder for a picture of each input with findings."),
    agents: str | None = AGENTS,
    around: bool = AROUND,
    lidar_height: float | None = LIDAR_HEIGHT,
    beams: int | None = BEAMS,
    threads: int = THREADS,
) -> Answer:
    """Run a network on files or datasets.

    Boxes of objects are in the LiDAR frame, of a file in that of its points: x forward, y left, z up, metres and
    radians. Boxes of signs are in pixels
    from the upper left corner of the picture. Paths are in the world's frame, all modes with their probabilities,
    with "constant_velocity" beside them and "truth" where the recording goes on for long enough.
    """
    use_threads(threads)
    from flcav.dataset.formats.rig import StatedLidar
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
        learned,
        inputs,
        weights,
        threshold=threshold,
        around=around,
        agents=agents,
        lidar=StatedLidar(lidar_height, beams),
        device=device,
        threads=threads,
    )
    findings = []
    for number, finding in enumerate(found):
        findings.append((str(finding.path), finding.result))
        if pictures is not None:
            _draw_finding(finding, pictures / f"{number:05d}_{finding.path.stem}.png")
    datasets = [{"path": str(path), **choice.summary()} for path, choice in found.chosen.items()]
    results = [{"path": path, **result.as_json()} for path, result in findings]
    lidars = [{"path": str(path), "rig": unlike} for path, unlike in found.lidars.items()]
    yield {"datasets": datasets, "inputs": results} | ({"lidars": lidars} if lidars else {})
    for path, unlike in found.lidars.items():
        yield f"{path}: {unlike}"
    for path, choice in found.chosen.items():
        yield f"{path}: {choice.sentence}"
    for path, result in findings:
        yield "\n  ".join([f"{path}:", *result.lines()])


def _draw_finding(finding: "Finding", path: Path) -> None:
    from flcav.report import style
    from flcav.report.pictures.inference import draw
    from flcav.storage.files import write_bytes

    write_bytes(path, style.png(draw(finding)))


PLURALS = {"miss": "missed", "false_positive": "false positives", "final_error": "final errors"}


def errors(
    task: str = typer.Argument(metavar="TASK", help=f"Whose errors: {ANY_TASK}; weather's have no place in a town."),
    data: Path = typer.Option(..., "--data", help="Dataset folder: where the network drives."),
    out: Path = typer.Option(..., "--out", help="The table to write: .csv or .parquet."),
    weights: Path | None = typer.Option(
        None, "--weights", help="Weights that flcav train wrote; packaged, the default: those of the package."
    ),
    threshold: float | None = typer.Option(
        None,
        "--threshold",
        min=0.0,
        max=1.0,
        callback=check_finite,
        help="objects, signs: lowest score of a detection; 0.3 if not given.",
    ),
    map_: Path | None = typer.Option(
        None, "--map", callback=check_png, help="PNG file: the errors in the dataset's town."
    ),
    agents: str | None = AGENTS,
    around: bool = AROUND,
    threads: int = THREADS,
    device: Device = typer.Option(Device.auto, "--device", help="Where it runs; auto: a GPU where there is one."),
) -> None:
    """Register what a network gets wrong on recorded frames.

    A row per object and cause; columns x, y, z [m, world], weight, kind, class, returns, occlusion, scene, track.
    Objects and signs: missed or invented; trajectory: a final error above 2 m, at the road user's present. Each object
    counts once per scene, each sign once. `flcav place` reads the table.
    """
    use_threads(threads)
    from flcav.config import InputError
    from flcav.dataset.store import Dataset
    from flcav.interface import progress
    from flcav.perception import networks
    from flcav.perception.errors import save_errors
    from flcav.perception.objects.task import ObjectsTask
    from flcav.perception.task import Scores
    from flcav.perception.tasks import task_named
    from flcav.storage.files import check_writable, write_bytes
    from flcav.storage.records import check_ending

    learned = task_named(task)
    if not isinstance(learned, Scores):
        refuse_unused(f"errors {task}", "threshold")
    if not isinstance(learned, ObjectsTask):
        refuse_unused(f"errors {task}", "around")
    check_ending(out)
    for path in (out, map_):
        if path is not None:
            check_writable(path.parent)
    dataset = Dataset.open(data)
    town = dataset.town()
    if map_ is not None and town is None:
        raise InputError(f"{data}: its town is not known, so that there is no map of it")
    with progress.show_progress(f"errors of {learned.name}") as report:
        found = networks.register_errors(
            learned, dataset, weights, threshold=threshold, around=around, agents=agents, device=device, progress=report
        )
    save_errors(found.errors, out)
    if map_ is not None and town is not None:
        write_bytes(map_, _draw_errors(town, found))
    if found.chosen is not None:
        echo(found.chosen.sentence)
    echo(networks.origin_of(learned, weights))
    counts = Counter(error.kind for error in found)
    listed = ", ".join(f"{PLURALS.get(kind, kind)}: {count}" for kind, count in counts.items())
    lost = f"; {found.dropped} false positives that point at nothing in the town left out" if found.dropped else ""
    echo(f"{out}: {listed or 'no errors'}{lost}")


def _draw_errors(town: "Town", found: "Registry") -> bytes:
    from flcav.report import style
    from flcav.report.charts.figures import town_map
    from flcav.report.pictures.maps import ErrorMap, poles_of

    return style.png(town_map(ErrorMap(town, found.positions, found.kinds, poles_of(town))))

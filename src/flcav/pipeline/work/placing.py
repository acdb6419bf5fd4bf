"""Steps that register a region's errors and place its roadside sensors."""

from collections.abc import Mapping

from flcav.config import InputError
from flcav.perception.errors import THRESHOLD, RegistersErrors, load_errors, save_errors
from flcav.perception.tasks import task_named
from flcav.pipeline.federations.messages import release_network, report_errors
from flcav.pipeline.frames import Frames
from flcav.pipeline.placing import find_sites, place_sensors, read_traces
from flcav.pipeline.recipe import Placement
from flcav.pipeline.results import ERRORS, LEDGER, ErrorRegistry, Pretrained
from flcav.pipeline.stages import load_stage_network
from flcav.pipeline.steps import Work
from flcav.pipeline.work import Fields
from flcav.pipeline.work.budgets import open_region_book


def errors_step(
    work: Work,
    task: str,
    region: str,
    pretrained: str,
    registry: str,
    plan: str,
    vehicles: Mapping[str, int],
    budget_mb: tuple[float, float],
) -> None:
    """Register the errors of the pretrained network in a region, as its vehicles report them to the edge server.

    Raises `InputError` for a task whose errors have no position.
    """
    learned = task_named(task)
    if not isinstance(learned, RegistersErrors):
        raise InputError(f"placement.tasks: the errors of '{task}' have no place in a town")
    drive = Frames.open(work.inputs[registry])
    book = open_region_book(work, task, region, plan, pretrained, vehicles, budget_mb)
    network = release_network(book, learned, load_stage_network(learned, work.inputs[pretrained]), region, drive)
    threshold = Pretrained.load(work.inputs[pretrained]).threshold
    lowest = THRESHOLD if threshold is None else threshold
    found = learned.register_errors(network, drive.data, drive.vehicles, lowest, work.report)
    found = report_errors(book, learned, found, region, drive)
    book.save(work.folder / LEDGER)
    save_errors(found.errors, work.folder / ERRORS)
    kinds = sorted({error.kind for error in found.errors})
    counts = {kind: sum(error.kind == kind for error in found.errors) for kind in kinds}
    ErrorRegistry(region, task, counts, found.dropped).save(work.folder)


def place_step(
    work: Work,
    region: str,
    how: Fields,
    errors: Mapping[str, str],
    weights: Mapping[str, float],
    registry: str,
    edge: str | None,
    seed: int = 0,
) -> None:
    """Place a region's roadside sensors by the errors and weights of each task.

    `edge`: step of the recorded training data, if any, whose poles are the only candidates; `seed`: of random poles.
    """
    drive = Frames.open(work.inputs[registry])
    sites = find_sites(drive, None if edge is None else Frames.open(work.inputs[edge]))
    found = {task: load_errors(work.inputs[step] / ERRORS) for task, step in errors.items()}
    traces = read_traces(drive.data, drive.vehicles)
    place_sensors(region, Placement.model_validate(how), sites, found, weights, traces, seed).save(work.folder)

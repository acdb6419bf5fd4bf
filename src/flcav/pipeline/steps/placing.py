"""Steps that register a region's errors and place its roadside sensors."""

from collections.abc import Mapping

from flcav.config import InputError
from flcav.perception.errors import THRESHOLD, RegistersErrors, load_errors, save_errors
from flcav.perception.tasks import task_named
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.messages import release_network, report_errors
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import load_stage_network
from flcav.pipeline.poles import find_passed, find_sites, place_sensors, read_traces
from flcav.pipeline.recipe import Budgets, Placement
from flcav.pipeline.results.placement import ErrorRegistry
from flcav.pipeline.results.plans import Plan
from flcav.pipeline.results.saved import ERRORS, LEDGER
from flcav.pipeline.results.training import Pretrained
from flcav.pipeline.steps.budgets import open_region_book, share_plan_budget
from flcav.pipeline.steps.settings import StepSettings


class ErrorsSettings(StepSettings):
    """Settings of the registration of a task's errors in a region."""

    task: str
    region: str
    plan: str
    pretrained: str
    registry: str  # recording of the frames that errors are registered in
    vehicles: Mapping[str, int]  # of each federating region
    budgets_mb: Budgets  # of the run

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (self.pretrained, self.registry, self.plan)


class PlaceSettings(StepSettings):
    """Settings of the placement of a region's roadside sensors."""

    region: str
    how: Placement
    errors: Mapping[str, str]  # registrations of errors, by task
    weights: Mapping[str, float]  # of an error, by task
    registry: str  # recording of the traffic whose density counts
    edge: str | None  # recorded training data, if any, whose poles are the only candidates
    seed: int | None  # of random poles; None for other rules

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (*self.errors.values(), self.registry, *(() if self.edge is None else (self.edge,)))


def errors_step(work: Work, settings: ErrorsSettings) -> None:
    """Register the errors of the pretrained network in a region, as its vehicles report them to the edge server.

    Raises `InputError` for a task whose errors have no position.
    """
    task, region, pretrained = task_named(settings.task), settings.region, work.inputs[settings.pretrained]
    if not isinstance(task, RegistersErrors):
        raise InputError(f"placement.tasks: the errors of '{settings.task}' have no place in a town")
    drive = Frames.open(work.inputs[settings.registry])
    share = share_plan_budget(Plan.load(work.inputs[settings.plan]), settings.budgets_mb, settings.task)
    book = open_region_book(work, share, settings.pretrained, settings.vehicles, region)
    network = release_network(book, task, load_stage_network(task, pretrained), region, drive)
    threshold = Pretrained.load(pretrained).threshold
    lowest = THRESHOLD if threshold is None else threshold
    found = task.register_errors(network, drive.data, drive.vehicles, lowest, work.report)
    found = report_errors(book, task, found, region, drive)
    book.save(work.folder / LEDGER)
    save_errors(found.errors, work.folder / ERRORS)
    kinds = sorted({error.kind for error in found.errors})
    counts = {kind: sum(error.kind == kind for error in found.errors) for kind in kinds}
    ErrorRegistry(region, settings.task, counts, found.dropped).save(work.folder)


def place_step(work: Work, settings: PlaceSettings) -> None:
    """Place a region's roadside sensors by the errors and weights of each task."""
    drive = Frames.open(work.inputs[settings.registry])
    edge = None if settings.edge is None else Frames.open(work.inputs[settings.edge])
    sites = find_sites(drive, edge)
    found = {task: load_errors(work.inputs[step] / ERRORS) for task, step in settings.errors.items()}
    traces = read_traces(drive.data, drive.vehicles)
    passed = find_passed(sites, edge or drive, settings.how.group_range_m)
    rule = (settings.how, sites, found, settings.weights, traces, settings.seed or 0, passed)
    place_sensors(settings.region, *rule).save(work.folder)

"""The steps that register a region's errors and place its roadside sensors."""

from collections.abc import Iterator, Mapping

from flcav.config import InputError
from flcav.perception.errors import THRESHOLD, RegistersErrors, load_errors, save_errors
from flcav.perception.tasks import task_named
from flcav.runs.arms import Setting
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames
from flcav.runs.poles import find_passed, find_sites, place_sensors, read_traces
from flcav.runs.recipe import EDGE, Budgets, PlacementSettings
from flcav.runs.results.plans import ErrorRegistry, Plan
from flcav.runs.results.saved import ERRORS, LEDGER
from flcav.runs.results.training import Pretrained
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.recording import make_recording
from flcav.runs.stages.settings import StepSettings, make_step, open_region_book, share_plan_budget
from flcav.runs.training.learning import load_stage_network
from flcav.runs.training.messages import release_network, report_errors


class ErrorsSettings(StepSettings):
    """Settings of the registration of a task's errors in a region."""

    task: str
    region: str
    plan: str
    pretrained: str
    registry: str  # recording of the frames that errors are registered in
    vehicles: Mapping[str, int]  # number by federating region
    budgets_mb: Budgets  # of the run

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (self.pretrained, self.registry, self.plan)


class PlaceSettings(StepSettings):
    """Settings of the placement of a region's roadside sensors."""

    region: str
    how: PlacementSettings
    errors: Mapping[str, str]  # registrations of errors, by task
    weights: Mapping[str, float]  # of an error, by task
    registry: str  # recording of the traffic whose density counts
    edge: str | None  # recorded training data, if any, whose poles are the only candidates
    seed: int | None  # of random poles; None for other rules

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (*self.errors.values(), self.registry, *(() if self.edge is None else (self.edge,)))


def errors_step(work: Work, settings: ErrorsSettings) -> None:
    """Register the errors of the pretrained network in a region, which its vehicles report to the edge server.

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
    """Place a region's roadside sensors by the errors and weights of all tasks."""
    drive = Frames.open(work.inputs[settings.registry])
    edge = None if settings.edge is None else Frames.open(work.inputs[settings.edge])
    sites = find_sites(drive, edge)
    found = {task: load_errors(work.inputs[step] / ERRORS) for task, step in settings.errors.items()}
    traces = read_traces(drive.data, drive.vehicles)
    passed = find_passed(sites, edge or drive, settings.how.group_range_m)
    rule = (settings.how, sites, found, settings.weights, traces, settings.seed or 0, passed)
    place_sensors(settings.region, *rule).save(work.folder)


def list_placements(outline: Outline, arm: Setting, region: str) -> Iterator[Step]:
    """Yield the steps that register a region's errors, and that place an arm's sensors there."""
    recipe, names = outline.recipe, outline.names
    errors = {task: names.errors(arm.name, region, task) for task in arm.placement.tasks}
    for task, name in errors.items():
        settings = ErrorsSettings(
            task=task,
            region=region,
            plan=names.plan(arm.name),
            pretrained=names.pretrain(arm.name, task),
            registry=names.recording(region, "registry", task),
            vehicles=outline.vehicles,
            budgets_mb=recipe.budgets_mb,
        )
        yield make_step(name, errors_step, settings)
    recorded = recipe.regions[region].data is not None
    if recorded:
        yield make_recording(outline, region, EDGE, outline.placing_task)
    settings = PlaceSettings(
        region=region,
        how=arm.placement,
        errors=errors,
        weights={task: recipe.tasks[task].weight for task in errors},
        registry=names.recording(region, "registry", outline.placing_task),
        edge=names.recording(region, EDGE, outline.placing_task) if recorded else None,
        seed=recipe.seed if arm.placement.rule == "random" else None,
    )
    yield make_step(names.place(arm.name, region), place_step, settings)

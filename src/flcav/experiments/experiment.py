"""An experiment: a folder with a `run.py` whose `EXPERIMENT` has the functions that run it and tabulate its results.

The folder also has the experiment's page, `README.md`, and the numbers on it, `result.json`.
"""

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Generic, NamedTuple, TypedDict, TypeVar

from flcav.config import InputError, Json
from flcav.experiments import FOLDER, list_experiments
from flcav.interface.progress import Report
from flcav.interface.wording import suggest
from flcav.runs.engine import Notify
from flcav.runs.recipe import RunRecipe, load_run_recipe
from flcav.runs.results.run import Run
from flcav.runs.running import WORK, run_seeds
from flcav.sources.recipe import recipe_path
from flcav.storage.records import from_json, to_json
from flcav.world.opendrive.importing import import_town

Results = TypeVar("Results")
Resize = Callable[[RunRecipe], RunRecipe]

RUN = ("jobs", "engine", "stale")  # options of experiments that run as steps
STUDY = ("seeds", "scale", *RUN)  # options of experiments that run over seeds, as steps
OPTIONS = (*STUDY, "kitti", "data", "around", "weights")  # all


class HowToRun(TypedDict):
    """Keyword arguments of `flcav.runs.engine.run_steps`."""

    jobs: int
    notify: Notify
    stale: str
    engine: str


@dataclass(frozen=True)
class Options:
    """Options of `flcav reproduce`; `show_steps` and `show_progress` display progress in their contexts."""

    title: str  # name of the target
    seeds: int
    quick: bool  # whether to shrink it to minutes, as a trial
    jobs: int
    engine: str
    stale: str
    show_steps: Callable[[str], AbstractContextManager[Notify]]
    show_progress: Callable[[str], AbstractContextManager[Report]]
    kitti: Path | None = None
    data: Path | None = None
    around: bool = False
    weights: Path | None = None

    def how(self, notify: Notify) -> HowToRun:
        """Return the keyword arguments of `run_steps`."""
        return {"jobs": self.jobs, "notify": notify, "stale": self.stale, "engine": self.engine}

    def load(self, name: str, resize: Resize) -> RunRecipe:
        """Return the package's recipe `runs/NAME`, shrunk by `resize` if quick."""
        recipe = load_run_recipe(recipe_path(f"runs/{name}"))
        return resize(recipe) if self.quick else recipe

    def run_seeds(self, recipe: RunRecipe, out: Path, beside: Path | None = None) -> tuple[Run, ...]:
        """Run or finish a recipe with all seeds in the folder `out`; imported towns are searched in `beside`."""
        with self.show_steps(self.title) as notify:
            runs, _ = run_seeds(recipe, out, seeds=self.seeds, beside=beside, **self.how(notify))
        return runs


class Outcome(NamedTuple, Generic[Results]):
    """The outcome of an experiment: results, PNG files by name, and sentences for the terminal."""

    results: Results
    pictures: Mapping[str, bytes]
    sentences: Sequence[str] = ()


@dataclass(frozen=True)
class Experiment(Generic[Results]):
    """An experiment: the function that runs it, and that which makes the Markdown tables of its page."""

    results: type[Results]  # a dataclass, the content of result.json
    run: Callable[[Path, Options], Outcome[Results]]  # runs or finishes it in a folder
    tables: Callable[[Results], Mapping[str, str]]
    seeds: int = 3  # without `--seeds`
    takes: tuple[str, ...] = STUDY  # supported options, of `OPTIONS`
    recipe: str | None = (
        None  # name of the package's recipe of runs that `results` have as their `recipe`, as committed
    )

    def encode(self, results: Results) -> Json:
        """Return results as a JSON value."""
        return to_json(results, self.results)

    def tabulate(self, values: Json, origin: str) -> Mapping[str, str]:
        """Return the tables of encoded results, by name.

        Raises `InputError`, naming `origin`, for invalid ones, and for those of another recipe.
        """
        if self.recipe is not None:
            check_recipe(values, self.recipe, origin)
        return self.tables(from_json(self.results, values, origin))


def check_recipe(values: Json, name: str, origin: str) -> None:
    """Raise `InputError` where results are of other settings than the package's recipe `runs/NAME` states.

    Fields that the recipe leaves to their defaults are not compared: results keep those of their day. Nor are seed and
    size, which are the command's.
    """
    recipe = load_run_recipe(recipe_path(f"runs/{name}"))
    stated = recipe.model_dump(mode="json", exclude={"seed", "size"}, exclude_unset=True)
    held = values.get("recipe") if isinstance(values, Mapping) else None
    if (differs := _find_difference(stated, held, "")) is not None:
        raise InputError(f"{origin}: of another recipe than recipes/runs/{name}.yaml, which has {differs}")


def _find_difference(stated: Json, held: Json, field: str) -> str | None:
    """Return the first stated field that is not held with the same value, in words; None where all are."""
    if not isinstance(stated, Mapping):
        return None if stated == held else f"{field.removeprefix('.')}: {stated}, and not {held}"
    for name, value in stated.items():
        inside = held.get(name) if isinstance(held, Mapping) else None
        if (differs := _find_difference(value, inside, f"{field}.{name}")) is not None:
            return differs
    return None


def load_experiment(name: str) -> Experiment:
    """Return the experiment with the name of a target, or in a user's folder.

    Raises `InputError` for an unknown name, and for a folder whose `run.py` is missing or cannot be imported, or whose
    name is that of another module.
    """
    known = list_experiments()
    folder = known.get(name, Path(name)).resolve()
    if not (folder / "run.py").is_file():
        raise InputError(
            f"reproduce '{name}': neither a folder with a run.py nor one of {', '.join(known)}{suggest(name, known)}"
        )
    try:
        loaded = _import_own(folder) if (place := _place(folder)) is None else importlib.import_module(place)
    except ModuleNotFoundError as error:
        raise InputError(f"{folder / 'run.py'}: needs {error.name}, which is not there") from None
    found = getattr(loaded, "EXPERIMENT", None)
    if not isinstance(found, Experiment):
        raise InputError(f"{folder / 'run.py'}: has no EXPERIMENT, an Experiment of flcav.experiments.experiment")
    return found


def _place(folder: Path) -> str | None:
    """Return the module of the experiment in a folder of `FOLDER`; None for another folder."""
    root = FOLDER.resolve()
    return ".".join(("flcav.reproductions", *folder.relative_to(root).parts, "run")) if root in folder.parents else None


def _import_own(folder: Path) -> ModuleType:
    """Import a user's `run.py` as a module that worker processes can import, too."""
    if str(folder.parent) not in sys.path:
        sys.path.insert(0, str(folder.parent))
    try:
        loaded = importlib.import_module(f"{folder.name}.run")
    except Exception as error:
        raise InputError(f"{folder / 'run.py'}: cannot be imported ({type(error).__name__}: {error})") from None
    if Path(loaded.__file__ or "").resolve() != folder / "run.py":
        raise InputError(f"{folder}: a module '{folder.name}' is installed; give the folder another name")
    return loaded


def list_works(runs: Sequence[Run], out: Path) -> list[Path]:
    """Return the folders of steps of the runs that `Options.run_seeds` made in `out`."""
    return [out / f"seed{run.recipe.seed}" / WORK for run in runs]


def use_demo_size(recipe: RunRecipe) -> RunRecipe:
    """Return a recipe with the frames and steps of the demo."""
    return recipe.model_copy(update={"size": "demo"})


def shrink_recipe(recipe: RunRecipe) -> RunRecipe:
    """Return a recipe at toy size, for a trial, with plans that few frames from anywhere suffice for."""
    few = {"samples": 16, "edge_rounds": 1}
    tasks = {
        name: task.model_copy(
            update={"training": None, "plan": task.plan.model_copy(update=few) if task.plan else None}
        )
        for name, task in recipe.tasks.items()
    }
    anywhere = recipe.placement.model_copy(update={"group_range_m": 1000.0})  # [m] from a sensor
    changes = {"size": "toy", "splits": None, "training": None, "tasks": tasks, "placement": anywhere}
    return recipe.model_copy(update=changes)


def import_map(name: str, folder: Path) -> None:
    """Import recipes/maps/NAME.xodr as the town `folder`/NAME, unless that exists."""
    if not (folder / name).exists():
        import_town(recipe_path("runs/placement").parents[1] / "maps" / f"{name}.xodr", folder / name)

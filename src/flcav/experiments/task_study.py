"""The study of one task: frames recorded from recipes, a network per seed, each tested once on frames of other scenes.

The epoch that is kept is chosen on the validation frames; the test frames are used for nothing else.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from flcav.config import InputError, read_yaml
from flcav.dataset.store import Dataset
from flcav.experiments.recording import opened, record_split
from flcav.intervals import mean_over_seeds
from flcav.perception.task import Task
from flcav.perception.training.run import WEIGHTS, Request, train_network
from flcav.perception.weights import load_network
from flcav.pipeline.provenance import provenance
from flcav.pipeline.steps import Notify, Step, Work, run_steps
from flcav.sources.recipe import recipe_path

RecipeFields = Mapping[str, Any]  # of a `Recipe`, as YAML has it
Result = Mapping[str, Any]  # of `Task.evaluate`, and the extra numbers
SCALES = ("full", "quick")
VALIDATION = "validation"


@dataclass(frozen=True)
class Study:
    """What is recorded, trained and tested; functions are module-level ones, since steps run in other processes.

    Fields that two studies are not compared by are of no step: what they reach makes none stale.
    """

    task: Task[Any, Any, Any]
    network: str  # name of the configuration
    train: tuple[RecipeFields, ...]
    validation: RecipeFields
    tests: Mapping[str, RecipeFields]  # by name
    epochs: int
    patience: int
    numbers: Callable[[Result], Mapping[str, float]] = field(compare=False)  # those of a test that are averaged
    draw: Callable[[Mapping[str, Any]], bytes] = field(compare=False)  # results -> PNG
    extra: Mapping[str, Callable[[Any, Dataset], dict[str, Any]]] = field(default_factory=dict)  # by name of the test
    quick_scenes: int = 2  # of every recipe at the quick scale
    quick_epochs: int = 1

    def learn(self, work: Work, *, seed: int, network: str, epochs: int, patience: int) -> dict[str, Any]:
        """Train one seed, going on where an interrupted run left off; return its card."""
        data = [opened(work, step) for step in _training_steps(self)]
        request = Request(data, opened(work, VALIDATION), network, epochs, patience, seed)
        return train_network(self.task, request, work.folder, work.report).model_dump(mode="json")

    def test(self, work: Work, *, seed: int) -> dict[str, Any]:
        """Return what the network of one seed reaches on each test."""
        network = load_network(self.task, work.inputs[_seed_step(seed)] / WEIGHTS)
        return {name: self._tested(name, network, opened(work, _test_step(name)), work) for name in self.tests}

    def _tested(self, name: str, network: Any, data: Dataset, work: Work) -> dict[str, Any]:
        result = self.task.evaluate(network, data, progress=work.report)
        return result | (self.extra[name](network, data) if name in self.extra else {})


def recipe_of(name: str) -> RecipeFields:
    """Return the fields of a recipe that comes with flcav as YAML has them, without its split: a study has its own."""
    fields = read_yaml(recipe_path(name))
    assert isinstance(fields, dict)
    return {field: value for field, value in fields.items() if field != "split"}


def run_study(
    study: Study,
    out: Path,
    *,
    seeds: Sequence[int],
    scale: str = "full",
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
) -> dict[str, Any]:
    """Run what of the study is not done yet in `out`, as `run_steps`; return its numbers: of seeds, and their means.

    Raises `InputError` for an unknown scale, and where `out` holds another study.
    """
    study = at_scale(study, scale)
    values = run_steps(steps_of(study, seeds), out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    runs = [{"seed": seed, "card": values[_seed_step(seed)], "tests": values[_tested_step(seed)]} for seed in seeds]
    return {
        "task": study.task.name,
        "network": study.network,
        "scale": scale,
        "epochs": study.epochs,
        "patience": study.patience,
        "recipes": {"train": list(study.train), VALIDATION: study.validation, "tests": dict(study.tests)},
        "seeds": runs,
        "summary": {name: _mean([run["tests"][name] for run in runs], study.numbers) for name in study.tests},
        "provenance": asdict(provenance()),
    }


def training_rows(results: Mapping[str, Any]) -> list[tuple[int, int, int, str]]:
    """Return of each seed of a study's results: its number, samples, steps, and the score after each epoch."""
    rows = []
    for run in results["seeds"]:
        card = run["card"]
        scores = ", ".join(f"{score:.2f}" for score in card["training"]["scores"])
        rows.append((run["seed"], card["samples"], card["training"]["steps"], scores))
    return rows


def at_scale(study: Study, scale: str) -> Study:
    """Return the study as it stands ("full") or in minutes ("quick"); raises `InputError` for another scale."""
    if scale not in SCALES:
        raise InputError(f"scale '{scale}': a task's study knows {' and '.join(SCALES)}")
    if scale == "full":
        return study

    def few(recipe: RecipeFields) -> RecipeFields:
        return {**recipe, "scenes": min(recipe["scenes"], study.quick_scenes)}

    return replace(
        study,
        train=tuple(few(recipe) for recipe in study.train),
        validation=few(study.validation),
        tests={name: few(recipe) for name, recipe in study.tests.items()},
        epochs=study.quick_epochs,
    )


def steps_of(study: Study, seeds: Sequence[int]) -> list[Step]:
    """Return the steps: a recording per recipe, a training and a test per seed."""
    recipes = dict(zip(_training_steps(study), study.train, strict=True)) | {VALIDATION: study.validation}
    tests = {_test_step(name): recipe for name, recipe in study.tests.items()}
    steps = [Step(name, record_split, {"recipe": recipe}) for name, recipe in {**recipes, **tests}.items()]
    trained = {"network": study.network, "epochs": study.epochs, "patience": study.patience}
    for seed in seeds:
        steps.append(Step(_seed_step(seed), study.learn, {"seed": seed, **trained}, tuple(recipes)))
        steps.append(Step(_tested_step(seed), study.test, {"seed": seed}, (_seed_step(seed), *tests)))
    return steps


def _training_steps(study: Study) -> list[str]:
    return [f"train-{number}" for number in range(len(study.train))]


def _test_step(name: str) -> str:
    return f"test-{name}"


def _seed_step(seed: int) -> str:
    return f"seed-{seed}"


def _tested_step(seed: int) -> str:
    return f"seed-{seed}-tested"


def _mean(results: Sequence[Result], numbers: Callable[[Result], Mapping[str, float]]) -> dict[str, dict[str, float]]:
    rows = [numbers(result) for result in results]
    return {name: mean_over_seeds([row[name] for row in rows]) for name in rows[0] if all(name in row for row in rows)}

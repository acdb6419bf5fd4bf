"""Study of one task: record the splits, train a network per seed, and test it once on frames of other scenes.

The best epoch is chosen on the validation frames; the test frames are used for nothing else. All seeds train on the
same recordings but have different test recordings, so that intervals over seeds cover training and test scenes, but not
the choice of the training scenes.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar, cast, get_type_hints

from flcav.config import InputError, Json, parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.perception.study import RecipeFields, Studied, StudyRecipe, test_seed
from flcav.perception.task import Evaluated, Task
from flcav.perception.training.run import WEIGHTS, TrainingRequest, train_network
from flcav.perception.weights import Card, load_network
from flcav.plugins import load_named
from flcav.report import style
from flcav.report.charts.studies import Bar, precisions
from flcav.runs.engine import Notify, Step, Work, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.power import MOST_SEEDS, plan_seeds
from flcav.statistics.seeds import LEVEL, MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import Claim

EvaluationT = TypeVar("EvaluationT", bound=Evaluated)
VALIDATION = "validation"
DATA = "data"  # folder of a recording in its step's folder


@dataclass(frozen=True)
class SeedResult(Generic[EvaluationT]):
    """The results of one seed: the card of its network, and its evaluations."""

    seed: int
    card: Card
    tests: Mapping[str, EvaluationT]  # by name of the test
    test_seeds: Mapping[str, int]  # seeds of its test recordings, by name of the test


@dataclass(frozen=True)
class StudyRecordings:
    """The recording recipes of all splits."""

    train: tuple[RecipeFields, ...]
    validation: RecipeFields
    tests: Mapping[str, RecipeFields]  # by name; with the seeds `SeedResult.test_seeds`


@dataclass(frozen=True)
class StudyResult(Generic[EvaluationT]):
    """The results of a study: per seed, and means over seeds."""

    task: str
    network: str
    scale: str
    epochs: int
    patience: int
    recipes: StudyRecordings
    seeds: tuple[SeedResult[EvaluationT], ...]
    summary: Mapping[str, Mapping[str, MeanOverSeeds]]  # by test and name of the number
    provenance: Provenance

    def tested(self, test: str) -> list[EvaluationT]:
        """Return the evaluations of a test, one per seed."""
        return [seed.tests[test] for seed in self.seeds]


def _never(name: str) -> bool:
    return False


@dataclass(frozen=True)
class Study(Generic[EvaluationT]):
    """A study: task, recipe, and functions that summarise and draw its results.

    Functions must be module-level, since steps run in other processes. Fields with `compare=False` are not part of the
    steps' code: changes of the code that they call make no step stale.
    """

    task: Task
    recipe: StudyRecipe
    draw: Callable[[StudyResult[EvaluationT]], bytes] = field(compare=False)  # PNG of the results
    extra: Mapping[str, Callable[[EvaluationT, Any, Dataset], EvaluationT]] = field(default_factory=dict)  # by test
    is_share: Callable[[str], bool] = field(default=_never, compare=False)  # whether a number, by name, lies in [0, 1]

    @property
    def evaluation(self) -> type[EvaluationT]:
        """Return the annotated return class of the task's `evaluate`; raises `InputError` without one."""
        found = get_type_hints(self.task.evaluate).get("return")
        if not (isinstance(found, type) and issubclass(found, Evaluated) and is_dataclass(found)):
            raise InputError(f"task '{self.task.name}': its evaluate() has no annotation of the dataclass it returns")
        return cast("type[EvaluationT]", found)

    def learn(self, work: Work, *, seed: int, network: str, epochs: int, patience: int) -> Json:
        """Train the network of one seed, or resume its training; return its card as JSON."""
        data = [open_split(work.inputs[step]) for step in _training_steps(self)]
        request = TrainingRequest(data, open_split(work.inputs[VALIDATION]), network, epochs, patience, seed)
        return train_network(self.task, request, work.folder, work.report).model_dump(mode="json")

    def test(self, work: Work, *, seed: int) -> Json:
        """Return the evaluations of one seed's network as JSON, by test."""
        network = load_network(self.task, work.inputs[_seed_step(seed)] / WEIGHTS)
        return {
            name: self._tested(name, network, open_split(work.inputs[_test_step(seed, name)]), work)
            for name in self.recipe.tests
        }

    def _tested(self, name: str, network: Any, data: Dataset, work: Work) -> Mapping[str, Json]:
        result = self.task.evaluate(network, data, progress=work.report)
        assert isinstance(result, self.evaluation)
        more = self.extra.get(name)
        return (more(result, network, data) if more else result).as_json()


def run_study(
    study: Study[EvaluationT],
    out: Path,
    *,
    seeds: Sequence[int],
    scale: str = "full",
    jobs: int,
    notify: Notify,
    stale: str = "refuse",
    engine: str = "processes",
) -> StudyResult[EvaluationT]:
    """Run or finish a study in the folder `out` by `run_steps`; return its results.

    Raises `InputError` for an unknown scale, where `out` has another study, and where the task's `evaluate` lacks the
    annotation of its return class.
    """
    recipe = study.recipe.at_scale(scale)
    study = replace(study, recipe=recipe)
    assert study.evaluation  # raises before hours of work
    values = run_steps(steps_of(study, seeds), out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    runs = tuple(_seed_result(study, seed, values) for seed in seeds)
    return StudyResult(
        study.task.name,
        recipe.network,
        scale,
        recipe.epochs,
        recipe.patience,
        StudyRecordings(recipe.train, recipe.validation, recipe.tests),
        runs,
        summarise_seeds(study, runs),
        provenance(),
    )


def make_experiment(
    study: Study[EvaluationT], tables: Callable[[StudyResult[EvaluationT]], Mapping[str, str]]
) -> Experiment[StudyResult[EvaluationT]]:
    """Return the experiment of a study; `tables` gets its results with recomputed means over seeds."""

    def run(out: Path, options: Options) -> Outcome[StudyResult[EvaluationT]]:
        seeds = range(1, options.seeds + 1)
        scale = "quick" if options.quick else "full"
        with options.show_steps(options.title) as notify:
            results = run_study(study, out, seeds=seeds, scale=scale, **options.how(notify))
        return Outcome(results, {f"{study.task.name}.png": study.draw(results)}, describe_summary(results))

    return Experiment(
        results=StudyResult[study.evaluation],  # pyright: ignore[reportInvalidTypeArguments]
        run=run,
        tables=lambda results: tables(replace(results, summary=summarise_seeds(study, results.seeds))),
    )


def load_own_study(name: str) -> Study:
    """Return a user's study `module:NAME`, or the study of a user's task; raises `InputError` if there is none."""
    loaded = load_named("study", name, {}, object)
    if isinstance(loaded, Study):
        return loaded
    if not isinstance(loaded, Studied):
        raise InputError(f"study '{name}': is neither a study nor a task with a study()")
    return Study(load_named("task", name, {}, Task), loaded.study(), draw=draw_numbers)


def draw_numbers(results: StudyResult) -> bytes:
    """Return a PNG with a panel per test: means over seeds as bars, single seeds as dots."""
    panels = {
        test: [
            Bar(name, mean.mean, tuple(found.numbers()[name] for found in results.tested(test)))
            for name, mean in means.items()
        ]
        for test, means in results.summary.items()
    }
    return style.png(precisions(panels, label="mean over seeds"))


def describe_summary(results: StudyResult) -> list[str]:
    """Return the means over seeds of all numbers in words."""
    return [
        f"{test}, {name}: {value.describe()}"
        + (f", standard deviation over seeds {value.sd:.3f}" if value.seeds > 1 else "")
        for test, numbers in results.summary.items()
        for name, value in numbers.items()
    ]


def summarise_seeds(
    study: Study[EvaluationT], seeds: Sequence[SeedResult[EvaluationT]]
) -> dict[str, dict[str, MeanOverSeeds]]:
    """Return means over seeds by test and name, of the numbers that all seeds have."""
    return {test: _means(study, [seed.tests[test] for seed in seeds]) for test in seeds[0].tests}


def training_rows(results: StudyResult[EvaluationT]) -> list[tuple[int, int, int, str]]:
    """Return a row per seed of a study: seed, samples, optimiser steps, and the scores after the epochs."""
    rows = []
    for run in results.seeds:
        scores = ", ".join(f"{score:.2f}" for score in run.card.learning.scores)
        rows.append((run.seed, run.card.samples, run.card.learning.steps, scores))
    return rows


def describe_limits(aims: Collection[Claim], effect: float) -> list[str]:
    """Return a sentence on the findings' power: the seeds needed to detect a deviation of `effect` from an aim."""
    widest = max(aim.mean.sd for aim in aims)
    if not widest:  # one seed
        return []
    seeds = plan_seeds(effect, widest, LEVEL / len(aims))
    count = f"more than {MOST_SEEDS}" if seeds is None else seeds
    at = "At the largest of these standard deviations"
    return [f"{at}, detecting a deviation of {effect} from an aim takes {count} seeds."]


def list_counts(counts: Sequence[int]) -> str:
    """Return counts per seed as text, or a single count if all are equal."""
    return ", ".join(map(str, counts if len(set(counts)) > 1 else counts[:1]))


def steps_of(study: Study, seeds: Sequence[int]) -> list[Step]:
    """Return the steps of a study: recordings to train on, and a training, test recordings and a test per seed."""
    recipe = study.recipe
    recipes = dict(zip(_training_steps(study), recipe.train, strict=True)) | {VALIDATION: recipe.validation}
    steps = [_recording(name, fields) for name, fields in recipes.items()]
    trained = {"network": recipe.network, "epochs": recipe.epochs, "patience": recipe.patience}
    for seed in seeds:
        tests = {_test_step(seed, name): fields for name, fields in recipe.tests_of(seed).items()}
        steps += [_recording(name, fields) for name, fields in tests.items()]
        steps.append(Step(_seed_step(seed), study.learn, {"seed": seed, **trained}, tuple(recipes)))
        steps.append(Step(_tested_step(seed), study.test, {"seed": seed}, (_seed_step(seed), *tests)))
    return steps


def _recording(name: str, recipe: RecipeFields) -> Step:
    return Step(name, record_split, {"recipe": recipe})


def _training_steps(study: Study) -> list[str]:
    return [f"train-{number}" for number in range(len(study.recipe.train))]


def _test_step(seed: int, name: str) -> str:
    return f"seed-{seed}-test-{name}"


def _seed_step(seed: int) -> str:
    return f"seed-{seed}"


def _tested_step(seed: int) -> str:
    return f"seed-{seed}-tested"


def _seed_result(study: Study[EvaluationT], seed: int, values: Mapping[str, Any]) -> SeedResult[EvaluationT]:
    tests = values[_tested_step(seed)]
    evaluations = {name: study.evaluation.from_json(tests[name], f"test on {name}") for name in study.recipe.tests}
    recorded = {name: test_seed(fields, seed) for name, fields in study.recipe.tests.items()}
    return SeedResult(seed, Card.model_validate(values[_seed_step(seed)]), evaluations, recorded)


def _means(study: Study[EvaluationT], tested: Sequence[EvaluationT]) -> dict[str, MeanOverSeeds]:
    rows = [each.numbers() for each in tested]
    common = [name for name in rows[0] if all(name in row for row in rows)]
    return {name: mean_over_seeds([row[name] for row in rows], share=study.is_share(name)) for name in common}


def record_split(work: Work, recipe: RecipeFields) -> dict[str, int]:
    """Record one split by its recipe; return {"frames": number of frames}."""
    source = EmbeddedSource(parse_config(Recipe, recipe, work.folder.name))
    record(source, work.folder / DATA, progress=work.report)
    return {"frames": len(open_split(work.folder))}


def open_split(step: Path) -> Dataset:
    """Return the dataset of `record_split` in its step's folder."""
    return Dataset.open(step / DATA)

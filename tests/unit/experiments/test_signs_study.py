"""The study of the sign task: its amber lights, its tables and its picture."""

import pytest

from flcav.config import parse_config
from flcav.dataset.rectangles import SIGNS
from flcav.experiments.study import SeedResult, StudyRecordings, StudyResult
from flcav.perception.signs.evaluate import ClassPrecision, SignsEvaluation, SizePrecision
from flcav.perception.weights import Card
from flcav.reproductions.task_signs.run import STUDY, tables
from flcav.runs.provenance import provenance
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.seeds import mean_over_seeds

MISSING = frozenset({"stop", "speed_90"})  # in the held-out town


def evaluation(score: float, missing: frozenset[str] = frozenset()) -> SignsEvaluation:
    classes = tuple(
        ClassPrecision(name, None if name in missing else score, score / 2, targets=7 * (name not in missing))
        for name in SIGNS
    )
    sizes = (SizePrecision(6.0, 12.0, score - 0.1, targets=30), SizePrecision(24.0, None, score + 0.1, targets=26))
    return SignsEvaluation(score, score / 2, classes, sizes, neutral=0, pictures=9)


def results(*scores: float) -> StudyResult[SignsEvaluation]:
    facts = {"task": "signs", "network": "n", "parameters": 9, "seed": 1, "samples": 80, "data": [], "metrics": {}}
    names = list(STUDY.recipe.tests)
    seeds = tuple(
        SeedResult(
            seed,
            Card.model_validate({**facts, "training": {"steps": 20, "loss": 1.0, "scores": [0.1, score]}}),
            {names[0]: evaluation(score), names[1]: evaluation(score - 0.3, MISSING)},
            dict.fromkeys(names, seed),
        )
        for seed, score in enumerate(scores, start=1)
    )
    rows = {name: [seed.tests[name].numbers() for seed in seeds] for name in names}
    summary = {
        name: {key: mean_over_seeds([row[key] for row in of_seeds]) for key in of_seeds[0]}
        for name, of_seeds in rows.items()
    }
    return StudyResult("signs", "n", "full", 15, 15, StudyRecordings((), {}, {}), seeds, summary, provenance())


@pytest.mark.slow
def test_half_of_the_spins_see_amber():
    source = EmbeddedSource(parse_config(Recipe, {**STUDY.recipe.validation, "scenes": 1}, "study"))
    states = source.trace(source.scenes()[0]).light_state
    assert ((states == "y").any(1)).tolist() in ([True, False] * 2, [False, True] * 2)


def test_tables_have_every_class_and_size_and_leave_out_what_was_not_there():
    made = tables(results(0.8, 0.82, 0.78))
    assert "**reached**, 0.800" in made["findings"]
    assert "**not reached**, 0.500" in made["findings"]
    assert "| stop | 7 | 0.800 | 0 | |" in made["classes"]
    assert "| yield | 7 | 0.800 | 7 | 0.500 |" in made["classes"]
    assert "| 6 to 12 px | 30 | 0.700 | 30 | 0.400 |" in made["sizes"]
    assert "| 24 px on | 26 | 0.900 | 26 | 0.600 |" in made["sizes"]
    assert "| 2 | 80 | 20 | 0.10, 0.82 |" in made["training"]


def test_an_interval_around_what_was_wanted_decides_nothing():
    assert "**undecided**" in tables(results(0.6, 0.9))["findings"]


def test_the_picture_has_a_bar_for_each_number():
    assert ClassPrecision("light_red", None, None, 0).name == "light red"
    assert STUDY.draw(results(0.7, 0.8)).startswith(b"\x89PNG")

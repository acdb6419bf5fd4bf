"""The trajectory task's studies: what they record, their numbers, tables and picture."""

from dataclasses import replace

import numpy as np
import pytest

from flcav.experiments.study import SeedResult, StudyRecordings, StudyResult
from flcav.perception.trajectory.config import FUTURE, PAST
from flcav.perception.trajectory.evaluate import TrajectoryEvaluation, evaluate_paths
from flcav.perception.weights import Card
from flcav.reproductions.task_trajectory.run import CAMERAS, STUDY, tables
from flcav.runs.provenance import provenance
from flcav.statistics.seeds import mean_over_seeds


@pytest.mark.parametrize("study", [STUDY, CAMERAS])
def test_no_split_shares_a_scene(study):
    recipes = [*study.recipe.train, study.recipe.validation, *study.recipe.tests.values()]
    assert len({(recipe["town"], recipe["seed"]) for recipe in recipes}) == len(recipes)


def evaluated(off_m: float) -> TrajectoryEvaluation:
    """Return the evaluation of paths that end `off_m` to the side of a road user who stops 4 m ahead."""
    future = np.zeros((2, FUTURE, 2))
    future[..., 0] = np.minimum(np.arange(1, FUTURE + 1), 4)
    past = np.zeros((2, PAST + 1, 4))
    past[..., 3] = 4.0  # constant velocity ends 8 m off
    paths = np.stack((future, future), axis=1)
    paths[:, 0, :, 1] = off_m
    shares = np.tile((0.9, 0.1), (2, 1))
    return evaluate_paths(paths, shares, past, future, np.ones(2, np.bool_), np.array(["a", "b"]))


def results(*off_m: float) -> StudyResult[TrajectoryEvaluation]:
    facts = {"task": "trajectory", "network": "tiny", "parameters": 9, "seed": 1, "samples": 9, "data": []}
    runs = []
    for seed, off in enumerate(off_m):
        found = evaluated(off)
        card = Card.model_validate({**facts, "training": {"steps": 7, "loss": 1.5}, "metrics": found.as_json()})
        runs.append(SeedResult(seed, card, {"held-out scenes": found}, {"held-out scenes": seed}))
    rows = [evaluated(off).numbers() for off in off_m]
    means = {name: mean_over_seeds([row[name] for row in rows]) for name in rows[0]}
    nothing = StudyRecordings((), {}, {})
    return StudyResult(
        "trajectory", "tiny", "full", 3, 3, nothing, tuple(runs), {"held-out scenes": means}, provenance()
    )


@pytest.mark.parametrize(
    ("off_m", "verdict"), [((4.0, 4.1), "reached"), ((8.0, 8.1), "not reached"), ((4.0, 8.0), "undecided")]
)
def test_a_finding_names_its_verdict(off_m, verdict):
    found = tables(results(*off_m))["findings"]
    assert f"**{verdict}**, {np.mean(off_m) / 8:.3f}" in found
    assert "the best ends 0.00 m off, constant velocity 8.00 m" in found


def test_cameras_are_measured_against_constant_velocity_too():
    found = tables(replace(results(7.0, 7.1), network="tiny-cameras"))["findings"].splitlines()
    assert [line.split("**")[1] for line in found[:2]] == ["reached", "not reached"]
    assert "detecting a deviation of 0.05 from an aim takes" in found[2]


def test_errors_have_a_row_for_each_slice_and_predictor():
    lines = tables(results(4.0, 4.1))["errors"].splitlines()[2:]
    assert len(lines) == 2 * 4  # nobody turns
    assert lines[0].startswith("| held-out scenes | all (2) | single path | 4.05 | 4.050")


def test_the_picture_shows_every_test():
    assert STUDY.draw(results(4.0, 4.1)).startswith(b"\x89PNG")

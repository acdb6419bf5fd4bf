"""What federated learning costs in the town of pretraining, from outcomes per frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flcav.perception.metrics import Matches
from flcav.perception.objects.evaluate import CLASSES, HIDDEN, KEPT
from flcav.perception.outcomes import (
    Counted,
    Counts,
    Outcomes,
    as_measurable,
    count_once,
    difference,
    further_measures,
)
from flcav.perception.tasks import TASKS, task_named
from flcav.runs.analysis.costs import list_home_costs
from flcav.runs.results.run import Run
from flcav.runs.results.tests import HomeCost
from flcav.runs.running import RESULTS
from flcav.statistics.estimates import Estimate

RUNS = Path(__file__).parents[3] / "reproductions" / "runs"
OBJECTS = task_named("objects")


def outcomes(found: dict[str, float]) -> Outcomes:
    """Return outcomes of 24 frames of 8 scenes with two cars each, a share of which is found by kind of overlap."""
    rng = np.random.default_rng(5)
    arrays = {CLASSES: np.array(["Car"]), HIDDEN: np.zeros(1, dtype=np.int64)}
    chance, score = rng.random(48), np.sort(rng.random(48))[::-1]
    for key in KEPT:
        hit = chance < found[key]
        columns = {"frame": np.repeat(np.arange(24), 2), "score": score, "hit": hit, "targets": np.full(24, 2)}
        fields = {name: columns.get(name, np.zeros(48)) for name in Matches.__dataclass_fields__}
        arrays |= {f"Car/{key}/{name}": value for name, value in fields.items()}
    return Outcomes(np.repeat([f"scene {n}" for n in range(8)], 3), arrays)


def test_the_further_measure_of_objects_is_their_ap70_with_a_paired_interval() -> None:
    before, after = (outcomes({"3d50": 0.9, "bev50": 0.9, "3d70": share}) for share in (0.8, 0.3))
    ((name, measure),) = further_measures(OBJECTS).items()
    assert count_once(measure, before) == as_measurable(OBJECTS).numbers(before)[name]
    mean, low, high = difference(OBJECTS, before, after, 1, measure)
    assert mean == pytest.approx(count_once(measure, after) - count_once(measure, before))
    assert low is not None
    assert high is not None
    assert low < mean < high < 0
    assert difference(OBJECTS, before, after, 1)[0] == 0  # the task's own measure


def test_tasks_without_further_measures_have_none() -> None:
    assert {name for name in TASKS if further_measures(task_named(name))} == {"objects", "road"}


def test_results_tell_the_cost_of_every_measure_at_home() -> None:
    run = Run.load(RUNS / "demo/earlier/road", RESULTS)
    own, further = list_home_costs(replace(run, home=None))
    assert (own.region, own.measure, own.trainings) == ("suburb", "AP50", 1)
    assert own.difference == next(each.estimate for each in run.differences if each.region == "suburb")
    assert (further.measure, further.difference.low) == ("AP70", None)
    assert further.difference.mean == pytest.approx(further.after - further.before)
    assert further.difference.mean < -0.4
    kept = HomeCost("suburb", "objects", "AP70", 0.5, 0.1, Estimate(-0.4, -0.5, -0.3), 3)
    assert list_home_costs(replace(run, home=(kept,))) == [own, kept]
    again = Run.from_json(replace(run, home=(kept,)).as_json(), "again")
    assert again.home == (kept,)


def test_found_and_false_are_counted_from_the_score_at_which_errors_are_registered() -> None:
    tested = outcomes({"3d50": 0.7, "bev50": 0.9, "3d70": 0.3})
    assert isinstance(OBJECTS, Counts)
    score, hit = tested.arrays["Car/3d50/score"], tested.arrays["Car/3d50/hit"]
    found = sum(1 for s, h in zip(score, hit, strict=True) if s >= 0.3 and h)
    false = sum(1 for s, h in zip(score, hit, strict=True) if s >= 0.3 and not h)
    assert 0 < false < found
    assert OBJECTS.count(tested) == Counted("cars", 48, found, false)
    weather = task_named("weather")
    assert isinstance(weather, Counts)
    named = Outcomes(np.array(["a", "a", "b"]), {"truth": np.array([0, 1, 2]), "named": np.array([0, 2, 2])})
    assert weather.count(named) == Counted("pictures", 3, 2, None)

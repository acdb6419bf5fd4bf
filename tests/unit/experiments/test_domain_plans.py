"""Plans by the importance of tasks in two domains: weights, spoilt perception, and differences over scenarios."""

from dataclasses import replace

import pytest

from flcav.driving.errors import load_error_model
from flcav.driving.measures import DriveResult
from flcav.driving.studies.importance import TaskImportance
from flcav.optimization.curves.fitting import fit
from flcav.reproductions.domain_plans.run import (
    LEAST_WEIGHT,
    lead_over_scenarios,
    list_scenarios,
    plan_tasks,
    spoil,
    weigh_tasks,
)
from flcav.reproductions.fig6b.run import TASKS
from flcav.runs.tables import load_known_history

DRIVE = DriveResult("a", 851, 12.0, 0.5, 6.0, 2.0, 0.1, 0, 0, (), 0.5)


def test_both_domains_have_the_same_towns_and_events() -> None:
    clear, fog = (list_scenarios(domain, 16) for domain in ("clear", "fog"))
    assert {each.weather for each in fog} == {"fog"}
    assert [(each.town, each.event) for each in clear] == [(each.town, each.event) for each in fog]
    assert len({(each.town, each.event) for each in clear}) == 16


def test_a_task_that_is_not_missed_keeps_a_least_weight() -> None:
    weights = weigh_tasks([TaskImportance(task, "", {}, weight) for task, weight in zip(TASKS, (0.75, 0.25, 0.0))])
    assert sum(weights.values()) == pytest.approx(1)
    assert weights["weather"] == pytest.approx(LEAST_WEIGHT / (1 + LEAST_WEIGHT))
    assert weights["objects"] == pytest.approx(3 * weights["signs"])


def test_rates_are_multiplied_and_misread_weather_is_any_other() -> None:
    model = load_error_model()
    worse = spoil(model, {"objects": 0.5, "signs": 0.25, "weather": 0.3})
    assert worse.detected["Car"] == pytest.approx([0.5 * rate for rate in model.detected["Car"]])
    assert worse.lights == pytest.approx((0.25 * model.lights[0], model.lights[1]))
    fog = model.weather["fog"]
    assert worse.weather["fog"]["fog"] == pytest.approx(0.3 * fog["fog"])
    assert worse.weather["fog"]["night"] == pytest.approx(fog.get("night", 0.0) + 0.7 * fog["fog"] / 7)
    assert all(sum(read.values()) == pytest.approx(1) for read in worse.weather.values())
    assert spoil(model, dict.fromkeys(TASKS, 1.0)).detected == model.detected


def test_a_lead_is_over_scenarios_not_over_drives() -> None:
    own = [replace(DRIVE, scenario=name, score=score) for name, score in (("a", 0.5), ("a", 0.7), ("b", 0.4))]
    other = [replace(each, score=0.3) for each in own]
    lead = lead_over_scenarios(own, other)
    assert lead.seeds == 2
    assert lead.mean == pytest.approx((0.3 + 0.1) / 2)


@pytest.mark.slow
def test_a_plan_follows_the_weights() -> None:
    curves = {task: fit(load_known_history(task), model="best").curve for task in TASKS}
    objects, weather = (
        plan_tasks({task: 0.98 if task == first else 0.01 for task in TASKS}, curves)
        for first in ("objects", "weather")
    )
    assert objects.accuracy["objects"] > weather.accuracy["objects"]
    assert weather.accuracy["weather"] > objects.accuracy["weather"]
    assert all(0 < share <= 1 for share in objects.share.values())

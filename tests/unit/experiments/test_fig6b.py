"""Triangles of three tasks: their area, their intervals, and curves tested on sizes that they were not fitted to."""

from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import Polygon

from flcav.config import read_json
from flcav.optimization.curves.fitting import fit
from flcav.optimization.curves.history import History
from flcav.reproductions.fig6b.run import (
    RULES,
    TASKS,
    Plan,
    Triangles,
    compare_plans,
    leave_sizes_out,
    measure_area,
    tabulate_triangles,
)
from flcav.reproductions.plan_search.run import JOINT
from flcav.runs.tables import load_known_history

RESULTS = Path(__file__).parents[3] / "reproductions/fig6b/result.json"
FEW: Plan = dict.fromkeys(TASKS, (40, 2, 1))
MORE: Plan = dict.fromkeys(TASKS, (80, 8, 4))


def test_the_area_is_that_of_the_triangle_in_units_of_the_largest() -> None:
    angles = 2 * np.pi / 3 * np.arange(3)
    axes = np.column_stack((np.cos(angles), np.sin(angles)))
    for accuracies in np.random.default_rng(1).uniform(0, 1, (4, 3)):
        drawn = Polygon(accuracies[:, None] * axes).area / Polygon(axes).area
        assert measure_area(accuracies) == pytest.approx(drawn)


def test_intervals_are_paired_over_the_same_refitted_curves() -> None:
    curve = fit(load_known_history("weather"), model="additive").curve
    floors = (0.0, 0.01, 0.02, 0.05)
    curves = [curve.model_copy(update={"floor": curve.floor + more}) for more in floors]
    at = compare_plans({"max-throughput": FEW, "equal-stages": MORE, JOINT: MORE}, dict.fromkeys(TASKS, curves), 10.0)
    same, gain = at.gains["equal-stages"], at.gains["max-throughput"]
    assert (same.mean, same.low, same.high) == (0.0, 0.0, 0.0)
    accuracy, before = (1 - float(curve.error(*counts)) for counts in (MORE["signs"], FEW["signs"]))
    assert at.triangles[JOINT].accuracy["objects"] == pytest.approx(accuracy)
    assert at.triangles[JOINT].area.mean == pytest.approx(accuracy**2)
    drawn = [(accuracy - more) ** 2 - (before - more) ** 2 for more in floors[1:]]
    assert gain.mean == pytest.approx(accuracy**2 - before**2)
    assert (gain.low, gain.high) == pytest.approx(tuple(np.quantile(drawn, (0.025, 0.975))))


def test_a_size_is_predicted_from_the_others_alone() -> None:
    samples = np.repeat([10.0, 20.0, 40.0, 80.0, 160.0], 3)
    accuracy = 1 - samples**-0.3
    accuracy[samples == 80] -= 0.1  # as no other size foretells
    resources = np.column_stack((samples, np.zeros((len(samples), 2))))
    history = History(resources, accuracy, np.ones(len(samples)))

    found = {each.samples: each for each in leave_sizes_out("x", history, fit)}
    assert found[80].error == pytest.approx(0.1, abs=2e-3)
    assert found[80].inside < 0.09
    assert found[80].points == 3


def test_columns_of_committed_tables_are_those_of_their_heads() -> None:
    results = Triangles.from_json(read_json(RESULTS), "fig6b")
    head, _, first, *_ = tabulate_triangles(results)["gains"].splitlines()
    gains = results.budgets[0].gains
    assert [cell.strip() for cell in first.split("|")[2:-1]] == [
        gains[rule].describe(sign=True) for rule in RULES if f"joint - {rule}" in head
    ]

"""Pictures of experiments, drawn from their committed numbers, state spread, counts and units where they compare."""

import importlib
import re
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from flcav.config import read_json
from flcav.experiments import FOLDER
from flcav.experiments.experiment import load_experiment
from flcav.report import style
from flcav.report.charts.runs import name_measure
from flcav.statistics.seeds import MeanOverSeeds
from flcav.storage.records import from_json

DRAWN = {  # experiment -> module and function that draw it
    "cloud": ("cloud", "draw_cloud"),
    "corner_cases": ("corner_cases", "draw_corner_cases"),
    "demo_arms": ("demo_arms", "draw_arms"),
    "distillation": ("distillation", "draw_labels"),
    "federation/exchange": ("federation.exchange", "draw_results"),
    "federation/exchange_objects": ("federation.exchange", "draw_results"),
    "federation/leakage": ("federation.leakage", "draw_results"),
    "gap": ("gap", "draw_gap"),
    "lifelong": ("lifelong", "draw_lifelong"),
    "megabytes": ("megabytes", "draw_megabytes"),
    "networks": ("networks", "draw_networks"),
    "people": ("people", "draw_people"),
    "placement": ("placement", "draw_proof"),
    "plan_ranking": ("plan_ranking", "draw_ranking"),
    "pole_rules": ("pole_rules", "draw_rules"),
    "predictions": ("predictions", "draw_predictions"),
    "radio_labels": ("radio_labels", "draw_labels"),
    "real": ("real", "draw_networks"),
    "road_regions": ("road_regions", "draw"),
    "task_objects": ("task_objects", "_draw"),
    "task_signs": ("task_signs", "_draw"),
    "task_trajectory": ("task_trajectory", "_draw"),
    "vehicle_worth": ("vehicle_worth", "draw_worth"),
}
SPREAD = re.compile(r"95 %|range|(dots|circles): (\d+ )?(the )?seed")
COUNTED = re.compile(r"\d+ (seeds|trainings)|(dots|circles): (the seed|seeds)|number of targets")


def draw(name: str, monkeypatch: pytest.MonkeyPatch) -> tuple[list[Figure], Any]:
    """Return the figures of an experiment, before they become PNG files, and its results."""
    module, function = DRAWN[name]
    folder, figures = FOLDER / name, []

    def keep(figure: Figure, dpi: int = 200) -> bytes:
        figures.append(figure)
        return b""

    monkeypatch.setattr(style, "png", keep)
    results = from_json(load_experiment(str(folder)).results, read_json(folder / "result.json"), name)
    getattr(importlib.import_module(f"flcav.reproductions.{module}.run"), function)(results)
    return figures, results


@pytest.mark.parametrize("name", DRAWN)
def test_a_picture_that_compares_states_its_spread_its_counts_and_what_its_axes_are(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures, _ = draw(name, monkeypatch)
    assert figures
    for figure in figures:
        shown = [text for text in figure.findobj(Text) if isinstance(text, Text) and text.get_visible()]
        told = " ".join(text.get_text().replace("\n", " ") for text in shown)
        assert SPREAD.search(told), told
        assert COUNTED.search(told), told
        labels = [axes.get_xlabel() + axes.get_ylabel() for axes in figure.axes]
        assert any(labels) or figure.get_supxlabel()


@pytest.mark.parametrize("name", ["corner_cases", "demo_arms", "distillation", "gap", "people", "radio_labels"])
def test_a_forest_plot_draws_every_interval_and_says_of_how_many_seeds(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ((figure,), _) = draw(name, monkeypatch)
    for axes in figure.axes:
        drawn = [np.c_[line.get_xdata(), line.get_ydata()] for line in axes.get_lines()]
        spans = [tuple(ends[:, 0]) for ends in drawn if len(ends) == 2 and ends[0, 1] == ends[1, 1]]
        rows = [label.get_text() for label in axes.get_yticklabels()]
        assert len(spans) == len(rows)
        written = [text.get_text() for text in axes.texts if "–" in text.get_text()]
        assert written == [text for text in written if any(f"({low:.3f}–{high:.3f})" in text for low, high in spans)]
        assert len(written) == len(rows)
    label = figure.get_supxlabel() or figure.axes[-1].get_xlabel()
    assert re.search(r"\(mean of \d+ seeds, 95 % interval\)$", label)


def test_the_label_of_means_counts_their_seeds() -> None:
    five, eight = (MeanOverSeeds(0.5, 0.4, 0.6, seeds=count) for count in (5, 8))
    assert name_measure("AP50", [eight, eight]) == "AP50 (mean of 8 seeds, 95 % interval)"
    assert name_measure("AP50", [five, eight]) == "AP50 (mean of 5 to 8 seeds, 95 % interval)"
    assert name_measure("AP50", [MeanOverSeeds(0.5, 0.4, 0.6)]) == "AP50 (95 % interval)"


def test_conditions_are_drawn_in_the_order_in_which_they_came(monkeypatch: pytest.MonkeyPatch) -> None:
    ((figure,), results) = draw("lifelong", monkeypatch)
    assert sorted(results.conditions) != [*results.conditions]  # in the file they are sorted
    for axes in figure.axes:
        assert [label.get_text() for label in axes.get_xticklabels()] == ["start", *results.conditions]
    assert [axes.get_title(loc="left") for axes in figure.axes] == [f"tested in {name}" for name in results.conditions]

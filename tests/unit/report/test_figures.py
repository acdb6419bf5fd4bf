from collections.abc import Callable
from dataclasses import replace

import made_up_run
import matplotlib
import numpy as np
import pytest
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.text import Text

from flcav.report import style
from flcav.report.charts import figures
from flcav.report.charts.placement import draw_correlations
from flcav.report.charts.studies import Bar, precision_table
from flcav.report.pictures import perspective
from flcav.report.pictures.changes import GONE, NEW, REMAINING, draw_changes
from flcav.report.pictures.maps import DENSEST, MOST_VISIBLE
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds
from flcav.world.geodesy import find_on_ground
from flcav.world.line_of_sight import Viewshed
from flcav.world.sites import list_street_names

TESTED, ROUNDS = made_up_run.chart_rows(), made_up_run.rounds()
BUDGETS, SENT = made_up_run.BUDGETS, made_up_run.sent()
REACHED = {"pretrained": 0.41, "edge FL": 0.5, "oracle": 0.57}
ARMS = {
    town: {arm: MeanOverSeeds(ap50, ap50 - 0.03, ap50 + 0.04) for arm, ap50 in REACHED.items()}
    for town in ("grid", "ring")
}

DRAWN: dict[str, Callable[[], Figure]] = {
    "town_map": lambda: figures.town_map(made_up_run.error_map()),
    "changes": lambda: draw_changes(made_up_run.changes()),
    "before_after": lambda: perspective.before_after(made_up_run.sweep()),
    "by_round": lambda: figures.by_round(ROUNDS, TESTED, "AP50"),
    "megabytes": lambda: figures.megabytes(SENT, BUDGETS),
    "arms": lambda: figures.arms(ARMS),
    "overview": lambda: figures.overview(made_up_run.changes(), made_up_run.sweep(), TESTED, "AP50"),
}


@pytest.mark.parametrize("name", DRAWN)
def test_pictures_are_legible_repeatable_and_leave_no_state(name: str) -> None:
    before = dict(matplotlib.rcParams)
    figure = DRAWN[name]()
    picture = style.png(figure, dpi=50)
    assert dict(matplotlib.rcParams) == before
    assert picture.startswith(b"\x89PNG")
    assert style.png(DRAWN[name](), dpi=50) == picture
    shown = [text for text in figure.findobj(Text) if isinstance(text, Text) and text.get_visible() and text.get_text()]
    assert min(float(text.get_fontsize()) for text in shown) >= 9


def test_the_map_shows_every_error_once_and_the_reach_of_the_chosen_pole() -> None:
    scene = made_up_run.error_map()
    axes = figures.town_map(scene).axes[0]
    by_label = {str(line.get_label()): line for line in axes.get_lines()}
    for kind, name in (("miss", "missed"), ("false_positive", "false positive")):
        own = scene.kind == kind
        label = f"{name} ({own.sum()})"
        np.testing.assert_allclose(np.column_stack(by_label[label].get_data()), scene.errors[own, :2])
    rim = next(patch for patch in axes.patches if isinstance(patch, Circle) and not patch.get_fill())
    x, y, z = scene.town.poles.position[list(scene.town.poles.id).index(2)]
    assert rim.get_center() == pytest.approx((x, y))
    assert rim.get_radius() == pytest.approx(np.sqrt(scene.chosen["2"] ** 2 - z**2))
    words = {text.get_text() for text in axes.texts} - {*list_street_names(scene.town)}
    assert words == {*map(str, scene.town.poles.id), "50 m"}  # no notes over the town


def test_below_the_map_stands_what_is_placed_and_where_conventional_rules_place_it() -> None:
    both = {DENSEST: ("2",), MOST_VISIBLE: ("2", "3")}
    axes = figures.town_map(replace(made_up_run.error_map(), conventional=both)).axes[0]
    assert axes.get_xlabel() == "placed: pole 2\ndensest traffic: pole 2\nmost visible objects: poles 2, 3"


def test_covered_errors_are_drawn_apart_from_uncovered_ones() -> None:
    scene = made_up_run.error_map()
    covered = np.arange(len(scene.errors)) < 20
    lines = figures.town_map(replace(scene, covered=covered)).axes[0].get_lines()
    shown = {str(line.get_label()): line for line in lines}
    for state, own in (("covered", covered), ("uncovered", ~covered)):
        missed = own & (scene.kind == "miss")
        line = shown[f"missed, {state} ({missed.sum()})"]
        np.testing.assert_allclose(np.column_stack(line.get_data()), scene.errors[missed, :2])
        assert (line.get_color() == style.BLUE) == (state == "covered")


def test_kinds_of_a_users_own_have_marks_of_their_own() -> None:
    scene = made_up_run.error_map()
    kind = np.where(np.arange(len(scene.errors)) < 9, "late", "wrong class")
    lines = figures.town_map(replace(scene, kind=kind)).axes[0].get_lines()
    marks = {str(line.get_label()): line.get_marker() for line in lines}
    assert marks["late (9)"] != marks[f"wrong class ({len(kind) - 9})"]


def test_of_many_poles_only_those_that_are_named_below_have_their_ids_on_the_map() -> None:
    scene = made_up_run.error_map()
    masts = {str(number): scene.errors[number] for number in range(40)}
    crowd = replace(scene, poles=masts, chosen={"7": 40.0}, conventional={DENSEST: ("9",)})
    words = {text.get_text() for text in figures.town_map(crowd).axes[0].texts}
    assert words & {*masts} == {"7", "9"}


def test_a_sensor_is_drawn_above_all_errors_and_candidates() -> None:
    scene = made_up_run.error_map(errors=300)
    sensor = scene.poles["2"][:2]
    scene = replace(scene, errors=np.r_[scene.errors, [[*sensor, 1.0]]], kind=np.r_[scene.kind, ["miss"]])
    axes = figures.town_map(scene).axes[0]
    drawn = [line for line in axes.get_lines() if len(line.get_xdata())]  # type: ignore
    (mark,) = (line for line in drawn if line.get_marker() == "o" and line.get_color() == style.BLUE)
    (number,) = (text for text in axes.texts if text.get_text() == "2")
    others = [each for each in (*drawn, *axes.collections, *axes.texts, *axes.patches) if each not in (mark, number)]
    assert number.get_zorder() > mark.get_zorder() > max(each.get_zorder() for each in others)


def test_the_map_has_coordinates_and_the_names_of_streets() -> None:
    scene = replace(made_up_run.error_map(), title="grid: one sensor")
    figure = figures.town_map(scene)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    assert axes.get_title(loc="left") == "grid: one sensor"
    assert "100 m" in {label.get_text() for label in axes.get_xticklabels()}
    east, north = axes.child_axes
    degrees = [label.get_text() for label in east.get_xticklabels()]
    place = find_on_ground(scene.town, 49.0, float(degrees[-1].removesuffix("° E")))
    assert east.xaxis.get_majorticklocs()[-1] == pytest.approx(float(degrees[-1].removesuffix("° E")))
    shown = axes.transData.inverted().transform(east.transData.transform((float(degrees[-1].removesuffix("° E")), 0)))
    assert shown[0] == pytest.approx(place[0], abs=0.2)
    assert all(label.get_text().endswith("° N") for label in north.get_yticklabels())
    words = {text.get_text() for text in axes.texts}
    assert {"Market Avenue", "Park Boulevard", "West Street"} <= words


def test_a_viewshed_takes_the_place_of_the_filled_range() -> None:
    scene = made_up_run.error_map()
    site = scene.poles["2"]
    axis = np.linspace(-40, 40, 41)
    seen = Viewshed(site[0] + axis, site[1] + axis, np.broadcast_to(axis < 0, (41, 41)))  # the west
    axes = figures.town_map(replace(scene, viewsheds={"2": seen})).axes[0]
    assert not [patch for patch in axes.patches if isinstance(patch, Circle) and patch.get_fill()]
    drawn = [area for area in axes.collections if isinstance(area, QuadContourSet) and area.filled]
    extents = [area.get_paths()[0].get_extents() for area in drawn]
    assert [each.x1 for each in extents] == [pytest.approx(site[0], abs=2.0)]
    assert [each.x0 for each in extents] == [pytest.approx(site[0] - 40)]


@pytest.mark.parametrize("name", ["town_map", "overview"])
def test_the_key_of_a_map_has_room(name: str) -> None:
    figure = DRAWN[name]()
    figure.draw_without_rendering()
    owner = figure.subfigs[0] if figure.subfigs else figure
    (key,) = owner.legends
    box = key.get_window_extent()
    assert owner.bbox.x0 <= box.x0
    assert box.x1 <= owner.bbox.x1


def test_zones_stand_on_the_map_with_their_density() -> None:
    scene = replace(made_up_run.error_map(), zones={"3": 49.6}, zone_m=30.0)
    axes = figures.town_map(scene).axes[0]
    (zone,) = (patch for patch in axes.patches if isinstance(patch, Circle) and patch.get_radius() == 30.0)
    assert zone.get_center() == pytest.approx(tuple(scene.poles["3"][:2]))
    assert "50/ha" in {text.get_text() for text in axes.texts}


def test_sweeps_count_what_was_found_missed_and_false() -> None:
    before, after = perspective.before_after(made_up_run.sweep()).axes
    told = [axes.texts[0].get_text() for axes in (before, after)]
    assert told == ["Pretrained: 2 of 5 found, 1 false", "Edge + cloud FL: 4 of 5 found, 0 false"]


def test_a_sweep_is_seen_from_behind_and_above() -> None:
    ground_m = -1.7
    eye = np.array([[perspective.EYE[0], 0.0, ground_m + perspective.EYE[1]]])
    along = np.array([[np.cos(perspective.DOWN), 0.0, -np.sin(perspective.DOWN)]])  # the axis of view
    at, depth = perspective.project(eye + 20 * along + [[0, 0, 0], [0, 2, 0]], ground_m)
    np.testing.assert_allclose(depth, 20)
    np.testing.assert_allclose(at, [[0, 0], [-0.1, 0]], atol=1e-12)  # 2 m to the left at 20 m
    near, far = perspective.project(np.array([[10.0, 0, ground_m], [40.0, 0, ground_m]]), ground_m)[0]
    assert near[1] < far[1]


def test_the_map_of_changes_counts_what_is_gone_left_and_new_and_draws_no_disc() -> None:
    changes = made_up_run.changes()
    figure = draw_changes(changes)
    axes = figure.axes[0]
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[:3] == [f"{changes.gone} gone", f"{len(changes.errors) - changes.gone} left", "2 new"]
    assert not [patch for patch in axes.patches if isinstance(patch, Circle)]
    by_colour: dict[str, int] = {}
    for line in axes.get_lines():
        colour = str(line.get_color())
        by_colour[colour] = by_colour.get(colour, 0) + len(np.asarray(line.get_xdata()))
    assert by_colour[GONE] == changes.gone
    assert by_colour[REMAINING] == len(changes.errors) - changes.gone
    assert by_colour[NEW] == 2


def test_a_drawing_of_a_page_takes_its_colours_and_fonts() -> None:
    drawn = style.svg(draw_changes(made_up_run.changes()))
    assert drawn.startswith("<svg")
    assert f"{made_up_run.changes().gone} gone</text>" in drawn
    assert "var(--house)" in drawn
    assert not any(colour in drawn for colour in style.VARIABLES)
    assert "font-family" not in drawn
    assert drawn == style.svg(draw_changes(made_up_run.changes()))


def test_validation_and_test_frames_stand_on_axes_of_their_own() -> None:
    validated, tested = figures.by_round(ROUNDS, TESTED, "AP50").axes
    assert _dots(validated) == {}
    assert {len(np.asarray(line.get_xdata())) for line in validated.get_lines() if line.get_marker() == "o"} == {
        sum(row.region == town for row in ROUNDS) for town in {row.region for row in ROUNDS}
    }
    assert _dots(tested) == {0: {0.412, 0.381}, 1: {0.503, 0.447}, 2: {0.511, 0.468}}


def test_towns_that_are_only_tested_are_named() -> None:
    unseen = [replace(row, region="unseen") for row in TESTED if row.region == "ring"]
    tested = figures.by_round(ROUNDS, [*TESTED, *unseen], "AP50").axes[1]
    assert {text.get_text() for text in tested.texts} == {row.region for row in TESTED} | {"unseen"}


def test_a_stage_that_was_not_tested_takes_no_place() -> None:
    rest = [row for row in TESTED if row.stage != "edge"]
    tested = figures.by_round(ROUNDS, rest, "AP50").axes[1]
    assert _dots(tested) == {0: {0.412, 0.381}, 1: {0.511, 0.468}}
    assert [label.get_text() for label in tested.get_xticklabels()] == ["pretraining", "cloud FL"]


def _dots(axes) -> dict[int, set[float]]:
    """Return the values drawn as single dots by their stage, the n-th of which spans [n, n + 1]."""
    out: dict[int, set[float]] = {}
    for line in axes.get_lines():
        if len(line.get_xdata()) == 1:
            out.setdefault(int(line.get_xdata()[0]), set()).add(round(float(line.get_ydata()[0]), 3))
    return out


def test_bars_add_up_to_the_ledger_and_budgets_stand_where_they_are() -> None:
    axes = figures.megabytes(SENT, BUDGETS).axes[0]
    bars = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    for y, link in enumerate(BUDGETS):
        own = [bar for bar in bars if bar.get_y() < y < bar.get_y() + bar.get_height()]
        total = sum(row.value for row in SENT if row.quantity == f"arms.spent.{link}.mb")
        assert sum(bar.get_width() for bar in own) == pytest.approx(total)
        assert max(bar.get_x() + bar.get_width() for bar in own) == pytest.approx(total)
    assert "215 of 230 MB" in {text.get_text() for text in axes.texts}
    assert [line.get_xdata()[0] for line in axes.get_lines()] == list(BUDGETS.values())  # type: ignore


def test_arms_stand_in_a_panel_per_town_with_their_intervals() -> None:
    grid, ring = figures.arms(ARMS).axes
    assert [grid.get_title(loc="left"), ring.get_title(loc="left")] == ["grid", "ring"]
    assert [label.get_text() for label in ring.get_yticklabels()] == ["pretrained", "edge FL", "oracle"]
    assert "0.500  (0.470–0.540)" in {text.get_text() for text in ring.texts}


def test_a_town_of_ones_own_has_a_colour_of_its_own() -> None:
    rounds = [replace(row, region="mine" if row.region == "ring" else row.region) for row in ROUNDS]
    axes = figures.by_round(rounds, [], "AP50").axes[0]
    colours = {str(line.get_color()) for line in axes.get_lines() if len(np.asarray(line.get_xdata())) > 2}
    assert len(colours) >= 3


def test_a_measure_of_one_scene_is_drawn_without_a_bar() -> None:
    single = [replace(row, low=None, high=None) for row in TESTED]
    assert _dots(figures.by_round(ROUNDS, single, "AP50").axes[1]) == {
        0: {0.412, 0.381},
        1: {0.503, 0.447},
        2: {0.511, 0.468},
    }


@pytest.mark.parametrize("top", [1.0, 0.62])
def test_names_of_lines_stand_as_near_their_ends_as_can_be(top: float) -> None:
    ends = [0.2, 0.61, 0.6, 0.58, 0.9]
    places = style.keep_apart(ends, 0.1, top)
    order = np.argsort(ends)[::-1]
    assert (np.diff(np.array(places)[order]) <= -0.1 + 1e-12).all()
    assert max(places) <= top
    if top == 1.0:
        assert places[0] == pytest.approx(0.2)
        assert places[4] == pytest.approx(0.9)
        assert np.mean([places[i] for i in (1, 2, 3)]) == pytest.approx(np.mean([0.61, 0.6, 0.58]))  # moved both ways


def test_a_table_of_precisions_has_means_ranges_and_numbers_of_targets() -> None:
    panels = {
        "grid": [Bar("Car", 0.8, (0.7, 0.9), 120), Bar("Cyclist", 0.3, (0.3,), 9)],
        "ring": [Bar("Car", 0.6, (0.6, 0.6), 80)],
    }
    axes = precision_table(panels, "AP").axes[0]
    told = {text.get_text(): text.get_position() for text in axes.texts}
    assert told.keys() == {"0.80 ±0.10", "120", "0.30", "9", "0.60 ±0.00", "80"}
    assert told["80"][0] == 1
    assert told["9"][1] == pytest.approx(1.24)


def test_correlations_show_every_seed_and_the_mean_with_its_interval() -> None:
    seeds = {"errors covered": {"all": [0.1, 0.5, -0.2]}, "traffic": {"all": [0.0, 0.2, 0.1]}}
    means = {"errors covered": {"all": Estimate(0.13, -0.3, 0.6)}, "traffic": {"all": Estimate(0.1, None, None)}}
    axes = draw_correlations(seeds, means).axes[0]
    lines = [
        (line.get_marker(), np.asarray(line.get_xdata()).tolist(), np.asarray(line.get_ydata()).tolist())
        for line in axes.get_lines()
    ]
    assert ("o", [0.1, 0.5, -0.2], [0.0, 0.0, 0.0]) in lines
    assert ("None", [-0.3, 0.6], [0.0, 0.0]) in lines
    assert [x for marker, x, _ in lines if marker == "s"] == [[0.13], [0.1]]


def test_arms_by_question_share_an_axis_and_marks() -> None:
    figure = figures.arms_by_question({"a": ARMS["grid"], "b": ARMS["ring"], "c": ARMS["grid"]}, {"pretrained": 0.41})
    assert [axes.get_title(loc="left") for axes in figure.axes][:3] == ["a", "b", "c"]
    for axes in figure.axes[:3]:
        assert 0.41 in [float(np.asarray(line.get_xdata())[0]) for line in axes.get_lines()]
        assert "0.410  (0.380–0.450)" in [text.get_text() for text in axes.texts]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["pretrained"]

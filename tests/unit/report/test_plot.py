"""Figures and tables of records in notebooks."""

import io
from pathlib import Path

import made_up_run
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.patches import Rectangle
from PIL import Image

import flcav
from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.interface.notebook import resumable
from flcav.optimization.curves.history import History
from flcav.perception.errors import PerceptionError, Registry
from flcav.report import style

TOWN = flcav.load_town("suburb")
POLES = TOWN.poles.position
CARS = Boxes.from_array([[10.0, 2.0, 0.8, 4.4, 1.8, 1.6, 0.0]] * 30, "<b>Car</b>")
MISSED = Registry(tuple(PerceptionError(x, y, z, 2.0, "miss", "Car", 3, 0.0, "s", "t") for x, y, z in POLES.tolist()))
PLACED = flcav.place(MISSED.positions, POLES, range_m=40, count=1)
CURVE = History(np.array([[10.0, 0, 0], [10, 2, 0], [40, 2, 0]]), np.array([0.3, 0.5, 0.6]), np.ones(3))
PLAN = flcav.allocate(flcav.load_problem(Path(flcav.__file__).parents[2] / "recipes/allocation/objects.yaml"))


def closed(axes) -> None:
    pyplot.close(axes.figure)


@pytest.mark.parametrize("record", [TOWN, CURVE], ids=["town", "history"])
def test_a_record_is_shown_as_a_picture_and_leaves_no_figure(record):
    open_ = pyplot.get_fignums()
    with Image.open(io.BytesIO(record._repr_png_())) as picture:
        assert min(picture.size) > 200
        assert np.ptp(np.asarray(picture.convert("L"))) > 100
    assert record._repr_html_() is None
    assert pyplot.get_fignums() == open_


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (CARS, ("30 boxes", "&lt;b&gt;Car&lt;/b&gt;", "4.40", "and 10 more")),
        (MISSED, ("4 errors", "miss", "<td>8</td>")),
        (PLACED, ("optimal, proven", "errors covered")),
        (PLAN, ("925", "0.545", "4000.0")),
        (made_up_run.run(), ("Tests", "Findings", "did not hold", "0.503")),
        (flcav.Recipe(town="grid", seed=3), ("<td>grid</td>", "<td>3</td>")),
    ],
    ids=lambda each: type(each).__name__,
)
def test_a_record_is_shown_as_a_table_of_escaped_text(record, words):
    table = record._repr_html_()
    assert all(word in table for word in words), table
    assert "<b>Car" not in table
    assert table.count("<table>") == table.count("</table>") > 0
    assert record._repr_png_() is None


def test_what_python_prints_is_short():
    assert repr(TOWN) == f"Town('suburb', {len(TOWN.roads)} roads, {len(TOWN.buildings)} buildings, 4 poles)"


@pytest.mark.parametrize("width_in", [2.0, 5.0])
def test_axes_of_ones_own_are_drawn_into_and_returned(width_in: float):
    figure = style.canvas(width_in, width_in)
    draws = (
        lambda axes: flcav.plot.town(TOWN, axes),
        lambda axes: flcav.plot.boxes(CARS, axes),
        lambda axes: flcav.plot.errors(MISSED, axes, town=TOWN, placed=PLACED, range_m=40),
        lambda axes: flcav.plot.history(CURVE, axes),
        lambda axes: flcav.plot.plan(PLAN, axes),
        lambda axes: flcav.plot.differences(made_up_run.run(), axes),
    )
    for draw in draws:
        axes = figure.add_subplot()
        assert draw(axes) is axes
        assert axes.has_data() or axes.collections
        axes.remove()


def test_boxes_lie_where_they_are():
    """The page's y is the frame's x, and its x to the right the frame's -y."""
    axes = flcav.plot.boxes(CARS[:1])
    x, y = axes.dataLim.intervalx, axes.dataLim.intervaly
    assert x == pytest.approx((-2.9, -1.1), abs=0.05)
    assert y[0] == pytest.approx(7.8, abs=0.05)
    assert y[1] >= 12.2 - 0.05
    closed(axes)


def test_a_plan_is_drawn_with_its_megabytes():
    axes = flcav.plot.plan(PLAN)
    assert [bar.get_width() for bar in axes.patches if isinstance(bar, Rectangle)] == [
        PLAN.used_mb.wireless_mb,
        PLAN.used_mb.wireline_mb,
    ]
    closed(axes)


def test_a_placement_without_its_range_is_refused():
    with pytest.raises(InputError, match="range_m"):
        flcav.plot.errors(MISSED, town=TOWN, placed=PLACED)


def test_ctrl_c_is_a_sentence():
    @resumable
    def record() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="the same call goes on") as ended:
        record()
    assert ended.value.__suppress_context__

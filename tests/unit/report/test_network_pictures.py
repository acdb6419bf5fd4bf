"""The timeline of rounds and the coverage map show what the records say."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from flcav.network.clock.records import ClientTiming, RoundTiming
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import unit_positions
from flcav.network.radio.recorded import cover_town
from flcav.report import style
from flcav.report.charts.timeline import COLOURS, timeline_of_rounds
from flcav.report.pictures.coverage import coverage_map
from flcav.world.map.town import load_town

DONE = ClientTiming("cav0", "pole1", 1, 10.5, 2.0, 3.0, 1.0, 16.5, 9, 9, "")
LOST = ClientTiming("cav1", "pole1", 1, 10.5, 4.0, 0.5, 0.0, 15.0, 9, 0, "left the town")
ROUND = RoundTiming(1, 10.0, 17.0, 0.5, 0.5, (DONE, LOST))


def test_bars_are_as_long_as_the_times_and_begin_where_they_did():
    axes = timeline_of_rounds([ROUND]).axes[0]
    boxes = [bar.get_path().transformed(bar.get_patch_transform()).get_extents() for bar in axes.patches]
    bars = [(box.x0, box.width, box.y0 + box.height / 2) for box in boxes]
    np.testing.assert_allclose(
        bars, [(0.5, 2, 0), (2.5, 3, 0), (5.5, 1, 0), (0.5, 4, 1), (4.5, 0.5, 1), (5, 0, 1)], atol=1e-9
    )
    wire = [np.asarray(path.get_extents().intervalx) for path in axes.collections[0].get_paths()]
    np.testing.assert_allclose(wire, [[0, 0.5], [6.5, 7.0]], atol=1e-9)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["cav0", "cav1", "wireline"]


def test_rows_are_in_the_order_of_the_clients_numbers_whoever_comes_first():
    timings = [replace(DONE, client=f"cav{number}") for number in (10, 2, 1)]
    axes = timeline_of_rounds([replace(ROUND, clients=tuple(timings))]).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["cav1", "cav2", "cav10", "wireline"]


def test_who_dropped_out_is_said_with_the_reason():
    figure = timeline_of_rounds([ROUND])
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == ["left the town", "round 1: 7.0 s"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [*COLOURS, "dropped"]


def test_a_round_without_wireline_has_no_row_of_it():
    figure = timeline_of_rounds([RoundTiming(1, 10.5, 16.5, 0.0, 0.0, (DONE,))])
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["cav0"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["download", "compute", "upload"]
    with pytest.raises(ValueError, match="at least one round"):
        timeline_of_rounds([])


def test_the_map_has_the_rates_of_the_coverage():
    town = load_town("suburb")
    coverage = cover_town(town, unit_positions(town, [2, 3]), Radio(), step_m=12.0)
    figure = coverage_map(town, coverage)
    mesh = next(each for each in figure.axes[0].collections if isinstance(each, QuadMesh))
    drawn = mesh.get_array()
    assert drawn is not None
    np.testing.assert_allclose(drawn.reshape(coverage.rate_bps.shape), coverage.rate_bps / 1e6)
    assert {text.get_text() for text in figure.axes[0].texts} >= {"2", "3"}
    assert style.png(figure, dpi=60).startswith(b"\x89PNG")

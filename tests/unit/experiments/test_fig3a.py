import json

import numpy as np
import pytest

from flcav.optimization.graph import to_problem
from flcav.reproductions.fig3a.run import Fig3a, article_graph, draw_fig3a, fig3a
from flcav.runs.tables import load_known_history

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results() -> Fig3a:
    return fig3a()


def test_refits_come_within_3_percent_of_the_printed_constants(results: Fig3a) -> None:
    assert set(results.article) == {"weather", "signs", "objects"}
    for each in results.article.values():
        assert all(abs(off) < 0.03 for off in vars(each.off).values())
    assert "come within 3% of the printed" in results.findings[0]


def test_bands_hold_their_curve_and_curves_rise(results: Fig3a) -> None:
    lines = [*results.article.values(), *results.own.lines]
    for line in lines:
        low, accuracy, high = map(np.array, (line.low, line.accuracy, line.high))
        assert np.all(low <= accuracy + 1e-3)
        assert np.all(accuracy <= high + 1e-3)
        assert np.all(np.diff(accuracy) >= -1e-9)


def test_every_point_of_our_own_history_is_drawn(results: Fig3a) -> None:
    drawn = sum(len(line.points) for line in results.own.lines)
    assert drawn == len(load_known_history("objects").accuracy)


def test_the_figure_is_drawn_from_what_the_file_holds(results: Fig3a) -> None:
    assert draw_fig3a(Fig3a.from_json(json.loads(json.dumps(results.as_json())), "result.json")) == draw_fig3a(results)


def test_the_articles_graph_is_its_problem() -> None:
    problem = to_problem(article_graph())
    assert [task.name for task in problem.tasks] == ["weather", "signs", "objects"]
    assert all(task.edge_groups == (4, 3) and task.uplink_mbps is None for task in problem.tasks)

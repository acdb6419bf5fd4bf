from pathlib import Path

import networkx as nx
import pytest

from flcav.optimization.graph import load_graph
from flcav.report import style
from flcav.report.charts.curves import COLUMNS, layout, three_layers
from flcav.reproductions.fig3a.run import article_graph

RECIPE = Path(__file__).parents[3] / "recipes" / "graphs" / "three_layers.yaml"


@pytest.fixture(params=["article", "recipe"])
def graph(request: pytest.FixtureRequest) -> nx.Graph:
    return article_graph() if request.param == "article" else load_graph(RECIPE)


def test_every_kind_has_its_column_and_every_node_its_place(graph: nx.Graph) -> None:
    places = layout(graph)
    for (one, _), (x, _) in places.items():
        assert x == list(COLUMNS).index(one) * places[next(n for n in places if n[0] == "network")][0]
    assert len(set(places.values())) == len(graph)


def test_nodes_stand_in_the_order_of_what_they_are_joined_to(graph: nx.Graph) -> None:
    places = layout(graph)
    crossings = 0
    edges = [sorted((places[a], places[b])) for a, b, layer in graph.edges(data="layer") if layer < 3]
    for number, ((x0, y0), (_, y1)) in enumerate(edges):
        crossings += sum(x0 == x and (y0 - y) * (y1 - z) < -1e-9 for (x, y), (_, z) in edges[:number])
    assert crossings == 0


def test_every_name_is_written(graph: nx.Graph) -> None:
    figure = three_layers(graph)
    written = " ".join(text.get_text() for text in figure.axes[0].texts)
    assert all(name in written for _, name in graph.nodes)
    assert all(f"layer {number}" in written for number in (1, 2, 3))
    assert style.png(figure).startswith(b"\x89PNG")

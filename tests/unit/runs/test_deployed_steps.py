"""A run's federations on a fleet: which steps are deployed, and what cannot be."""

from pathlib import Path
from typing import Any

import pytest

from flcav.config import InputError
from flcav.runs.recipe import RunRecipe
from flcav.runs.stages.deployment import deploy
from flcav.runs.stages.graph import Graph


def graph_of(**changes: Any) -> Graph:
    recipe = {
        "tasks": {"objects": {"plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}}},
        "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}, "ring": {"role": "federate"}},
        "budgets_mb": {"wireless": 200, "wireline": 200},
        "arms": {"further": {"stages": ["edge", "more_edge"]}, "oracle": {"central": "federate"}},
        **changes,
    }
    return Graph(RunRecipe.model_validate(recipe), Path())


def test_what_federates_is_deployed_and_nothing_else_changes():
    graph = graph_of()
    deployed = deploy(graph, "flower", None)
    placed = {step.name for step in deployed if step.means.get("runtime") == "flower"}
    further = {"further-grid-more-edge-fl-objects", "further-ring-more-edge-fl-objects"}
    assert {"grid-edge-fl-objects", "ring-edge-fl-objects", "cloud-fl-objects"} < placed
    assert len(placed) == 3 + len(further), placed
    prints: dict[str, str] = {}
    for one, other in zip(graph.steps, deployed, strict=True):
        prints[one.name] = one.fingerprint(prints)
        assert other.fingerprint(prints) == prints[one.name]  # a folder of the one goes on with the other
    assert deploy(graph, "embedded", None) == graph.steps


@pytest.mark.parametrize(
    ("runtime", "engine", "changes", "told"),
    [
        ("ray", "processes", {}, "runtime 'ray'"),
        ("flower", "ray", {}, "not with engine 'ray'"),
        (
            "flower",
            "processes",
            {"arms": {"averaged": {"labels": {"objects": "road-average"}, "stages": ["edge"]}}},
            "'road-average' are renewed between rounds",
        ),
    ],
)
def test_what_cannot_be_deployed(runtime, engine, changes, told):
    graph = graph_of(**changes)
    with pytest.raises(InputError, match=told):
        deploy(graph, runtime, None, engine)


def test_fleet_that_is_not_up_is_told_at_once(tmp_path):
    graph = graph_of()
    with pytest.raises(InputError, match="the fleet is not up"):
        deploy(graph, "flower", tmp_path)

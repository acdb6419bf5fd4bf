"""Deployment of a run's federations: in this process, or on the vehicles of a deployed fleet."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from flcav.config import InputError
from flcav.federation.links.link import check_deployable
from flcav.runs.engine import Step
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.stages.graph import Graph
from flcav.runs.stages.settings import FederationSettings


def check_clients(graph: Graph, arms: Iterable[str], runtime: str) -> None:
    """Raise `InputError` where the clients of a remote `runtime` cannot have an arm's labels or optimisers."""
    for arm in arms if runtime != "embedded" else ():
        if runtime == "flower":
            check_deployable(graph.settings[arm].federation)
        if any(LABEL_SOURCES[kind].averaged for kind in graph.settings[arm].labels.values()):
            raise InputError(
                "labels 'road-average' are renewed between rounds, and clients elsewhere get them once; "
                f"not on '{runtime}'"
            )


def deploy(graph: Graph, runtime: str, fleet: Path | None, engine: str = "processes") -> tuple[Step, ...]:
    """Return the steps of a graph, with federations on a `runtime`: embedded, or flower.

    `fleet`: folder of a fleet that is up, or of one per region; None: a step brings up a fleet here for its duration.
    The results do not depend on it. Raises `InputError` where a step cannot be deployed, or the fleet is not up.
    """
    if runtime == "embedded":
        return graph.steps
    if runtime != "flower":
        raise InputError(f"runtime '{runtime}': a run has embedded and flower; flcav federate has others")
    if engine != "processes":
        raise InputError(f"runtime '{runtime}': vehicles are reached from this machine; not with engine '{engine}'")
    check_clients(graph, graph.settings, runtime)
    if fleet is not None:
        from flcav.federation.links.flower import RegionalDeployment

        RegionalDeployment(fleet, graph.vehicles)  # fails at once if the fleet is not up, not hours later in a step
    where = {"runtime": runtime, "fleet": "" if fleet is None else str(fleet.absolute())}
    return tuple(replace(step, means=where) if _federates(step) else step for step in graph.steps)


def _federates(step: Step) -> bool:
    return isinstance(step.arguments["settings"], FederationSettings)

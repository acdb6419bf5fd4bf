"""Stages II and III of clients that a test makes, as `federate_stage` runs them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from flcav.federation.links.metered import Outage
from flcav.federation.loop import Schedule
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.interface.progress import Report
from flcav.network.ledger import Ledger
from flcav.perception.client import TaskClient
from flcav.perception.weights import to_arrays
from flcav.runs.driving import DrivenStage
from flcav.runs.stages.rounds import CloudServer, RegionStart, StageFederation, Whereabouts, federate_stage
from flcav.runs.training.learning import Learning, Strategies

Outages = Mapping[tuple[int, str], Outage]
NOBODY: Outages = {}


def edge_federation(
    learning: Learning,
    network: Any,
    clients: Mapping[str, TaskClient],
    schedule: Schedule,
    strategy: Strategy,
    earlier: int,
    book: Ledger,
    folder: Path,
    report: Report,
    **more: Any,
) -> StageFederation:
    """Return the federation of a region's vehicles after `earlier` rounds."""
    start = {"a": RegionStart(clients, to_arrays(network), earlier)}
    share = 0.0 if earlier else learning.training.start_share
    about = (learning, network, start, schedule, Strategies(strategy, FEDAVG), book, folder, report, share)
    return StageFederation(*about, **more)


def cloud_federation(
    learning: Learning,
    network: Any,
    regions: Mapping[str, RegionStart],
    edge_rounds: Mapping[str, int],
    strategies: Strategies,
    book: Ledger,
    folder: Path,
    report: Report,
    *,
    rate: float | None = None,
    start_share: float = 0.0,
    **cloud: Any,
) -> StageFederation:
    """Return the federation of edge servers with the cloud; `cloud`: fields of `CloudServer`."""
    starts = {name: replace(own, edge_rounds=edge_rounds[name]) for name, own in regions.items()}
    earlier, steps = max(own.earlier for own in starts.values()), learning.training.local_steps
    schedule = learning.schedule(1, steps, "cloud", "", earlier=earlier, restart=rate)
    about = (learning, network, starts, schedule, strategies, book, folder, report, start_share)
    return StageFederation(*about, cloud=CloudServer(**cloud))


def federate_edge(
    own: StageFederation, rules: Rules, outages: Outages = NOBODY, **where: Any
) -> tuple[float | None, ...]:
    """Run stage II by `rules`; `where` as in `Whereabouts`."""
    return federate_stage(own, DrivenStage(rules, outages), Whereabouts(**where))[0]


def federate_cloud(own: StageFederation, rounds: int, rules: Rules, **where: Any) -> tuple[float | None, ...]:
    """Run so many rounds of stage III by `rules`; `where` as in `Whereabouts`."""
    planned = replace(own, schedule=replace(own.schedule, rounds=rounds))
    return federate_stage(planned, DrivenStage(rules), Whereabouts(**where))[0]

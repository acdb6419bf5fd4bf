"""Training plans of the three stages and their uplink traffic (Wang et al., IEEE Network 37(3), 2023)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MessageSizes:
    """Sizes of the messages of one task [MB; 1 MB = 10^6 bytes]."""

    sample_mb: float  # one labelled sample
    model_mb: float  # one model update


@dataclass(frozen=True)
class StagePlan:
    """The training plan of one task: samples of stage I, rounds of stages II and III, vehicles of each edge server.

    Wang et al., IEEE Network 37(3), 2023.

    >>> from flcav import StagePlan
    >>> plan = StagePlan(samples=200, edge_rounds=6, cloud_rounds=3, edge_groups=(4, 3))
    >>> sum(plan.edge_groups)  # vehicles
    7
    """

    samples: int  # stage I: labelled samples uploaded vehicle -> edge -> cloud
    edge_rounds: int  # stage II rounds, in every region
    cloud_rounds: int  # stage III rounds
    edge_groups: tuple[int, ...]  # vehicles per edge server
    edge_rounds_per_cloud_round: int = 1  # k: stage III


@dataclass(frozen=True)
class Price:
    """Uplink traffic on each link [MB]."""

    wireless_mb: float
    wireline_mb: float


def price(plan: StagePlan, sizes: MessageSizes) -> Price:
    """Return the uplink traffic of `plan` on each link [MB].

    wireless = samples * sample + (edge_rounds + k * cloud_rounds) * vehicles * model;
    wireline = samples * sample + cloud_rounds * edge_servers * model.

    >>> from flcav import StagePlan, price
    >>> from flcav.network import MessageSizes
    >>> plan = StagePlan(samples=200, edge_rounds=6, cloud_rounds=3, edge_groups=(4, 3))
    >>> price(plan, MessageSizes(sample_mb=0.5, model_mb=1.0))
    Price(wireless_mb=163.0, wireline_mb=106.0)
    """
    wireless_rounds = plan.edge_rounds + plan.edge_rounds_per_cloud_round * plan.cloud_rounds
    uploaded = plan.samples * sizes.sample_mb
    return Price(
        wireless_mb=uploaded + wireless_rounds * sum(plan.edge_groups) * sizes.model_mb,
        wireline_mb=uploaded + plan.cloud_rounds * len(plan.edge_groups) * sizes.model_mb,
    )

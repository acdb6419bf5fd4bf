"""Training plans of the three stages and their uplink traffic (Wang et al., IEEE Network 37(3), 2023)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from flcav.network.ledger import LinkMegabytes

FormName = Literal["float32", "fp16", "int8", "int4", "top-k"]  # of an update; the first is the weights as stored
FORM_BITS: Mapping[FormName, float] = {  # of a parameter in an update; of top-k, of one that is sent: place and value
    "float32": 32,
    "fp16": 16,
    "int8": 8,
    "int4": 4,
    "top-k": 64,
}
STORED_BITS = FORM_BITS["float32"]


@dataclass(frozen=True)
class MessageSizes:
    """Sizes of the messages of one task [MB; 1 MB = 10^6 bytes]."""

    sample_mb: float  # one labelled sample
    model_mb: float  # one model update
    exchange_mb: float | None = None  # a vehicle's upload for aggregation in a round; None: a model update
    labels_mb: float | None = None  # a vehicle's upload for labelling of its samples; None: nothing


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
    edge_rounds: int  # rounds of stage II, in every region
    cloud_rounds: int  # rounds of stage III
    edge_groups: tuple[int, ...]  # vehicles per edge server
    edge_rounds_per_cloud_round: int = 1  # k of stage III
    called: int | None = None  # greatest number of vehicles per edge server in a round of stage II; None: all

    @property
    def edge_vehicles(self) -> int:
        """Number of vehicles in a round of stage II."""
        return sum(self.edge_groups if self.called is None else (min(self.called, size) for size in self.edge_groups))


def price(plan: StagePlan, sizes: MessageSizes) -> LinkMegabytes:
    """Return the uplink traffic of `plan` on each link [MB].

    wireless = samples * sample + (called * edge_rounds + vehicles * k * cloud_rounds) * exchange
    + (called * edge_rounds + vehicles if cloud_rounds) * labels;
    wireline = samples * sample + cloud_rounds * edge_servers * model.

    Samples are labelled before each edge round of stage II, and once before the first cloud round.

    >>> from flcav import StagePlan, price
    >>> from flcav.network import MessageSizes
    >>> plan = StagePlan(samples=200, edge_rounds=6, cloud_rounds=3, edge_groups=(4, 3))
    >>> price(plan, MessageSizes(sample_mb=0.5, model_mb=1.0))
    LinkMegabytes(wireless_mb=163.0, wireline_mb=106.0)
    >>> price(plan, MessageSizes(sample_mb=0.5, model_mb=1.0, exchange_mb=0.01, labels_mb=0.02))
    LinkMegabytes(wireless_mb=101.61, wireline_mb=106.0)
    """
    uploaded = plan.samples * sizes.sample_mb
    vehicles = sum(plan.edge_groups)
    of_edge = plan.edge_rounds * plan.edge_vehicles
    updates = of_edge + plan.edge_rounds_per_cloud_round * plan.cloud_rounds * vehicles
    labellings = of_edge + (plan.cloud_rounds > 0) * vehicles
    exchange_mb = sizes.model_mb if sizes.exchange_mb is None else sizes.exchange_mb
    return LinkMegabytes(
        wireless_mb=uploaded + updates * exchange_mb + labellings * (sizes.labels_mb or 0.0),
        wireline_mb=uploaded + plan.cloud_rounds * len(plan.edge_groups) * sizes.model_mb,
    )

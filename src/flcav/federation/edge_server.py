"""The edge server in stage III: a client of the cloud whose local training is k edge rounds with its vehicles.

Hierarchical federated averaging of Wang et al., IEEE Network 37(3), 2023.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flcav.federation.links.link import Runtime
from flcav.federation.links.metered import Account
from flcav.federation.loop import EVERYBODY, Schedule, federate
from flcav.federation.modes.buffered import Buffers
from flcav.federation.privacy import count_affordable
from flcav.federation.rules import RegionalModels, Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy
from flcav.federation.trainable import Distiller, LocalUpdate, Trainable, Weights
from flcav.federation.upload import name_like
from flcav.statistics.streams import derive_seed


@dataclass
class EdgeServer:
    """A region's edge server as a client of the cloud: its local training is k edge rounds with its vehicles."""

    vehicles: Mapping[str, Trainable]  # of the region, by name
    edge_rounds: int  # k >= 1, per cloud round
    account: Account  # of the wireless link
    own: Weights  # the region's model at the end of stage II
    cloud_rounds_done: int = 0
    strategy: Strategy = FEDAVG  # of aggregation in the region
    rules: Rules = EVERYBODY  # of the region's rounds
    state: FederationState = field(default_factory=FederationState)  # of the region's rounds
    earlier: int = 0  # rounds of stage II, which a privacy budget counts
    runtime: Runtime | None = None  # where the vehicles train; None: in this process
    distiller: Distiller | None = None  # server's network where vehicles send outputs
    buffers: Buffers | None = None  # of `FedBuff`, the region's rounds by a clock
    begun: Weights = field(default_factory=dict)  # weights at the start of the last cloud round
    trained: Weights = field(default_factory=dict)  # weights after its edge rounds

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, layers: Sequence[str] = ()
    ) -> LocalUpdate:
        """Return the update of the region after k edge rounds from the cloud's `weights`; raises as `federate` does.

        The first cloud round starts from the region's stage II model instead: the cloud has not averaged yet, and its
        model is older. Personal arrays of the region continue from their last values, whatever the cloud's are; for
        regional models these are all arrays, and vehicles are pulled to the cloud's model from the second cloud round
        on. Edge rounds are numbered consecutively over the cloud rounds. `layers` are those of the rules, which the
        vehicles follow. The update's weight is the region's number of vehicles under central noise, including those
        that took no part, otherwise the samples of its last edge round that is not empty. If all are empty it is 0, but
        1 in the first cloud round, for the model of stage II.
        """
        # personal arrays override the cloud's, which does not average them
        start = {**weights, **self.state.personal} if self.cloud_rounds_done else self.own
        regional = isinstance(self.rules.personal, RegionalModels)
        centre = weights if regional and self.cloud_rounds_done else None
        done = self.cloud_rounds_done * self.edge_rounds
        schedule = Schedule(done + self.edge_rounds, steps, learning_rate, learning_rate, seed)
        first = self.cloud_rounds_done == 0
        known = len(self.state.records)
        self.cloud_rounds_done += 1  # also where a round fails: it counts for the cloud
        if self.distiller is not None:
            self.state.server = {}  # the first edge round starts from outputs of the cloud's network
        found = federate(
            self.vehicles,
            start,
            schedule,
            self.account,
            strategy=self.strategy,
            rules=self.rules,
            state=self.state,
            done=done,
            earlier=self.earlier,
            runtime=self.runtime,
            centre=centre,
            distiller=self.distiller,
            buffers=self.buffers,
        )
        self.begun, self.trained = start, found.weights
        names = [*found.weights] if regional else name_like(found.weights, self.rules.personal_arrays)
        self.state.personal = {name: np.asarray(found.weights[name]) for name in names}
        if self.rules.privacy is not None and not self.rules.privacy.local:  # numbers of samples have no noise
            return replace(found, samples=len(self.vehicles))
        if self.state.records and self.state.records[-1].empty:
            trained = [each.samples for each in self.state.records[known:] if each.samples]
            return replace(found, samples=trained[-1] if trained else int(first))
        return replace(found, samples=max(found.samples, 1))  # the cloud averages even if the network lost all


def afford_cloud_rounds(rules: Rules, names: Sequence[str], rounds: int, edge_rounds: int, earlier: int) -> int:
    """Return the number of cloud rounds that a region's privacy budget affords, of `rounds`.

    A cloud round has `edge_rounds` edge rounds. names: the region's clients, which took part in `earlier` rounds.
    """
    if rules.privacy is None or rounds == 0:
        return rounds
    return count_affordable(rules.privacy, rules.selection, names, rounds * edge_rounds, earlier) // edge_rounds


def edge_seeds(schedule: Schedule, cloud_round: int, region: str, edge_rounds: int) -> list[int]:
    """Return the seeds of a region's edge rounds in a cloud round of `schedule`, as `EdgeServer` derives them."""
    seed = derive_seed(schedule.work(cloud_round).seed, region)
    done = (cloud_round - 1) * edge_rounds
    region_schedule = Schedule(done + edge_rounds, 0, 1.0, 1.0, seed)
    return [region_schedule.work(done + number).seed for number in range(1, edge_rounds + 1)]

"""The state of a federation between rounds, as arrays for a checkpoint, and the records of its rounds.

A cloud round's record has the weight divergence of the regions: the relative L2 distance of their weights from their
mean (after Zhao et al., "Federated Learning with Non-IID Data", 2018, whose reference is centralised training).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flcav.federation.privacy import Secret, draw_secret
from flcav.federation.trainable import Arrays, Weights, learned_names, statistics_names
from flcav.interface.wording import make_printable
from flcav.storage.records import LEFT_OUT, WHERE_TRUE, Record


@dataclass(frozen=True)
class Divergence(Record):
    """Weight divergence of several models: mean over them of |w_i - m| / |m|, where m is the mean of all w_i."""

    whole: float  # over all floating arrays
    statistics: float | None  # over batch normalisation's running means and variances; None: the network has none
    learned: float  # over all other arrays, which gradients change


@dataclass(frozen=True)
class RoundDivergence(Record):
    """Weight divergence of the regions in a cloud round: of their initial weights, and of the averaged ones."""

    begun: Divergence
    trained: Divergence


def measure_divergence(models: Sequence[Weights]) -> Divergence:
    """Return the weight divergence of models with the same names and shapes of arrays; 0 for a single model."""
    learned, statistics = learned_names(models[0]), statistics_names(models[0])
    return Divergence(
        whole=_mean_distance(models, [*learned, *statistics]),
        statistics=_mean_distance(models, statistics) if statistics else None,
        learned=_mean_distance(models, learned),
    )


def _mean_distance(models: Sequence[Weights], names: Sequence[str]) -> float:
    """Return the mean of |w_i - m| / |m| over the arrays `names`; where m is 0, of |w_i|."""
    rows = np.array([np.concatenate([np.ravel(model[name]).astype(np.float64) for name in names]) for model in models])
    mean = rows.mean(axis=0)
    return float(np.mean(np.linalg.norm(rows - mean, axis=1)) / (np.linalg.norm(mean) or 1.0))


ClientStates = dict[str, dict[str, Arrays]]  # by client and kind
ReadStates = Callable[[Iterable[str]], ClientStates]  # reads the given kinds of client state

SERVER, CLIENT, PERSONAL = "server", "client", "personal"
UNSENT = "over the budget, not sent"  # reason of a missing update that its client kept
FAILED = "failed or lost"  # begins the list of clients without an update
LONGEST = 500  # characters shown of a client's error


@dataclass(frozen=True)
class RoundRecord(Record):
    """The record of one round: clients whose updates were combined, failures, samples and loss.

    Where epsilon relies on secret draws of clients, it reveals nothing about them: no names, no loss, 0 samples.
    """

    round: int  # from 1
    clients: tuple[str, ...]  # whose updates were combined, by name
    failed: Mapping[str, str] = field(default_factory=dict)  # reason of failure, by client
    epsilon: float | None = None  # of differential privacy, over all rounds so far; None: without noise
    loss: float | None = None  # mean training loss, weighted by samples; None: no client reported one
    samples: int = 0  # sum over the clients
    divergence: Annotated[RoundDivergence | None, LEFT_OUT] = None  # of the regions; None: no cloud round of several
    empty: Annotated[bool, WHERE_TRUE] = False  # no client had samples: the model is unchanged


def describe_empty(rounds: Sequence[bool]) -> str:
    """Return the number of empty rounds in words; "" for none. rounds: whether each one is empty."""
    if not any(rounds):
        return ""
    return "an empty round" if len(rounds) == 1 else f"{sum(rounds)} of {len(rounds)} rounds empty"


def describe_failures(rounds: Sequence[Mapping[str, str]]) -> str:
    """Return the failed or lost clients with their reasons in words, and over several rounds in how many.

    rounds: per round the reasons by client, as in `RoundRecord.failed`. Returns "" where none failed.
    """
    failed = Counter(f"{name} ({make_printable(why, LONGEST)})" for each in rounds for name, why in each.items())
    reasons = ", ".join(f"{each} in {count}" if len(rounds) > 1 else each for each, count in failed.items())
    return f"{FAILED}: {reasons}" if reasons else ""


@dataclass
class FederationState:
    """The state of a federation after a round: that of the server and of the clients, and the records of its rounds.

    A simulation holds all of it in one place, so that a checkpoint is complete; deployed clients keep their states.
    Secrets are in no message and no result, and a checkpoint stores them separately.
    """

    server: Arrays = field(default_factory=dict)
    clients: ClientStates = field(default_factory=dict)
    records: list[RoundRecord] = field(default_factory=list)
    personal: Arrays = field(default_factory=dict)  # arrays that an edge server keeps for its region
    secrets: dict[str, Secret] = field(default_factory=dict, repr=False)  # of clients by name, and of `SERVER`

    def keep_secret(self, party: str) -> Secret:
        """Return the secret of a client, or of `SERVER`, for private noise; draw it the first time."""
        return self.secrets.setdefault(party, draw_secret())

    def to_arrays(self) -> Arrays:
        """Return the arrays of server and clients in one mapping, for a safetensors file; without `secrets`."""
        found = {f"{SERVER}|{name}": array for name, array in self.server.items()}
        found |= {f"{PERSONAL}|{name}": array for name, array in self.personal.items()}
        for client, kinds in self.clients.items():
            for kind, arrays in kinds.items():
                found |= {f"{CLIENT}|{client}|{kind}|{name}": array for name, array in arrays.items()}
        return found

    def restore(self, arrays: Mapping[str, NDArray[np.number]], records: Sequence[RoundRecord]) -> None:
        """Restore the state in place from the arrays of `to_arrays` and the records; secrets are unchanged."""
        self.server, self.clients, self.personal = {}, {}, {}
        for key, array in arrays.items():
            owner, _, rest = key.partition("|")
            if owner in (SERVER, PERSONAL):
                (self.server if owner == SERVER else self.personal)[rest] = array
            else:
                client, kind, name = rest.split("|", 2)
                self.clients.setdefault(client, {}).setdefault(kind, {})[name] = array
        self.records = [*records]

    @property
    def spent(self) -> bool:
        """Return whether an update of the last round was withheld because it would have exceeded a budget."""
        return bool(self.records) and UNSENT in self.records[-1].failed.values()

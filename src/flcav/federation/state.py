"""State of a federation between rounds, as arrays for a checkpoint, and the record of each round.

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
    learned: float  # over all others, which gradients change


@dataclass(frozen=True)
class RoundDivergence(Record):
    """Weight divergence of the regions in a cloud round: of what they begin with, and of what the cloud averages."""

    begun: Divergence
    trained: Divergence


def measure_divergence(models: Sequence[Weights]) -> Divergence:
    """Return the weight divergence of models with arrays of the same names and shapes; 0 of a single one."""
    learned, statistics = learned_names(models[0]), statistics_names(models[0])
    return Divergence(
        whole=_mean_distance(models, [*learned, *statistics]),
        statistics=_mean_distance(models, statistics) if statistics else None,
        learned=_mean_distance(models, learned),
    )


def _mean_distance(models: Sequence[Weights], names: Sequence[str]) -> float:
    """Return the mean of |w_i - m| / |m| over the arrays `names`; where m is 0, of |w_i|."""
    rows = np.array([np.concatenate([np.ravel(own[name]).astype(np.float64) for name in names]) for own in models])
    mean = rows.mean(axis=0)
    return float(np.mean(np.linalg.norm(rows - mean, axis=1)) / (np.linalg.norm(mean) or 1.0))


ClientStates = dict[str, dict[str, Arrays]]  # by client and kind
ReadStates = Callable[[Iterable[str]], ClientStates]  # of what clients keep, by kind

SERVER, CLIENT, PERSONAL = "server", "client", "personal"
UNSENT = "over the budget, not sent"  # why an update is not there that its client kept
FAILED = "failed or lost"  # begins the list of clients without an update
LONGEST = 500  # characters of a client's words that are shown


@dataclass(frozen=True)
class RoundRecord(Record):
    """One round: whose updates were combined, who failed, and what the updates say of themselves.

    Where epsilon rests on secret draws of clients, it says nothing of them: no names, no loss, and a number of 0.
    """

    round: int  # from 1
    clients: tuple[str, ...]  # whose updates were combined, by name
    failed: Mapping[str, str] = field(default_factory=dict)  # by client what was wrong
    epsilon: float | None = None  # of differential privacy, of all rounds so far; None: without noise
    loss: float | None = None  # mean training loss, weighted by samples; None: no client reported one
    samples: int = 0  # of the clients together
    divergence: Annotated[RoundDivergence | None, LEFT_OUT] = None  # of the regions; None: no cloud round of several
    empty: Annotated[bool, WHERE_TRUE] = False  # no update, since clients had no samples: the model is that of before


def describe_empty(rounds: Sequence[bool]) -> str:
    """Return how many of some rounds are empty, in words; "" for none. rounds: of each, whether it is."""
    if not any(rounds):
        return ""
    return "an empty round" if len(rounds) == 1 else f"{sum(rounds)} of {len(rounds)} rounds empty"


def describe_failures(rounds: Sequence[Mapping[str, str]]) -> str:
    """Return who failed or was lost in some rounds, with the reason, and of several rounds in how many.

    rounds: of each by client what was wrong, as `RoundRecord` has it. Where nobody failed, the words are "".
    """
    failed = Counter(f"{name} ({make_printable(why, LONGEST)})" for each in rounds for name, why in each.items())
    told = ", ".join(f"{each} in {count}" if len(rounds) > 1 else each for each, count in failed.items())
    return f"{FAILED}: {told}" if told else ""


@dataclass
class FederationState:
    """State of a federation after a round: what server and clients keep for the next one, and the rounds' records.

    In a simulation it is in one place, so that a checkpoint holds all of it. Clients keep theirs to themselves; secrets
    of parties are in no message and no result, and a checkpoint keeps them apart.
    """

    server: Arrays = field(default_factory=dict)
    clients: ClientStates = field(default_factory=dict)
    records: list[RoundRecord] = field(default_factory=list)
    personal: Arrays = field(default_factory=dict)  # arrays of an edge server's region alone
    secrets: dict[str, Secret] = field(default_factory=dict, repr=False)  # of clients by name, and of `SERVER`

    def keep_secret(self, party: str) -> Secret:
        """Return the secret of a client, or of `SERVER`, that private noise is drawn by; a new one the first time."""
        return self.secrets.setdefault(party, draw_secret())

    def to_arrays(self) -> Arrays:
        """Return server's and clients' arrays in one mapping, for a safetensors file; without `secrets`."""
        found = {f"{SERVER}|{name}": array for name, array in self.server.items()}
        found |= {f"{PERSONAL}|{name}": array for name, array in self.personal.items()}
        for client, kinds in self.clients.items():
            for kind, arrays in kinds.items():
                found |= {f"{CLIENT}|{client}|{kind}|{name}": array for name, array in arrays.items()}
        return found

    def restore(self, arrays: Mapping[str, NDArray[np.number]], records: Sequence[RoundRecord]) -> None:
        """Set the state, in place, to what `to_arrays` returned and to the records; secrets stay as they are."""
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
        """Return whether an update of the last round was not sent, since it would have exceeded a budget."""
        return bool(self.records) and UNSENT in self.records[-1].failed.values()

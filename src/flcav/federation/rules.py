"""Rules of a federation: client selection, form of the updates, privacy, and the least number of updates."""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from flcav.config import Config, InputError
from flcav.federation.privacy import Privacy
from flcav.federation.selection import Selection
from flcav.federation.state import SERVER
from flcav.federation.trainable import Weights, learned_names
from flcav.federation.upload import Patterns, Upload, name_like


class SecureAggregation(Config):
    """Secure aggregation: the server learns the sum of the updates alone, and all clients count the same."""

    threshold: int | None = Field(default=None, ge=2, le=10**6)  # who have to stay; default: over 1/2, on fleets 2/3
    largest: float = Field(default=8.0, gt=0, le=1e6)  # largest change of a weight in a round; more is cut off

    def needed(self, clients: int, certified: bool = False) -> int:
        """Return the threshold of secret sharing in a round of `clients` clients.

        It is at least two, since the sum of one update is that update. Clients that are `certified` do not trust the
        server to show all of them the same list. With a threshold of two thirds they reveal too few shares to unmask a
        single update, whatever it shows them: see `SecureClient.reveal`.
        """
        least = max(clients // 2 + 1, -(-2 * clients // 3) if certified else 2, 2)
        return least if self.threshold is None else self.threshold


MOST_SAMPLES, LARGEST = 10**12, 1e12  # upper bounds of all limits


class ReplyLimits(Config):
    """Limits of one client's reply and of its training; beyond them the round goes on without the client.

    The defaults refuse what no vehicle can mean, so that sums stay finite; they are no defence against clients that lie
    within them, which lower limits and robust strategies are.
    """

    samples: int = Field(default=10**6, ge=1, le=MOST_SAMPLES)  # most that a client says it trained on
    norm: float = Field(default=LARGEST, gt=0, le=LARGEST)  # largest L2 norm of an update's change, sent or told
    loss: float = Field(default=LARGEST, gt=0, le=LARGEST)  # largest magnitude of a training loss
    train_s: float | None = Field(default=None, gt=0)  # wall time to train in a round; default: none


class RegionalModels(Config):
    """Regional models as in Ditto (Li et al., ICML 2021): each is pulled to the cloud's, but never replaced by it."""

    pull: float = Field(ge=0, le=1e6)  # lambda of the gradients g + lambda (v - w); 0: regions learn by themselves


def _check_least(value: object) -> object:
    counts = isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 10**6
    if value is None or value == "all" or counts:
        return value
    raise ValueError("expected 'all' or a whole number from 1 to 1000000")


LeastClients = Annotated[int | Literal["all"] | None, BeforeValidator(_check_least)]


class Rules(Config):
    """Rules of the rounds of a federation; by default every client sends its whole update in every round."""

    selection: Selection = Selection()  # of the clients of a round
    upload: Upload = Upload()  # form of the updates
    download: Annotated[Literal["none", "int8"], Field(exclude_if=lambda form: form == "none")] = (
        "none"  # compression of the model that vehicles begin a round with; int8: to the nearest level, by array
    )
    privacy: Privacy | None = None  # clipping and noise; default: none
    secure: SecureAggregation | None = None  # default: the server sees every update
    personal: Patterns | RegionalModels = ()  # what edge servers keep for their regions: arrays, as in `head.*`, or all
    limits: ReplyLimits = ReplyLimits()  # of what is taken from a client
    least_clients: LeastClients = (
        None  # whose updates a round needs; default: half of those asked who have samples and whom no network lost
    )
    empty_rounds: int | None = Field(
        default=None, ge=1, le=10**6
    )  # so many rounds in a row in which no client has samples end a federation; default: it goes on
    keep_optimiser: bool = False  # clients keep the state of their optimisers between rounds; default: it begins anew

    def of_servers(self) -> "Rules":
        """Return the rules among edge servers in the cloud's rounds, where these are the rules among vehicles.

        All edge servers take part, none may fail, and updates have the same form; models go down whole. Only vehicles
        add noise, since post-processing keeps differential privacy. The samples of an edge server are those of all its
        vehicles, and the limit on training time applies to vehicles only.
        """
        limits = self.limits.model_copy(update={"samples": MOST_SAMPLES, "train_s": None})
        upload = self.upload.model_copy(update={"kept": self.personal_arrays})
        return Rules(upload=upload, limits=limits, least_clients="all", empty_rounds=self.empty_rounds)

    def tell_shortage(self, clients: int) -> str:
        """Return a sentence where fewer clients take part in a round than the number `least_clients`, else ""."""
        least = self.least_clients
        if not isinstance(least, int) or clients >= least:
            return ""
        return f"least_clients: {least} are wanted in a round, and {clients} take{'s' if clients == 1 else ''} part"

    @property
    def hides_draws(self) -> bool:
        """Return whether epsilon relies on amplification by sampling, whose draws must stay secret."""
        return self.privacy is not None and self.privacy.hides_draws(self.selection)

    def secret_parties(self, clients: Sequence[str]) -> Sequence[str]:
        """Return the parties whose secrets noise is drawn with: the clients or `SERVER`; none where it is seeded."""
        if self.privacy is None or self.privacy.seeded:
            return ()
        return clients if self.privacy.local else (SERVER,)

    def settle_threshold(self, clients: Sequence[str], certified: bool) -> "Rules":
        """Return the rules with secure aggregation's threshold filled in, where all rounds have as many clients.

        Clients thus know the threshold, and refuse a server that shows them fewer peers.
        """
        if self.secure is None or self.selection.rule == "planned":
            return self
        needed = self.secure.needed(len(self.selection.choose(clients, 1, 0)), certified)
        return self.model_copy(update={"secure": self.secure.model_copy(update={"threshold": needed})})

    @property
    def personal_arrays(self) -> Patterns:
        """Return the patterns of the personal arrays, which are not averaged between regions."""
        return () if isinstance(self.personal, RegionalModels) else self.personal

    def check_personal(self, weights: Weights) -> None:
        """Raise `InputError` where a pattern of `personal` matches no array, or no learned array is left to average."""
        for pattern in self.personal_arrays:
            if not name_like(weights, (pattern,)):
                raise InputError(
                    f"personal: '{pattern}' matches none of {len(weights)} arrays, such as '{next(iter(weights))}'"
                )
        if not {*learned_names(weights)} & {*self.of_servers().upload.exchanged(weights)}:
            raise InputError(f"personal: {', '.join(self.personal_arrays)} leave nothing for the regions to average")

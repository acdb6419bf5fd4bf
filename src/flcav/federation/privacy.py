"""Client-level differential privacy: clipping of updates, Gaussian noise, its sources, and accounting of epsilon.

Central: a trusted server adds noise to the sum of the clipped changes of a round (McMahan et al., "Learning
Differentially Private Recurrent Language Models", ICLR 2018, algorithm 1 with the fixed-denominator estimator). Local:
every client adds noise to its clipped change, and the server is not trusted. Noise hides a change only from those who
cannot reproduce it: it is drawn with a party's secret, 32 bytes from the operating system, or, where it is `seeded`,
with the seed of the round, which all parties know. A secret is expanded with SHAKE256, so that noise that is seen bare,
where a weight did not change, reveals nothing about the rest.
"""

import bisect
import functools
import hashlib
import itertools
import logging
import math
import secrets
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flcav.config import Config, InputError
from flcav.federation.selection import Selection
from flcav.federation.trainable import Arrays, LocalUpdate, Weights
from flcav.federation.upload import apply_change, find_change
from flcav.statistics.streams import stream
from flcav.storage.records import Record

ROUNDING = 1e-12  # relative; above the rounding error of a clipped change's norm in float64
MOST_NOISE = 1e6
SMALLEST = 1e-12  # least epsilon in the search for the noise; its inverse is the largest
SEEDED = "seeded, no guarantee against who knows the seed"  # epsilon's remark where the noise can be reproduced


class Privacy(Config):
    """Differential privacy of a client's whole data: norm of an update, noise, and the budget that ends the rounds.

    With a budget alone the noise is the least with which it affords all planned rounds.
    """

    where: Literal["central", "local"] = "central"  # who adds the noise
    clip: float = Field(default=1.0, gt=0, le=1e6)  # largest L2 norm of a client's change in a round
    noise: float | None = Field(
        default=None, gt=0, le=MOST_NOISE
    )  # standard deviation of the noise, as a multiple of `clip`; default: by `epsilon` and the planned rounds
    delta: float = Field(default=1e-5, gt=0, lt=1)
    epsilon: float | None = Field(default=None, gt=0)  # budget: no round is begun that would exceed it
    seeded: bool = False  # noise and draws from the run's seed, to be repeated: no guarantee against who knows the seed

    @model_validator(mode="after")
    def _check_given(self) -> "Privacy":
        if self.noise is None and self.epsilon is None:
            raise ValueError("'noise' or 'epsilon' is needed: a budget alone gives the noise for the planned rounds")
        return self

    @property
    def multiplier(self) -> float:
        """Return the noise multiplier, `noise`; raises ValueError where it is not known yet."""
        if self.noise is None:
            raise ValueError("noise that no rounds have been planned for")
        return self.noise

    @property
    def deviation(self) -> float:
        """Return the noise's standard deviation, in units of a weight; raises ValueError where it is not known yet."""
        return self.multiplier * self.clip

    @property
    def local(self) -> bool:
        """Return whether the clients add the noise, to their updates."""
        return self.where == "local"

    def hides_draws(self, selection: Selection) -> bool:
        """Return whether epsilon relies on amplification by sampling, whose draws must stay secret."""
        return not self.seeded and self.amplified(selection)

    def amplified(self, selection: Selection) -> bool:
        """Return whether sampling of a round's clients amplifies privacy, if it is secret."""
        return not self.local and selection.rule in ("poisson", "uniform")


def clip_change(change: Weights, norm: float) -> dict[str, NDArray[np.float64]]:
    """Return a change in float64, scaled down so that its L2 norm over all arrays is at most `norm`.

    In a narrower type rounding could lengthen the scaled array again, which would break the bound on sensitivity.
    """
    length = change_norm(change)
    factor = 1.0 if length <= norm else norm / length * (1 - ROUNDING)
    return {name: array.astype(np.float64) * factor for name, array in change.items()}


def change_norm(change: Weights) -> float:
    """Return the L2 norm of a change over all its arrays."""
    return float(np.sqrt(sum(float(np.sum(np.square(array, dtype=np.float64))) for array in change.values())))


def add_noise(change: Weights, privacy: Privacy, seed: int, key: bytes | None) -> Arrays:
    """Return a change plus independent Gaussian noise with the standard deviation `noise` x `clip` per coordinate.

    seed: of the round, for seeded noise. key: of the round, for all other noise. Raises ValueError where it is missing.
    """
    if key is None and not privacy.seeded:
        raise ValueError("noise without a secret to draw it by")
    source: Normals = stream(seed, "noise") if privacy.seeded or key is None else secret_noise(key, change)
    return {
        name: (array + source.normal(scale=privacy.deviation, size=array.shape)).astype(array.dtype)
        for name, array in change.items()
    }


def average_privately(
    start: Weights,
    updates: Sequence[LocalUpdate],
    names: Sequence[str],
    privacy: Privacy,
    expected: float,
    seed: int,
    key: bytes | None = None,
) -> Weights:
    """Return start + (sum of clipped changes + noise) / expected for the arrays `names`; others are those of `start`.

    `expected` is the expected number of clients in a round. It is fixed, since a division by the number that came would
    change the sensitivity (McMahan et al., ICLR 2018). The noise is N(0, (noise clip)^2) per coordinate of the sum, and
    clients are weighted equally. `seed` and `key` are those of `add_noise`.
    """
    total: Arrays = {name: np.zeros(start[name].shape) for name in names}
    for update in updates:
        for name, array in clip_change(find_change(update.weights, start, names), privacy.clip).items():
            total[name] += array
    noisy = add_noise(total, privacy, seed, key)
    return apply_change(start, {name: array / expected for name, array in noisy.items()})


def expected_clients(selection: Selection, names: Sequence[str]) -> float:
    """Return the expected number of clients in a round by a selection."""
    if selection.rule == "poisson":
        assert selection.probability is not None
        return selection.probability * len(names)
    return float(len(selection.choose(names, 1, 0)))


@dataclass(frozen=True)
class RoundNoise(Record):
    """The noise of a round compared with its updates: L2 norms over all values that are learned and sent."""

    clients: float  # expected number in a round
    values: int  # d, length of an update
    norm: float  # expected norm of the noise in the sum of the updates
    most: float  # greatest norm of the sum of clipped updates: all point the same way

    @property
    def drowns(self) -> bool:
        """Return whether the norm of the noise exceeds the greatest norm of the sum of the updates."""
        return self.norm > self.most

    def describe(self) -> str:
        """Return the comparison in words, with what would help where the noise is longer."""
        compared = (
            f"noise of a round {self.norm:.3g} over {self.values:,} values, beside {self.most:.3g} at most of the "
            f"clipped updates of {self.clients:g} vehicles"
        )
        if not self.drowns:
            return compared
        return (
            f"WARNING: {compared}: {self.norm / self.most:.3g} times as long, which can ruin the network; less noise "
            "(a larger epsilon, fewer rounds), more vehicles in a round, or fewer layers (upload.layers) make it "
            "shorter"
        )


def measure_round_noise(privacy: Privacy, clients: float, values: int) -> RoundNoise:
    """Return the norm of a round's noise, sigma C sqrt(d), and the greatest norm of the sum of its updates, n C.

    clients: expected number n in a round. values: number d of values that are learned and sent. With local noise, the
    sum has sqrt(n) times as much. The change of the weights, the mean, is 1 / n of both. Raises ValueError where the
    noise is not known yet.
    """
    norm = privacy.deviation * math.sqrt(values * (clients if privacy.local else 1.0))
    return RoundNoise(clients, values, norm, clients * privacy.clip)


def account_epsilon(privacy: Privacy, selection: Selection, names: Sequence[str], rounds: int) -> float:
    """Return epsilon at `privacy.delta` after this many rounds of one training: see `compose_epsilon`."""
    return compose_epsilon(privacy, selection, [(len(names), rounds)])


def compose_epsilon(
    privacy: Privacy,
    selection: Selection,
    trainings: Iterable[tuple[int, int]],
    noises: Iterable[float | None] = itertools.repeat(None),
) -> float:
    """Return epsilon at `privacy.delta` of several trainings with one client's data, by Renyi differential privacy.

    trainings: numbers of clients and of rounds per training; round-robin continues over all rounds of a training, and
    restarts with the next. noises: noise multiplier per training (None: that of `privacy`).

    Central noise, Poisson sampling: amplified; neighbouring data sets differ by one client, added or removed. Central
    noise, a fixed number drawn without replacement: amplified; neighbours differ in the data of one client, which
    changes the sum by up to twice the clipping norm. All other selections, and local noise, are not amplified: epsilon
    is that of the client that takes part most often. Local noise protects between any two data sets of a client, whose
    changes are again up to twice the norm apart.
    """
    import dp_accounting  # 1 s
    from dp_accounting import rdp

    # replacing a client's data changes the sum by up to twice the norm, which equals half the noise multiplier
    replaced = privacy.local or selection.rule == "uniform"  # neighbours by replacement; else by addition or removal
    times = Counter[tuple[int, float]]()  # rounds by number of clients and noise multiplier
    for (clients, rounds), found in zip(trainings, noises, strict=False):
        noise = privacy.multiplier if found is None else found
        taken = rounds if privacy.amplified(selection) else most_participations(selection, clients, rounds)
        times[clients, noise / 2 if replaced else noise] += taken
    # Renyi divergences add up under composition, so that equal events are measured once and multiplied
    accountant = rdp.RdpAccountant()
    orders: Any = accountant._orders
    spent: Any = accountant._rdp  # Renyi divergence, by order
    for (clients, noise), number in (+times).items():
        gaussian = dp_accounting.GaussianDpEvent(noise)
        event: dp_accounting.DpEvent = gaussian
        if privacy.amplified(selection) and selection.rule == "poisson":
            assert selection.probability is not None
            event = dp_accounting.PoissonSampledDpEvent(selection.probability, gaussian)
        elif privacy.amplified(selection):
            assert selection.clients is not None
            event = dp_accounting.SampledWithoutReplacementDpEvent(clients, selection.clients, gaussian)
        spent = spent + number * _measure_divergence(event)
    return float(rdp.compute_epsilon(orders, spent, privacy.delta)[0])


@functools.lru_cache(maxsize=1024)
def _measure_divergence(event: Any) -> NDArray[np.float64]:
    """Return the Renyi divergence of an event of `dp_accounting` at each of the accountant's orders."""
    from dp_accounting import NeighboringRelation, SampledWithoutReplacementDpEvent, rdp

    logging.getLogger("absl").setLevel(logging.ERROR)  # warns of each order of Renyi divergence that it leaves out
    one_replaced = isinstance(event, SampledWithoutReplacementDpEvent)
    relation = NeighboringRelation.REPLACE_ONE if one_replaced else NeighboringRelation.ADD_OR_REMOVE_ONE
    accountant = rdp.RdpAccountant(neighboring_relation=relation)
    accountant.compose(event)
    return accountant._rdp


def find_noise(privacy: Privacy, selection: Selection, clients: int, rounds: int) -> Privacy:
    """Return privacy with its noise or, where it has none, the least with three digits that affords all rounds."""
    if privacy.noise is not None or privacy.epsilon is None:
        return privacy

    noise = _find_least_noise(privacy.model_dump_json(), selection.model_dump_json(), clients, max(rounds, 1))
    return privacy.model_copy(update={"noise": noise})


@functools.lru_cache(maxsize=256)
def _find_least_noise(privacy: str, selection: str, clients: int, rounds: int) -> float:
    """Return the noise of `find_noise`; the settings are JSON, so that they can be keys of the cache."""
    from scipy.optimize import root_scalar  # the processes of a fleet start without it

    asked, drawn = Privacy.model_validate_json(privacy), Selection.model_validate_json(selection)

    def exceeds(exponent: float) -> float:
        """Return the logarithm of epsilon over the budget, for noise of 10^exponent."""
        with_noise = asked.model_copy(update={"noise": 10**exponent})
        spent = compose_epsilon(with_noise, drawn, [(clients, rounds)])
        return float(np.log(np.clip(spent, SMALLEST, 1 / SMALLEST) / (asked.epsilon or 1.0)))

    ends = -2.0, math.log10(MOST_NOISE)
    if exceeds(ends[1]) > 0:
        return MOST_NOISE
    found = ends[0] if exceeds(ends[0]) <= 0 else float(root_scalar(exceeds, bracket=ends, xtol=1e-5).root)
    # rounded up to three digits; the tolerance of the root may cost one unit more
    place = 10 ** (2 - math.floor(found))
    noise = math.ceil(10**found * place) / place
    return noise if exceeds(math.log10(noise)) <= 0 else min(noise + 1 / place, MOST_NOISE)


def most_participations(selection: Selection, clients: int, rounds: int) -> int:
    """Return the largest number of rounds that one client can take part in, of the first `rounds` of a training."""
    if selection.rule != "round-robin":
        return rounds
    assert selection.clients is not None
    return -(-rounds * selection.clients // clients)


def least_participations(selection: Selection, clients: int, rounds: int) -> int:
    """Return the number of rounds that every available client took part in, of the first `rounds`."""
    return rounds * (selection.clients or 0) // clients if selection.rule == "round-robin" else rounds


def affordable_rounds(privacy: Privacy, selection: Selection, names: Sequence[str], rounds: int, earlier: int) -> int:
    """Return the number of `count_affordable`; raises `InputError` where not a single round is affordable."""
    afforded = count_affordable(privacy, selection, names, rounds, earlier)
    if afforded < min(rounds, 1):
        epsilon = f"{account_epsilon(privacy, selection, names, earlier + 1):.4g} at delta = {privacy.delta:g}"
        raise InputError(
            f"privacy: {'a first' if not earlier else 'another'} round comes to epsilon = {epsilon}, above the budget "
            f"of {privacy.epsilon:g}; more noise, or fewer clients in a round, cost less"
        )
    return afforded


def count_affordable(privacy: Privacy, selection: Selection, names: Sequence[str], rounds: int, earlier: int) -> int:
    """Return how many of `rounds` rounds the privacy budget affords, after `earlier` ones with the same clients."""

    def exceeds(number: int) -> bool:
        return account_epsilon(privacy, selection, names, earlier + number) > (privacy.epsilon or math.inf)

    if privacy.epsilon is None or rounds == 0:
        return rounds
    # epsilon increases with the number of rounds
    return max(bisect.bisect_left(range(rounds + 1), True, key=exceeds) - 1, 0)


Secret = NDArray[np.uint8]  # (32,)
SECRET_BYTES = 32


class Normals(Protocol):
    """A source of Gaussian random numbers, such as NumPy's generators."""

    def normal(self, *, scale: float, size: tuple[int, ...]) -> NDArray[np.float64]:
        """Return numbers of mean 0 and standard deviation `scale`."""
        ...


class SecretNormals:
    """Gaussian numbers by the Box-Muller transform of SHAKE256's output for a key; equal keys give equal numbers."""

    def __init__(self, key: bytes) -> None:
        """Draw with `key`, which must be used for a single change."""
        self._key = key
        self._arrays = 0

    def normal(self, *, scale: float, size: tuple[int, ...]) -> NDArray[np.float64]:
        """Return numbers of mean 0 and standard deviation `scale`."""
        count = math.prod(size)
        self._arrays += 1
        # another key per array; 53 random bits per number, never 0, whose logarithm is taken
        pairs = -(-count // 2)
        drawn = hashlib.shake_256(_derive(self._key, f"array {self._arrays}")).digest(16 * pairs)
        uniform = ((np.frombuffer(drawn, "<u8") >> np.uint64(11)) + 1.0) * 2.0**-53  # in (0, 1]
        radius, angle = np.sqrt(-2.0 * np.log(uniform[:pairs])), 2.0 * np.pi * uniform[pairs:]
        found = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])
        return scale * found[:count].reshape(size)


def draw_secret() -> Secret:
    """Return a new secret from the operating system's randomness."""
    return np.frombuffer(secrets.token_bytes(SECRET_BYTES), np.uint8)


def derive_key(secret: Secret, purpose: str, round_: int, seed: int) -> bytes:
    """Return the 32-byte key derived from a secret for a purpose in one round; `seed` is the round's, and public."""
    return _derive(secret.tobytes(), f"{purpose} {round_} {seed}")


def secret_noise(key: bytes, change: Weights) -> SecretNormals:
    """Return the noise of a change in the round of `key`: the same for equal changes, independent for different ones.

    A round that is repeated after a stop thus sends the same message again, and no difference of two messages cancels
    the noise.
    """
    hashed = hashlib.blake2b(key=key, digest_size=SECRET_BYTES)
    for name, array in change.items():
        hashed.update(f"{name} {array.dtype} {array.shape} ".encode())
        hashed.update(np.ascontiguousarray(array).tobytes())
    return SecretNormals(hashed.digest())


def _derive(key: bytes, purpose: str) -> bytes:
    return hashlib.blake2b(purpose.encode(), key=key, digest_size=SECRET_BYTES).digest()

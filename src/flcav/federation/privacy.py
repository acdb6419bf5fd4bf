"""Differential privacy of clients: clipped updates, Gaussian noise, its sources, and an account of epsilon.

Central: a trusted server adds noise to the sum of the clipped changes of a round (McMahan et al., "Learning
Differentially Private Recurrent Language Models", ICLR 2018, algorithm 1 with the fixed-denominator estimator). Local:
every client adds noise to its clipped change, and the server is not trusted. Noise hides a change only from those who
cannot repeat it: it is drawn by a party's secret, 32 bytes of the operating system, or, where it is `seeded`, by the
seed of the round, which all know. By a secret it is drawn with SHAKE256, so that noise that is seen bare, where a
weight did not change, reveals nothing of the rest.
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

ROUNDING = 1e-12  # relative: more than the sum of squares of a clipped change is off in float64
MOST_NOISE = 1e6
SMALLEST = 1e-12  # epsilon, and the inverse of the largest, that noise is sought for
SEEDED = "seeded, no guarantee against who knows the seed"  # of epsilon whose noise can be drawn again


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
        """Return `noise`; raises ValueError where it is not known yet."""
        if self.noise is None:
            raise ValueError("noise that no rounds have been planned for")
        return self.noise

    @property
    def deviation(self) -> float:
        """Return the standard deviation of the noise; raises ValueError where it is not known yet."""
        return self.multiplier * self.clip

    @property
    def local(self) -> bool:
        """Return whether each client adds noise to its own update."""
        return self.where == "local"

    def hides_draws(self, selection: Selection) -> bool:
        """Return whether epsilon is amplified by draws of clients that are to stay secret."""
        return not self.seeded and self.amplified(selection)

    def amplified(self, selection: Selection) -> bool:
        """Return whether secret sampling of the clients of a round amplifies privacy."""
        return not self.local and selection.rule in ("poisson", "uniform")


def clip_change(change: Weights, norm: float) -> dict[str, NDArray[np.float64]]:
    """Return a change in float64, scaled down so that its L2 norm over all arrays is at most `norm`.

    In fewer bits a scaled array could be longer again: each number would be rounded, tiny ones by as much as they are.
    """
    length = change_norm(change)
    factor = 1.0 if length <= norm else norm / length * (1 - ROUNDING)
    return {name: array.astype(np.float64) * factor for name, array in change.items()}


def change_norm(change: Weights) -> float:
    """Return the L2 norm of a change over all its arrays."""
    return float(np.sqrt(sum(float(np.sum(np.square(array, dtype=np.float64))) for array in change.values())))


def add_noise(change: Weights, privacy: Privacy, seed: int, key: bytes | None) -> Arrays:
    """Return a change with independent Gaussian noise of the deviation `noise` x `clip` on every coordinate.

    seed: of the round, which seeded noise is drawn by. key: of the round, which all other noise is drawn by. Raises
    ValueError where it is missing.
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
    """Return start + (sum of clipped changes + noise) / expected, of the arrays `names`; all others as in `start`.

    `expected` is the number of clients that are expected in a round, whether they came or not: the noise is
    N(0, (noise clip)^2) per coordinate of the sum, and every client counts the same. `seed` and `key` are as in
    `add_noise`.
    """
    total: Arrays = {name: np.zeros(start[name].shape) for name in names}
    for update in updates:
        for name, array in clip_change(find_change(update.weights, start, names), privacy.clip).items():
            total[name] += array
    noisy = add_noise(total, privacy, seed, key)
    return apply_change(start, {name: array / expected for name, array in noisy.items()})


def expected_clients(selection: Selection, names: Sequence[str]) -> float:
    """Return the number of clients that a selection lets take part in a round, in the mean."""
    if selection.rule == "poisson":
        assert selection.probability is not None
        return selection.probability * len(names)
    return float(len(selection.choose(names, 1, 0)))


@dataclass(frozen=True)
class RoundNoise(Record):
    """The noise of a round beside what it is to hide: L2 norms over all values that are learned and sent."""

    clients: float  # that a round expects
    values: int  # d, of an update
    norm: float  # expected norm of the noise in the sum of the updates
    most: float  # norm of the sum of clipped updates, if all point the same way

    @property
    def drowns(self) -> bool:
        """Return whether the noise is longer than all updates together can be."""
        return self.norm > self.most

    def describe(self) -> str:
        """Return the comparison in words, with what would help where the noise is longer."""
        told = (
            f"noise of a round {self.norm:.3g} over {self.values:,} values, beside {self.most:.3g} at most of the "
            f"clipped updates of {self.clients:g} vehicles"
        )
        if not self.drowns:
            return told
        return (
            f"WARNING: {told}: {self.norm / self.most:.3g} times as long, which can ruin the network; less noise (a "
            "larger epsilon, fewer rounds), more vehicles in a round, or fewer layers (upload.layers) make it shorter"
        )


def measure_round_noise(privacy: Privacy, clients: float, values: int) -> RoundNoise:
    """Return the noise of a round beside the most that its updates add up to: sigma C sqrt(d) and n C.

    clients: n, expected in a round. values: d, that are learned and sent. Where each client adds noise, the sum has
    sqrt(n) times as much. The mean that the weights change by is 1 / n of both. Raises ValueError where the noise is
    not known yet.
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

    trainings: of each the number of clients, in the same order, and of rounds; the turns of round-robin go on in all
    rounds of a training, and restart with the next. noises: of each training (None: that of `privacy`).

    Central, Poisson sampling: amplified, neighbours differ by a client that is added or removed. Central, a fixed
    number drawn without replacement: amplified, neighbours differ in the data of one client, which changes a sum by up
    to twice the norm. All other selections, and local noise, are not amplified: the account is of a client that takes
    part as often as any. Local noise is between any two data sets of a client, again twice the norm apart.
    """
    import dp_accounting  # 1 s
    from dp_accounting import rdp

    replaced = privacy.local or selection.rule == "uniform"  # else a client is added or removed
    times = Counter[tuple[int, float]]()  # by number of clients, and noise
    for (clients, rounds), found in zip(trainings, noises, strict=False):
        noise = privacy.multiplier if found is None else found
        taken = rounds if privacy.amplified(selection) else most_participations(selection, clients, rounds)
        times[clients, noise / 2 if replaced else noise] += taken
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
    """Return privacy with noise: its own or, without, the least with three digits that affords all these rounds."""
    if privacy.noise is not None or privacy.epsilon is None:
        return privacy

    noise = _find_least_noise(privacy.model_dump_json(), selection.model_dump_json(), clients, max(rounds, 1))
    return privacy.model_copy(update={"noise": noise})


@functools.lru_cache(maxsize=256)
def _find_least_noise(privacy: str, selection: str, clients: int, rounds: int) -> float:
    """Return the noise of `find_noise`; settings are JSON, by which they are looked up."""
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
    place = 10 ** (2 - math.floor(found))
    noise = math.ceil(10**found * place) / place
    return noise if exceeds(math.log10(noise)) <= 0 else min(noise + 1 / place, MOST_NOISE)


def most_participations(selection: Selection, clients: int, rounds: int) -> int:
    """Return the most rounds, of the first `rounds` of a training, that a client can take part in."""
    if selection.rule != "round-robin":
        return rounds
    assert selection.clients is not None
    return -(-rounds * selection.clients // clients)


def least_participations(selection: Selection, clients: int, rounds: int) -> int:
    """Return how many of the first `rounds` rounds every client took part in that could."""
    return rounds * (selection.clients or 0) // clients if selection.rule == "round-robin" else rounds


def affordable_rounds(privacy: Privacy, selection: Selection, names: Sequence[str], rounds: int, earlier: int) -> int:
    """Return the number of `count_affordable`; raises `InputError` where it is 0 of some rounds."""
    afforded = count_affordable(privacy, selection, names, rounds, earlier)
    if afforded < min(rounds, 1):
        told = f"{account_epsilon(privacy, selection, names, earlier + 1):.4g} at delta = {privacy.delta:g}"
        raise InputError(
            f"privacy: {'a first' if not earlier else 'another'} round comes to epsilon = {told}, above the budget of "
            f"{privacy.epsilon:g}; more noise, or fewer clients in a round, cost less"
        )
    return afforded


def count_affordable(privacy: Privacy, selection: Selection, names: Sequence[str], rounds: int, earlier: int) -> int:
    """Return how many of `rounds` rounds the privacy budget affords, after `earlier` ones with the same clients."""

    def exceeds(number: int) -> bool:
        return account_epsilon(privacy, selection, names, earlier + number) > (privacy.epsilon or math.inf)

    if privacy.epsilon is None or rounds == 0:
        return rounds
    return max(bisect.bisect_left(range(rounds + 1), True, key=exceeds) - 1, 0)


Secret = NDArray[np.uint8]  # (32,)
SECRET_BYTES = 32


class Normals(Protocol):
    """Source of normal numbers, as NumPy's generators are."""

    def normal(self, *, scale: float, size: tuple[int, ...]) -> NDArray[np.float64]:
        """Return numbers of mean 0 and standard deviation `scale`."""
        ...


class SecretNormals:
    """Normal numbers by Box and Muller from the output of SHAKE256 for a key; equal keys give equal numbers."""

    def __init__(self, key: bytes) -> None:
        """Draw by `key`, which is to be used for one change alone."""
        self._key, self._arrays = key, 0

    def normal(self, *, scale: float, size: tuple[int, ...]) -> NDArray[np.float64]:
        """Return numbers of mean 0 and standard deviation `scale`."""
        count, self._arrays = math.prod(size), self._arrays + 1
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
    """Return the 32-byte key of a secret for a purpose in one round; `seed` is the round's, which others know."""
    return _derive(secret.tobytes(), f"{purpose} {round_} {seed}")


def secret_noise(key: bytes, change: Weights) -> SecretNormals:
    """Return the noise of a change in the round of `key`: the same for the same change, and for another one another.

    So a round that is repeated after a stop sends the same again, and the difference of two messages reveals no change.
    """
    hashed = hashlib.blake2b(key=key, digest_size=SECRET_BYTES)
    for name, array in change.items():
        hashed.update(f"{name} {array.dtype} {array.shape} ".encode())
        hashed.update(np.ascontiguousarray(array).tobytes())
    return SecretNormals(hashed.digest())


def _derive(key: bytes, purpose: str) -> bytes:
    return hashlib.blake2b(purpose.encode(), key=key, digest_size=SECRET_BYTES).digest()

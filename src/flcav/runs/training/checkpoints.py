"""Checkpoints of a federation, written after every round, and the network that its rounds result in.

A checkpoint has the SHA-256 of the files that belong to it. The last two are kept, so that a damaged file costs one
round.
"""

import contextlib
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from flcav.config import InputError, Json, read_json
from flcav.federation.exchange import Diverged
from flcav.federation.privacy import Privacy, Secret
from flcav.federation.state import FederationState, RoundRecord, describe_empty, describe_failures
from flcav.federation.strategies.fedavg import average
from flcav.federation.trainable import Weights
from flcav.interface.progress import DAMAGED, Report
from flcav.network.ledger import BudgetExceeded, Ledger
from flcav.perception.task import ConfigT, NetworkT, SampleT, Task
from flcav.perception.weights import from_arrays, save_network, to_arrays
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.results.training import PrivacySpent, diverges, last_sound_round
from flcav.storage.files import flush_all, sha256, write_bytes, write_in_pieces, write_json
from flcav.storage.records import Record

LOSS = "loss"  # first word of a round's note


@dataclass
class FederationCheckpoints:
    """Checkpoints of a federation: weights, loss, ledger and states after every round, to resume from."""

    task: Task
    folder: Path
    book: Ledger
    report: Report
    states: Mapping[str, FederationState]  # by name of the federation, also of edge servers; restored in place
    identity: str  # strategy and rules of the federation: a checkpoint of another one is refused
    rounds: int = 0  # planned number, for reports
    privacy: Privacy | None = None  # of the updates; its delta is reported with epsilon
    score: Callable[[int], Mapping[str, float]] | None = None  # on validation frames after a round, by region
    first_loss: float | None = None  # of the previous stage, to detect divergence; None: that of the first round
    losses: list[float | None] = field(default_factory=list)  # mean training loss by round
    scores: list[Mapping[str, float]] = field(default_factory=list)  # by round and region
    _hashes: dict[str, str] = field(default_factory=dict)  # SHA-256 of the files of weights, by name
    _reported: dict[str, int] = field(default_factory=dict)  # number of records whose failures were reported, by state
    _resumed: bool = False  # whether earlier rounds of an unfinished federation are continued
    _broken: bool = False  # whether updates of the round after `losses` were not finite

    def resume(self, weights: Weights) -> tuple[Weights, int]:
        """Restore ledger, losses and states; return the weights and the number of the last round.

        The weights have the order of `weights`. Without a checkpoint, returns `weights` and 0; where the last one is
        damaged, the round before it. Raises `InputError` for a checkpoint of another strategy or other rules, and where
        the last two are damaged.
        """
        found, damage = find_checkpoint(self.folder)
        number = 0 if found is None else found.round
        if damage:
            self.report(number, max(number, 1), damage)
        self._resumed = bool(damage) or (found is not None and not (self.folder / LEDGER).exists())
        if found is None:
            return weights, 0
        if found.by != self.identity:
            raise InputError(f"{self.folder}: a checkpoint of {found.by}, which {self.identity} cannot go on with")
        kept = Ledger.load(self.folder / _ledger_name(number)).entries[: found.entries]
        for entry in kept[len(self.book.entries) :]:
            self.book.enter(entry)
        self.losses = [*found.losses]
        self.scores = [*found.scores]
        state = _state_name(number)
        names = [round_path(self.folder, round_).name for round_ in range(1, number + 1)]
        self._hashes = {name: found.sha256[name] for name in names}
        arrays = load_file(self.folder / state) if state in found.sha256 else {}
        for name, kept_state in self.states.items():
            begins = f"{name}|"
            restored = {key.removeprefix(begins): array for key, array in arrays.items() if key.startswith(begins)}
            kept_state.restore(restored, found.records[name])
            self._reported[name] = len(kept_state.records)
        last = load_file(round_path(self.folder, number))
        # Files have another order of names, and noise is drawn array by array: the order must be that of `weights`.
        return {name: last[name] for name in weights}, number

    def keep_secrets(self, parties: Mapping[str, Sequence[str]]) -> None:
        """Restore the secrets of the `parties`, by name of their state, or draw them before the first round.

        To be called after `resume`. Secrets are kept in a file, so that a repeated round has the same noise: with other
        noise it would spend its privacy twice. `finish` removes the file. Raises `InputError` where it is damaged, or
        missing although secrets were drawn.
        """
        owners = {f"{name}|{party}": (name, party) for name, members in parties.items() for party in members}
        if not owners:
            return
        kept = read_secrets(self.folder, owners, self._resumed)
        for key, (name, party) in owners.items():
            if key in kept:
                self.states[name].secrets[party] = kept[key]
        drawn = {key: self.states[name].keep_secret(party) for key, (name, party) in owners.items()}
        write_secrets(self.folder, drawn)

    @contextlib.contextmanager
    def refusals(self) -> Iterator[None]:
        """Remove the secrets if the federation is refused within the context, and so never continues.

        A refusal is final before an update was sent; later only where a budget would be exceeded, since damaged data
        can be repaired.
        """
        begun = len(self.book.entries)
        try:
            yield
        except InputError as error:
            used = bool(self.losses) or any(entry.direction == "up" for entry in self.book.entries[begun:])
            if not used or isinstance(error, BudgetExceeded):
                remove_secrets(self.folder, used=used)
            raise

    @property
    def kept(self) -> int | None:
        """The round whose weights are kept because the training diverges; None: the last."""
        before = [] if self.first_loss is None else [self.first_loss]
        losses = [*before, *self.losses]
        return max(last_sound_round(losses) - len(before), 0) if self._broken or diverges(losses) else None

    @contextlib.contextmanager
    def divergence(self) -> Iterator[None]:
        """Stop the federation, and report it, where after the first round the clients' updates are not finite."""
        try:
            yield
        except Diverged as error:
            if not self.losses:
                raise
            self._broken = True
            self.report(len(self.losses), self.rounds, f"{error}: {self._describe_divergence()}")

    def _describe_divergence(self) -> str:
        at = f"after round {self.kept}" if self.kept else "that it began with"
        return f"the training diverges and stops, with the weights {at}"

    def save(self, round_: int, weights: Weights, loss: float | None) -> None:
        """Save the checkpoint after a round, and report its loss, privacy, scores and failures."""
        self.losses.append(loss)
        self._write(round_path(self.folder, round_).name, save(dict(weights)), self._hashes)
        self.scores += [self.score(round_)] if self.score is not None else []
        states = self.states.items()
        arrays = {f"{name}|{key}": array for name, state in states for key, array in state.to_arrays().items()}
        hashes = dict(self._hashes)
        if arrays:
            self._write(_state_name(round_), save(arrays), hashes)
        self.book.save(self.folder / _ledger_name(round_))
        hashes[_ledger_name(round_)] = sha256(self.folder / _ledger_name(round_))
        records = {name: tuple(state.records) for name, state in states}
        done = (round_, len(self.book.entries), tuple(self.losses), self.identity, hashes, records)
        # The record comes last: until it is written, the files of this round do not count, and the round is repeated.
        Checkpoint(*done, tuple(self.scores)).keep(self.folder)
        for name in (_state_name(round_ - 2), _ledger_name(round_ - 2)):
            (self.folder / name).unlink(missing_ok=True)
        note = [f"{LOSS} {loss:.3f}" if loss is not None else f"no {LOSS}", *self._describe_privacy()]
        note += [self._describe_divergence()] if self.kept is not None else []
        note += [f"{region} {score:.3f}" for region, score in (self.scores[-1] if self.score else {}).items()]
        self.report(round_, self.rounds, ", ".join([*note, *self._describe_failures()]))

    def _describe_privacy(self) -> list[str]:
        """Describe the largest epsilon after the last round, with its delta; empty without noise."""
        spent = [state.records[-1].epsilon for state in self.states.values() if state.records]
        private = [epsilon for epsilon in spent if epsilon is not None]
        if self.privacy is None or not private:
            return []
        return [PrivacySpent(max(private), self.privacy.delta, self.privacy.seeded).describe()]

    def _describe_failures(self) -> list[str]:
        """Describe the empty rounds and the failed or lost clients since the last note.

        In stage III these are of all rounds of the edge servers.
        """
        states = self.states.items()
        new = [record for name, state in states for record in state.records[self._reported.get(name, 0) :]]
        self._reported = {name: len(state.records) for name, state in states}
        notes = describe_empty([record.empty for record in new]), describe_failures([record.failed for record in new])
        return [note for note in notes if note]

    def _write(self, name: str, data: bytes, hashes: dict[str, str]) -> None:
        write_bytes(self.folder / name, data)
        hashes[name] = hashlib.sha256(data).hexdigest()

    def finish(self, start: Any, averaged: int, start_share: float = 0.0) -> tuple[float | None, ...]:
        """Write the ledger and the final weights, see `load_round_network`; return the losses by round.

        Without rounds the weights are those of `start`; where the training diverges, those of the last sound round.
        Secrets are removed.
        """
        network = start
        rounds = len(self.losses) if self.kept is None else self.kept
        if rounds:
            network = load_round_network(self.task, start, self.folder, rounds, averaged, start_share)
        save_network(self.task, network, self.folder / WEIGHTS)
        self.book.save(self.folder / LEDGER)
        remove_secrets(self.folder)
        return tuple(self.losses)


def _state_name(round_: int) -> str:
    return f"state{round_}.safetensors"


def _ledger_name(round_: int) -> str:
    return f"ledger{round_}.parquet"


def round_path(folder: Path, round_: int) -> Path:
    """Return the path of a federation's weights after a round."""
    return folder / f"round{round_}.safetensors"


def load_round_network(
    task: Task[ConfigT, NetworkT, SampleT],
    start: NetworkT,
    folder: Path,
    round_: int,
    averaged: int,
    start_share: float = 0.0,
) -> NetworkT:
    """Return the network of a federation that ends with a round: the mean of the last `averaged` rounds' weights.

    A share `start_share` of it are the weights of the network `start` at the federation's beginning, as in Wortsman et
    al., Robust fine-tuning of zero-shot models, CVPR 2022, equation 1.
    """
    last = range(max(round_ - averaged, 0) + 1, round_ + 1)
    first = to_arrays(start)
    rounds = [load_file(round_path(folder, number)) for number in last]
    parts = [first, *({name: weights[name] for name in first} for weights in rounds)]  # files have another order
    config: Any = start.config
    network = task.build(config)
    from_arrays(network, average(parts, [start_share, *((1 - start_share) / len(last) for _ in last)]))
    return network.eval()


LAST, BEFORE = "round.json", "round-before.json"  # the last checkpoint, and the one before
RECORD_HASH = "own_sha256"  # field with the SHA-256 of all other fields of the record


@dataclass(frozen=True)
class Checkpoint(Record):
    """The checkpoint of a federation after a round."""

    round: int
    entries: int  # number of ledger entries at that time
    losses: tuple[float | None, ...]  # mean training loss by round
    by: str  # strategy and rules of the federation
    sha256: Mapping[str, str]  # by file name: weights of all rounds, ledger, and state where there is any
    records: Mapping[str, tuple[RoundRecord, ...]] = field(default_factory=dict)  # of the rounds, by federation
    scores: tuple[Mapping[str, float], ...] = ()  # on validation frames, by round and region

    def find_damage(self, folder: Path) -> str | None:
        """Return the name of a missing or damaged file; None if all are intact."""
        for name, known in self.sha256.items():
            if not (folder / name).exists() or sha256(folder / name) != known:
                return name
        return None

    def keep(self, folder: Path) -> None:
        """Write the checkpoint as the last one, after moving the present last one to `BEFORE`."""
        if (folder / LAST).exists():
            write_bytes(folder / BEFORE, (folder / LAST).read_bytes())
        values = self.as_json()
        write_json(folder / LAST, values | {RECORD_HASH: hash_json(values)}, sort=False)

    @classmethod
    def read(cls, folder: Path, name: str) -> "Checkpoint":
        """Read a checkpoint that `keep` wrote; raises `InputError` where it has changed since."""
        values = read_json(folder / name)
        known = values.pop(RECORD_HASH, None) if isinstance(values, dict) else None
        if known != hash_json(values):
            raise InputError(f"{folder / name} {DAMAGED}")
        return cls.from_json(values, str(folder / name))


def hash_json(values: Json) -> str:
    """Return the SHA-256 of a JSON value, independent of the order of its keys."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def find_checkpoint(folder: Path) -> tuple[Checkpoint | None, str]:
    """Return the last intact checkpoint, and a sentence about damaged ones ("" where there is none).

    None means the beginning: there is no checkpoint, or the only one is damaged. Raises `InputError` where the last two
    are damaged.
    """
    damages = []
    for name in (LAST, BEFORE):
        if not (folder / name).exists():
            continue
        try:
            found = Checkpoint.read(folder, name)
            damaged = found.find_damage(folder)
        except InputError:
            damaged = name
        else:
            if damaged is None:
                return found, "; ".join(damages)
        damages.append(f"{folder / damaged} {DAMAGED}, the checkpoint before it is used")
    if len(damages) == 2:
        raise InputError(f"{folder}: the last two checkpoints are damaged; remove the folder to begin anew")
    return None, "; ".join(damages)


SECRETS, SECRETS_HASH, PART = "secrets.safetensors", "secrets.sha256", ".secrets."
HASH = re.compile(rb"[0-9a-f]{64}")


def read_secrets(folder: Path, names: Collection[str], begun: bool) -> dict[str, Secret]:
    """Read the secrets of a federation, by name; empty before they are drawn.

    `names`: the secrets that it needs. `begun`: whether it has sent messages, which the presence of the hash also
    indicates. Raises `InputError` where the file or its hash has changed, or secrets are missing although they were
    drawn.
    """
    path = folder / SECRETS
    known = folder / SECRETS_HASH
    written = known.read_bytes() if known.exists() else None
    if written is not None and not HASH.fullmatch(written):
        raise _lost(known, "is damaged")
    if written is not None and path.exists() and written != sha256(path).encode():
        raise _lost(path, f"is damaged, or {SECRETS_HASH} beside it")
    try:
        kept = load_file(path) if path.exists() else {}
    except SafetensorError:
        raise _lost(path, "is damaged") from None
    if (begun or written is not None) and not kept.keys() >= {*names}:
        raise _lost(path, "is missing or not complete")
    return {name: np.asarray(array, np.uint8) for name, array in kept.items()}


def _lost(path: Path, why: str) -> InputError:
    return InputError(f"{path} {why}: a round that is repeated would have other noise; remove the folder to begin anew")


def write_secrets(folder: Path, secrets: Mapping[str, Secret]) -> None:
    """Write the secrets of a federation, by name, to a file that only its owner may read; then the file's hash.

    Where there is a hash, both were written before, and stay as they are: `read_secrets` has compared them. Raises
    `InputError` where another process has written other secrets since.
    """
    if (folder / SECRETS_HASH).exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    file, name = tempfile.mkstemp(prefix=PART, dir=folder)  # with permissions 0600
    os.close(file)
    try:
        write_in_pieces(Path(name), save(dict(secrets)))
        flush_all([Path(name)])
        with contextlib.suppress(FileExistsError):
            os.link(name, folder / SECRETS)  # where a rename would replace the file of another process
    finally:
        Path(name).unlink()
    flush_all([folder])
    kept = load_file(folder / SECRETS)
    if kept.keys() != secrets.keys() or not all(np.array_equal(kept[party], secrets[party]) for party in kept):
        raise InputError(f"{folder / SECRETS}: of another process, which federates here at the same time")
    write_bytes(folder / SECRETS_HASH, sha256(folder / SECRETS).encode())


def remove_secrets(folder: Path, *, used: bool = False) -> None:
    """Remove the secrets of a federation that has ended, or was refused.

    `used`: they have hidden updates of a federation that is not at its end. Their hash then stays: without the file it
    means that they are lost, so that no round is repeated with other secrets.
    """
    if not used:
        (folder / SECRETS_HASH).unlink(missing_ok=True)
    for path in (folder / SECRETS, *folder.glob(f"{PART}*")):  # the latter are left by killed processes
        path.unlink(missing_ok=True)

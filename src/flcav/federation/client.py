"""The Flower client app of both federated stages: vehicles of an edge server, and edge servers of the cloud."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from flwr.app import Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp

from flcav.config import InputError
from flcav.federation import wire
from flcav.federation.acceptance import Expected, extra_forms, is_usable
from flcav.federation.conduct import (
    ANSWERED,
    RequestDigests,
    RequestRefused,
    asked_for,
    keep_answered,
    recall_answered,
)
from flcav.federation.privacy import Secret, change_norm, derive_key
from flcav.federation.rules import RegionalModels, Rules, SecureAggregation
from flcav.federation.secure.messages import answer_secretly, complain, mask_update
from flcav.federation.secure.parties import Identity
from flcav.federation.secure.primitives import to_integers
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import Corrects, Exchanges, Strategy
from flcav.federation.trainable import (
    Accounts,
    Arrays,
    Correction,
    LocalUpdate,
    Trainable,
    Update,
    Weights,
    answer_question,
    count_samples,
    learned_names,
)
from flcav.federation.upload import decode_model, find_change
from flcav.network.ledger import BudgetExceeded
from flcav.statistics.streams import derive_seed

PARTITION = "partition-id"  # key of Flower's simulation in a node's config: index of its client
OWN, RESIDUAL = "own", "residual"  # records of a node's state between rounds: of the strategy, of compression
OWN_DIGESTS = (
    "own-digests"  # record in place of an `OWN` that stays with the client: its last two digests, latest first
)
OPTIMISER = "optimiser"  # record of a node's state: that of the client's optimiser
KEPT, KEPT_START = "kept", "kept-start"  # an update whose norm was reported, until it is asked for
HIDDEN = "hidden"  # an update that was masked, until the sum of its round is unmasked


@dataclass(frozen=True)
class ClientAgreement:
    """The terms that server and clients of a federation agree on before it begins."""

    strategy: Strategy
    rules: Rules
    secrets: Mapping[str, Secret]  # of local noise, by client
    spent: int  # rounds of earlier federations that count against a client's privacy budget


def kept_records(strategy: Strategy, rules: Rules) -> tuple[str, ...]:
    """Return the keys of a node's state that belong in a checkpoint.

    They are those of strategy and compression, the optimiser's where it is kept, and under local noise or masks the
    last answered request.
    """
    upload = rules.upload
    keeps = isinstance(strategy, Exchanges | FedMD) or upload.compression == "top-k" or upload.feeds_back
    guards = wire.is_local(rules) or rules.secure is not None
    digests = (OWN_DIGESTS,) if isinstance(strategy, FedMD) else ()
    optimiser = (OPTIMISER,) if rules.keep_optimiser else ()
    return (*((OWN, RESIDUAL) if keeps else ()), *digests, *optimiser, *((ANSWERED,) if guards else ()))


def client_app(
    trainables: Mapping[str, Trainable],
    strategy: Strategy,
    rules: Rules,
    secrets: Mapping[str, Secret] = {},
    spent: int = 0,
    identity: Identity | None = None,
    simulated: bool = False,
) -> ClientApp:
    """Return the Flower client app of `trainables` (by client name).

    A node trains the client with the index `PARTITION` in its config, with a seed derived from the round's seed and the
    client's name. `secrets` of local noise, by client, are used unless noise is seeded, and are never sent. `conduct`
    defines which requests a client answers; `spent` is the number of rounds of earlier federations that count against
    its privacy budget. Under secure aggregation a client with an `identity` only takes part with certified peers.

    A query returns the client's index and what it keeps between rounds; networks of FedMD's clients stay with them, and
    only their digests are returned. Clients that are `simulated` share one checkpoint: a query then returns everything,
    and a client without state takes over the state in the message. Questions (`ASK`) are for clients that are
    `Answers`.

    Residuals of error feedback and a strategy's client state are updated only where the server receives the update and
    can use it. The networks of FedMD's clients, and optimisers that are kept, have learned whether it does or not.
    """
    side = _ClientSide(
        trainables, strategy, rules, secrets, spent, identity, simulated, [*trainables], RequestDigests(rules.privacy)
    )
    app = ClientApp()
    app.train()(side.train)
    app.query(wire.ASK)(side.answer)
    app.query()(side.query)
    return app


@dataclass(frozen=True)
class _ClientSide:
    """The clients' side of a federation: the handlers of the client app."""

    trainables: Mapping[str, Trainable]
    strategy: Strategy
    rules: Rules
    secrets: Mapping[str, Secret]
    spent: int
    identity: Identity | None
    simulated: bool
    names: Sequence[str]  # of the trainables, by index
    requests: RequestDigests

    def _admit(self, message: Message, context: Context, name: str, work: wire.LocalWork) -> str:
        """Return the kind of the request; raises `RequestRefused` where the client must not answer it."""
        asked = asked_for(message.content)
        before = recall_answered(context)
        repeatable = self.rules.secure is None and not {OWN, RESIDUAL, OPTIMISER} & {*context.state}
        digest = self.requests.digest(message.content, wire.LOST if self.rules.secure is None else wire.ASK)
        answered = before.admit(work.round, asked, digest, self.rules, repeatable)
        if (most := self.requests.affordable) is not None and answered.rounds > most - self.spent:
            raise RequestRefused(f"a round more than the {most} that the privacy budget of {name} affords")
        # stored before any answer leaves, so that a crash cannot make the client answer twice
        keep_answered(context, answered)
        if HIDDEN in context.state and (asked == wire.UNMASK or answered.round > before.round):
            del context.state[HIDDEN], context.state[f"{HIDDEN}-{wire.SAMPLES}"]
        return asked

    def train(self, message: Message, context: Context) -> Message:
        """Return the reply to a request of a round."""
        try:
            return self._answer_training(message, context)
        except wire.NoCount as error:
            return wire.refuse_request(message, str(error))

    def _answer_training(self, message: Message, context: Context) -> Message:
        name = self._name(context)
        work = wire.LocalWork.from_record(message.content.config_records[wire.CONFIG])
        asked = self._admit(message, context, name, work)
        if self.rules.secure is not None and asked != wire.MASKED:
            return answer_secretly(message, context, name, self.rules.secure, work.round, self.identity)
        seed, key = self._seeds(name, work)
        if asked == wire.COUNT:
            return wire.reply_norm(message, 0.0, count_samples(self.trainables[name], work.steps))
        if self.rules.secure is not None:
            return self._answer_masked(message, context, name, work, self.rules.secure)
        extra = {}
        own = {}
        sent = _optional(message.content, wire.EXTRA)
        if asked == wire.SEND:
            start, update = _recorded(context, KEPT_START), _recall(context, KEPT)
        else:
            start = decode_model(wire.read_arrays(message.content, wire.ARRAYS))
            update, extra, own = self._train(self.trainables[name], message, context, start, work, seed)
        if asked == wire.NORM:
            context.state[KEPT_START] = wire.to_array_record(start)
            _keep(context, KEPT, update)
            names = [each for each in learned_names(start) if each in self.rules.upload.exchanged(start)]
            return wire.reply_norm(message, change_norm(find_change(update.weights, start, names)), update.samples)
        encoded, left = wire.encode_update(update, start, self.rules, _recorded(context, RESIDUAL), seed, key)
        if self.rules.hides_draws:  # neither the ledger's bytes nor the server's figures may reveal who was drawn
            encoded = replace(encoded, samples=min(encoded.samples, 1), loss=0.0)
        answer = wire.reply(message, encoded, extra)
        if (left or own) and wire.LOST not in message.content:
            expected = Expected(self.rules, start, extra_forms(self.strategy, self.rules, start, sent))
            if is_usable(answer.content, expected):
                _record(context, RESIDUAL, left)
                _record(context, OWN, own)
        return answer

    def _answer_masked(
        self, message: Message, context: Context, name: str, work: wire.LocalWork, secure: SecureAggregation
    ) -> Message:
        """Return the masked update, or a complaint where others' shares do not open.

        The update is trained once, and kept until its sum is unmasked. If a restarted round masked another update, the
        server could subtract the two.
        """
        if (complaint := complain(message, context)) is not None:
            return complaint
        if HIDDEN not in context.state:
            start = decode_model(wire.read_arrays(message.content, wire.ARRAYS))
            seed, key = self._seeds(name, work)
            update, _, _ = self._train(self.trainables[name], message, context, start, work, seed)
            about = (1, 0.0) if wire.is_local(self.rules) else (update.samples, update.loss)
            values = wire.flatten_change(update, start, self.rules, seed, key)
            _keep(context, HIDDEN, LocalUpdate({wire.VECTOR: values}, *about))
        hidden = _recall(context, HIDDEN)
        peers = message.content.config_records[wire.ASK][wire.NAMES]
        values = np.asarray(hidden.weights[wire.VECTOR], np.float64)
        integers = to_integers(values, secure.largest, len(peers) + 1)  # type: ignore[arg-type]
        return wire.reply(message, replace(hidden, weights={wire.VECTOR: mask_update(context, integers)}), {})

    def _name(self, context: Context) -> str:
        """Return the name of a node's client."""
        return self.names[int(context.node_config[PARTITION])]

    def _seeds(self, name: str, work: wire.LocalWork) -> tuple[int, bytes | None]:
        """Return the seed of a client's training, and the key of its noise where that has a secret."""
        secret = self.secrets.get(name)
        key = None if secret is None else derive_key(secret, "noise", work.round, work.seed)
        return derive_seed(work.seed, name), key

    def answer(self, message: Message, context: Context) -> Message:
        """Return the client's answer to a question."""
        arrays = _optional(message.content, wire.ARRAYS)
        found = answer_question(self.trainables[self._name(context)], asked_for(message.content), arrays)
        return Message(RecordDict({wire.ARRAYS: wire.to_array_record(found)}), reply_to=message)

    def query(self, message: Message, context: Context) -> Message:
        """Return a client's index, and what it keeps between rounds."""
        kept = (OWN, RESIDUAL, OPTIMISER, ANSWERED)
        if message.content and (not self.simulated or context.state or not {*message.content} <= {*kept}):
            raise RequestRefused("a client's state is its own once it has any")
        for key in message.content:
            context.state[key] = message.content[key]
        found = {key: context.state[key] for key in kept if key in context.state}
        if OWN in found and isinstance(self.strategy, FedMD) and not self.simulated:
            now = np.frombuffer(self.requests.digest(RecordDict({OWN: found.pop(OWN)})), np.uint8)
            before = [each for each in _recorded(context, OWN_DIGESTS).values() if not np.array_equal(each, now)]
            context.state[OWN_DIGESTS] = wire.to_array_record(
                dict(zip(("last", "before"), (now, *before), strict=False))
            )
            found[OWN_DIGESTS] = context.state[OWN_DIGESTS]
        place = MetricRecord({PARTITION: int(context.node_config[PARTITION])})
        return Message(RecordDict({**found, wire.METRICS: place}), reply_to=message)

    def _train(
        self, trainable: Trainable, message: Message, context: Context, start: Weights, work: wire.LocalWork, seed: int
    ) -> tuple[Update, Weights, Weights]:
        """Return the result of local training, the strategy's further arrays, and its client state if these arrive."""
        sent, own = _optional(message.content, wire.EXTRA), _recorded(context, OWN)
        correction = self.strategy.correct(sent, own) if isinstance(self.strategy, Corrects) else Correction()
        if isinstance(self.rules.personal, RegionalModels) and wire.CENTRE in message.content:
            correction = Correction(self.rules.personal.pull, centre=wire.read_arrays(message.content, wire.CENTRE))
        layers = {"layers": self.rules.upload.layers} if self.rules.upload.layers else {}
        how = {**correction.arguments(), **layers}
        if isinstance(self.strategy, FedMD):
            if not own and OWN_DIGESTS in context.state:
                raise InputError("its network of the last round is in the folder of a vehicle")
            how |= {"own": own, "imitation_steps": self.strategy.steps}
        if self.rules.keep_optimiser:
            how |= {"optimiser": _recorded(context, OPTIMISER)}
        try:
            update = trainable.train(start, steps=work.steps, learning_rate=work.learning_rate, seed=seed, **how)
        except BudgetExceeded as error:
            if isinstance(trainable, Accounts):
                raise
            # `BudgetExceeded` would end the federation, which only the budget of a link may do.
            raise RuntimeError(f"no budget is its own: {error}") from None
        if self.rules.keep_optimiser:
            if not (state := getattr(update, "optimiser", {})):
                raise TypeError("keep_optimiser: its update has no 'optimiser' to keep")
            _record(context, OPTIMISER, state)
        if isinstance(self.strategy, FedMD):
            _record(context, OWN, getattr(update, "own", {}))
        if not isinstance(self.strategy, Exchanges):
            return update, {}, {}
        exchanged = self.rules.upload.exchanged(start)
        gradients: Weights = getattr(update, "gradient", {})  # uncorrected, by the training with a shift
        gradient = {name: array for name, array in gradients.items() if name in exchanged}
        found = LocalUpdate(update.weights, update.samples, update.loss, gradient)
        return update, *self.strategy.report(found, sent, own)


def _recorded(context: Context, key: str) -> Arrays:
    return _optional(context.state, key)


def _optional(content: RecordDict, key: str) -> Arrays:
    return wire.read_arrays(content, key) if key in content else {}


def _record(context: Context, key: str, arrays: Weights) -> None:
    """Keep arrays for the next round, unless training diverged."""
    if arrays and all(np.isfinite(array).all() for array in arrays.values()):
        context.state[key] = wire.to_array_record(arrays)


def _keep(context: Context, key: str, update: Update) -> None:
    context.state[key], context.state[f"{key}-{wire.SAMPLES}"] = (
        wire.to_array_record(update.weights),
        wire.to_metrics(update),
    )


def _recall(context: Context, key: str) -> LocalUpdate:
    metrics = context.state.metric_records[f"{key}-{wire.SAMPLES}"]
    samples, loss = metrics[wire.SAMPLES], metrics[wire.LOSS]
    return LocalUpdate(_recorded(context, key), int(samples), float(loss))  # type: ignore[arg-type]

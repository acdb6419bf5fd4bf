"""The Flower client app of both federated stages: vehicles with their edge server, edge servers with the cloud."""

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from flwr.app import Context, Message
from flwr.clientapp import ClientApp

from flcav.config import InputError
from flcav.federation.records import ARRAYS, CONFIG, EXTRA, LocalWork, reply, to_arrays, to_weights
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.strategy import Corrects, Exchanges, Strategy
from flcav.federation.trainable import Correction, LocalUpdate, Trainable
from flcav.seeds import derive_seed

CLIENT = "client"  # node config key: the client's registered name
OWN = "own"  # record of a node's state: what the strategy's client keeps


def client_app(trainables: Mapping[str, Trainable], strategy: Strategy = FEDAVG) -> ClientApp:
    """Return a Flower client app that trains the one of `trainables` (by client name) that its node stands for.

    A node's name is the entry `CLIENT` of its node config. Its seed is derived from the round's seed and its name.
    """
    app = ClientApp()

    @app.train()
    def train(message: Message, context: Context) -> Message:
        name = str(context.node_config[CLIENT])
        work = LocalWork.from_record(message.content.config_records[CONFIG])
        arrays, kept = message.content.array_records, context.state.array_records
        sent = to_weights(arrays[EXTRA]) if EXTRA in arrays else {}
        own = to_weights(kept[OWN]) if OWN in kept else {}
        correction = strategy.correct(sent, own) if isinstance(strategy, Corrects) else Correction()
        update = trainables[name].train(
            to_weights(arrays[ARRAYS]),
            steps=work.steps,
            learning_rate=work.learning_rate,
            seed=derive_seed(work.seed, name),
            **correction.arguments(),
        )
        extra = {}
        if isinstance(strategy, Exchanges):
            gradient = getattr(update, "gradient", {})  # asked for by the correction
            trained = LocalUpdate(update.weights, update.samples, update.loss, gradient)
            extra, own = strategy.report(trained, sent, own)
            if all(np.isfinite(array).all() for array in own.values()):  # a round that diverged leaves nothing behind
                context.state[OWN] = to_arrays(own)
        return reply(message, update, extra)

    return app


def check_arguments(trainables: Mapping[str, Trainable], wanted: Mapping[str, Any], why: str) -> None:
    """Raise `InputError` where a client's `train` does not take the arguments `wanted`; `why` begins the sentence."""
    for name, trainable in trainables.items():
        known = inspect.signature(trainable.train).parameters
        if any(each.kind is inspect.Parameter.VAR_KEYWORD for each in known.values()):
            continue
        if lacking := [argument for argument in wanted if argument not in known]:
            raise InputError(
                f"{why} needs clients whose training takes '{lacking[0]}', and that of {name} "
                f"({type(trainable).__name__}) does not"
            )

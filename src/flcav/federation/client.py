"""The Flower client app of both federated stages: vehicles with their edge server, edge servers with the cloud."""

from collections.abc import Mapping

from flwr.app import Context, Message
from flwr.clientapp import ClientApp

from flcav.federation.records import ARRAYS, CONFIG, LocalWork, reply, to_weights
from flcav.federation.trainable import Trainable
from flcav.seeds import derive_seed

CLIENT = "client"  # node config key: the client's registered name


def client_app(trainables: Mapping[str, Trainable]) -> ClientApp:
    """Return a Flower client app that trains the one of `trainables` (by client name) that its node stands for.

    A node's name is the entry `CLIENT` of its node config. Its seed is derived from the round's seed and its name.
    """
    app = ClientApp()

    @app.train()
    def train(message: Message, context: Context) -> Message:
        name = str(context.node_config[CLIENT])
        work = LocalWork.from_record(message.content.config_records[CONFIG])
        update = trainables[name].train(
            to_weights(message.content.array_records[ARRAYS]),
            steps=work.steps,
            learning_rate=work.learning_rate,
            seed=derive_seed(work.seed, name),
        )
        return reply(message, update)

    return app

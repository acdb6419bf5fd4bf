"""The one client app of every federation: a vehicle's, and an edge server's towards the cloud."""

from collections.abc import Mapping

from flwr.app import Context, Message
from flwr.clientapp import ClientApp

from flcav.federation.records import ARRAYS, CONFIG, LocalWork, reply, to_weights
from flcav.federation.trainable import Trainable
from flcav.seeds import child_seed

CLIENT = "client"  # node config key: the client's registered name


def client_app(trainables: Mapping[str, Trainable]) -> ClientApp:
    """Return a Flower app that trains whichever of `trainables` its node is registered as."""
    app = ClientApp()

    @app.train()
    def train(message: Message, context: Context) -> Message:
        name = str(context.node_config[CLIENT])
        work = LocalWork.from_record(message.content.config_records[CONFIG])
        update = trainables[name].train(
            to_weights(message.content.array_records[ARRAYS]),
            steps=work.steps,
            learning_rate=work.learning_rate,
            seed=child_seed(work.seed, name),
        )
        return reply(message, update)

    return app

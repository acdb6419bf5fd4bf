"""Flower 1.41: its own FedAvg on its Ray simulation, a node for each place in the cohort."""

import os
import sys
import time

os.environ |= {"FLWR_TELEMETRY_ENABLED": "0", "FLWR_DISABLE_UPDATE_CHECK": "1", "RAY_USAGE_STATS_ENABLED": "0"}

import torch
from flwr.app import ArrayRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from flwr.serverapp import Grid, ServerApp
from flwr.serverapp.strategy import FedAvg
from flwr.simulation import run_simulation
from work import COHORT, POINTS, Turns, build, choose_users, train

client, server = ClientApp(), ServerApp()


@client.train()
def train_user(message: Message, context: Context) -> Message:
    torch.set_num_threads(1)
    network = build()
    network.load_state_dict(message.content["arrays"].to_torch_state_dict())
    users = choose_users(message.content["config"]["server-round"])
    train(network, users[context.node_config["partition-id"]])
    arrays, metrics = ArrayRecord(network.state_dict()), MetricRecord({"num-examples": POINTS})
    return Message(RecordDict({"arrays": arrays, "metrics": metrics}), reply_to=message)


class Waiting(FedAvg):
    """Federated averaging whose rounds wait for their turn."""

    def __init__(self, turns: Turns) -> None:
        super().__init__(fraction_evaluate=0.0, min_available_nodes=COHORT)
        self._turns = turns

    def configure_train(self, server_round, arrays, config, grid):
        """Wait before the first round."""
        if server_round == 1:
            self._turns.wait([array.numpy() for array in arrays.values()])
        return super().configure_train(server_round, arrays, config, grid)

    def aggregate_train(self, server_round, replies):
        """Wait after each round."""
        arrays, metrics = super().aggregate_train(server_round, replies)
        self._turns.wait([array.numpy() for array in arrays.values()])
        return arrays, metrics


def main(rounds: int, processes: int) -> None:
    turns = Turns()

    @server.main()
    def serve(grid: Grid, context: Context) -> None:
        while len([*grid.get_node_ids()]) < COHORT:
            time.sleep(0.1)
        Waiting(turns).start(grid, ArrayRecord(build().state_dict()), rounds)

    resources = {"client_resources": {"num_cpus": 1, "num_gpus": 0.0}, "init_args": {"num_cpus": processes}}
    run_simulation(server, client, COHORT, backend_config=resources)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))

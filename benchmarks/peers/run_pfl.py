"""pfl 0.6: its simulated backend with federated averaging, in one process or several (as `torchrun` starts them)."""

import os
import subprocess
import sys

PORT = "29517"


def join(rank: int, processes: int) -> None:
    """Set what `torchrun` sets; the first process starts the others. pfl reads it when it is imported."""
    own = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": processes, "LOCAL_WORLD_SIZE": processes}
    address = {"TORCHELASTIC_RUN_ID": "peers", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": PORT}
    os.environ |= {name: str(value) for name, value in own.items()} | address
    for other in range(1, processes) if rank == 0 else ():
        subprocess.Popen([sys.executable, __file__, *sys.argv[1:3], str(other)], stdin=subprocess.DEVNULL)


def main(rounds: int, processes: int, rank: int) -> None:
    if processes > 1:
        join(rank, processes)
    import numpy as np
    import torch
    from pfl.aggregate.simulate import SimulatedBackend
    from pfl.algorithm.base import NNAlgorithmParams
    from pfl.algorithm.federated_averaging import FederatedAveraging
    from pfl.callback.base import TrainingProcessCallback
    from pfl.data.federated_dataset import FederatedDataset
    from pfl.data.pytorch import PyTorchTensorDataset
    from pfl.hyperparam import NNTrainHyperParams
    from pfl.metrics import Metrics, Weighted
    from pfl.model.pytorch import PyTorchModel
    from torch import nn
    from torch.nn import functional
    from work import BATCH, COHORT, RATE, USERS, Turns, build, draw_points

    class Network(nn.Module):
        """The network as pfl wants it."""

        def __init__(self) -> None:
            super().__init__()
            self.layers = build()

        def loss(self, pictures, classes, eval=False):
            return functional.cross_entropy(self.layers(pictures), classes)

        def metrics(self, pictures, classes, eval=False):
            return {"loss": Weighted(self.loss(pictures, classes).item() * len(classes), len(classes))}

    class Wait(TrainingProcessCallback):
        """Every round waits for its turn; the other processes wait for the first."""

        def on_train_begin(self, *, model):
            self._wait(model)
            return Metrics()

        def after_central_iteration(self, aggregate_metrics, model, *, central_iteration):
            self._wait(model)
            return False, Metrics()

        def _wait(self, model) -> None:
            if rank == 0:
                turns.wait([parameter.detach().numpy() for parameter in model.pytorch_model.parameters()])
            if processes > 1:
                torch.distributed.barrier()

    turns, network = Turns(), Network()
    np.random.seed(0)  # noqa: NPY002 (pfl draws from the global generator)
    central = torch.optim.SGD(network.parameters(), 1.0)
    model = PyTorchModel(network, torch.optim.SGD, central)
    users = iter(user % USERS for user in range(10**9))
    data = FederatedDataset(lambda user: PyTorchTensorDataset([*draw_points(user)]), lambda: next(users))
    FederatedAveraging().run(
        NNAlgorithmParams(rounds, 10**6, COHORT, 0),
        SimulatedBackend(data, data),
        model,
        NNTrainHyperParams(BATCH, 1, RATE),
        callbacks=[Wait()],
    )


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 0)

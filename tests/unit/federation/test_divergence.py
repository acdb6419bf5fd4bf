"""Weight divergence of the regions: against norms written out, and in the records of cloud rounds."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from federations import cloud_federation, federate_cloud
from line_task import LineTask, Slope

from flcav.federation.rules import Rules
from flcav.federation.state import measure_divergence
from flcav.federation.strategies import FEDAVG
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.task import Task
from flcav.perception.weights import to_arrays
from flcav.runs.recipe import CLOUD, Training
from flcav.runs.stages.rounds import RegionStart
from flcav.runs.training.checkpoints import LAST, Checkpoint, FederationCheckpoints
from flcav.runs.training.learning import Learning, Strategies, make_clients


def test_divergence_is_the_mean_relative_distance_from_the_mean() -> None:
    grid = {
        "w": np.array([[3.0, 0.0]], np.float32),
        "n.running_mean": np.array([1.0]),
        "n.running_var": np.array([2.0]),
        "n.num_batches_tracked": np.array(7),
    }
    ring = {
        "w": np.array([[1.0, 0.0]], np.float32),
        "n.running_mean": np.array([5.0]),
        "n.running_var": np.array([2.0]),
        "n.num_batches_tracked": np.array(900),
    }
    found = measure_divergence([grid, ring])  # means: w (2, 0), running mean 3, running variance 2
    assert found.learned == pytest.approx(1 / 2)
    assert found.statistics == pytest.approx(2 / np.sqrt(9 + 4))
    assert found.whole == pytest.approx(np.sqrt(1 + 4) / np.sqrt(4 + 9 + 4))
    third = grid | {"w": np.array([[2.0, 3.0]], np.float32)}  # of three: mean (2, 1), distances sqrt 2, sqrt 2, 2
    distances = np.sqrt(2), np.sqrt(2), 2.0
    assert measure_divergence([grid, ring, third]).learned == pytest.approx(np.mean(distances) / np.sqrt(5))
    same = measure_divergence([grid, grid])
    assert (same.whole, same.learned, same.statistics) == (0, 0, 0)
    assert measure_divergence([{"w": np.ones(2)}, {"w": -np.ones(2)}]).statistics is None  # and the mean is 0
    assert measure_divergence([{"w": np.ones(2)}, {"w": -np.ones(2)}]).learned == pytest.approx(np.sqrt(2))


def test_a_cloud_round_records_how_far_regions_were_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2, average_rounds=1), 3)
    network, starts = learning.build_network(), {}
    for region, x in (("a", 1.0), ("b", -4.0)):
        clients = make_clients(learning, Slope(), {f"{region}/cav0": [np.float32(x), np.float32(2 * x)]})
        weights = {name: array + np.float32(x) for name, array in to_arrays(network).items()}
        starts[region] = RegionStart(clients, weights, earlier=0)

    def run(folder: Path) -> Any:
        folder.mkdir(exist_ok=True)
        where = (Strategies(FEDAVG, FEDAVG), Ledger(LinkMegabytes(1.0, 1.0)), folder, ignore_progress)
        federate_cloud(cloud_federation(learning, network, starts, dict.fromkeys(starts, 1), *where), 2, Rules())
        return Checkpoint.read(folder, LAST).records[CLOUD]

    first, second = run(tmp_path / "whole")
    assert first.divergence is not None
    rows = np.array([np.concatenate([np.ravel(array) for array in own.weights.values()]) for own in starts.values()])
    apart, mean = np.linalg.norm(rows[0] - rows[1]) / 2, np.linalg.norm(rows.mean(axis=0))
    assert first.divergence.begun.whole == pytest.approx(apart / mean, rel=1e-5)
    assert first.divergence.trained.whole > 0
    assert second.divergence.begun.whole == 0  # both begin with the cloud's
    assert second.divergence.trained.whole > 0
    save, stopped = FederationCheckpoints.save, 0

    def save_once(checkpoints: FederationCheckpoints, round_: int, weights: Any, loss: float | None) -> None:
        nonlocal stopped
        save(checkpoints, round_, weights, loss)
        stopped += 1
        if stopped == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(FederationCheckpoints, "save", save_once)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "resumed")
    assert run(tmp_path / "resumed") == (first, second)

"""A radar and a camera beside the LiDAR in recorded frames, of vehicles of which one has neither."""

from pathlib import Path

import numpy as np
import pytest

from flcav.cli.main import run
from flcav.config import InputError, parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import TaskClient
from flcav.perception.objects.config import CONFIGURATIONS, ECHO
from flcav.perception.objects.samples import unpack_sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network
from flcav.perception.weights import to_arrays
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

pytestmark = pytest.mark.slow
FEW = {"town": "suburb", "seed": 5, "cavs": 2, "spins_per_scene": 2, "warmup_s": 20.0}
CAR = {
    "lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 16, "azimuth_steps": 450}}},
    "cameras": {"camera": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 208, "height": 96, "fov_deg": 70.0}}},
    "radars": {"radar": {"mount": {"x": 2.3, "z": 0.5}}},
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("both") / "data"
    recipe = parse_config(Recipe, {**FEW, "vehicle_rig": CAR, "rigs": {"cav1": "lidar32"}}, "both")
    record(EmbeddedSource(recipe), folder)
    return Dataset.open(folder)


def test_a_vehicle_has_the_rig_of_its_own(data: Dataset) -> None:
    assert [(data.keys[i].agent, data.radars(i), data.cameras(i)) for i in range(2)] == [
        ("cav0", ["radar"], ["camera"]),
        ("cav1", [], []),
    ]


@pytest.mark.parametrize("network", ["pillars_radar", "pillars_painted"])
def test_vehicles_with_and_without_the_sensor_federate_side_by_side(data: Dataset, network: str) -> None:
    config = CONFIGURATIONS[network]
    samples = {agent: OBJECTS.samples(data, config, data.select(agents=[agent])) for agent in ("cav0", "cav1")}
    clouds = {agent: each[0].points for agent, each in samples.items()}
    assert {cloud.shape[1] for cloud in clouds.values()} == {config.columns}
    assert (clouds["cav1"][:, 4:] == 0).all()
    if network == "pillars_radar":
        echoes = clouds["cav0"][clouds["cav0"][:, 3] == ECHO]
        assert len(echoes) > 20
        assert np.median(np.abs(echoes[:, 4])) < 1.0  # most echoes are of what stands
    else:
        painted = (clouds["cav0"][:, 4:] > 0).any(1)
        assert 0.05 < painted.mean() < 0.9
    clients = {agent: TaskClient(OBJECTS, config, each, batch=2) for agent, each in samples.items()}
    weights = to_arrays(build_network(OBJECTS, config, 1))
    ledger = Ledger(LinkMegabytes(wireless_mb=100.0, wireline_mb=0.0))
    schedule = Schedule(rounds=1, steps=1, learning_rate=1e-3, final_learning_rate=1e-3, seed=1)
    result = federate(clients, weights, schedule, Account(ledger, "edge", "objects", "wireless"))
    assert any(not np.array_equal(result.weights[name], weights[name]) for name in weights)
    assert len({entry.client for entry in ledger.entries if entry.direction == "up"}) == 2
    evaluation = OBJECTS.evaluate(build_network(OBJECTS, config, 1), data)
    assert type(evaluation).from_json(evaluation.as_json(), "test") == evaluation
    assert evaluation.frames == 4


def test_messages_of_recorded_frames_are_their_samples(data: Dataset) -> None:
    config = CONFIGURATIONS["pillars_radar"]
    plain, more = (
        [*OBJECTS.pack_samples(data, CONFIGURATIONS[name], range(2))] for name in ("pillars_far", "pillars_radar")
    )
    assert len(more[0]) - len(plain[0]) >= 20 * len(data.frame(0).radar["radar"])
    assert abs(len(more[1]) - len(plain[1])) < 1000  # no echoes, but perhaps other boxes
    made, known = unpack_sample(more[0], config), OBJECTS.samples(data, config)[0]
    np.testing.assert_allclose(made.points, known.points, atol=1e-5)


def test_a_folder_without_the_second_modality_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = tmp_path / "bare"
    record(EmbeddedSource(parse_config(Recipe, {**FEW, "cavs": 1, "spins_per_scene": 1}, "bare")), folder)
    out = tmp_path / "out"
    for network, sensor in (("pillars_radar", "radar"), ("pillars_painted", "camera")):
        with pytest.raises(SystemExit) as stopped:
            run(["train", "objects", "--data", str(folder), "--network", network, "--out", str(out)])
        assert stopped.value.code == 2
        shown = capsys.readouterr().err
        assert f"no {sensor} in its frames, which the network reads beside the LiDAR" in shown
        assert "Traceback" not in shown
    with pytest.raises(InputError, match="no radar"):
        OBJECTS.evaluate(build_network(OBJECTS, CONFIGURATIONS["pillars_radar"], 0), Dataset.open(folder))

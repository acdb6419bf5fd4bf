"""The recipe of rounds that do not wait, small: buffers in both stages, topics, groups on request."""

from pathlib import Path
from typing import Any

import pytest

from flcav.network.clock.records import load_rounds
from flcav.network.ledger import Ledger
from flcav.runs.edge_stage import federate_regions
from flcav.runs.recipe import CLOUD, EDGE, MAIN, RunRecipe, Training, load_run_recipe
from flcav.runs.results.run import Run
from flcav.runs.running import run

pytestmark = pytest.mark.slow

RECIPE = Path(__file__).parents[2] / "recipes/runs/buffered.yaml"


@pytest.fixture(scope="module")
def buffered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunRecipe, Run]:
    pytest.importorskip("cyclonedds")
    asked: dict[str, Any] = load_run_recipe(RECIPE).model_dump()
    few = {"scenes": 1, "spins": 4, "cavs": 3}
    splits = dict.fromkeys(("pool", "validation", "registry", "edge"), few)
    asked["splits"] = {**splits, "test": {"scenes": 2, "spins": 1, "cavs": 1}}
    asked["training"] = Training(steps=2, local_steps=1)
    asked["tasks"]["weather"]["plan"] = {"samples": 4, "edge_rounds": 2, "cloud_rounds": 2}
    how = asked["federation"]
    asked["arms"]["asking"] = {
        "federation": {"strategy": "fedavg", "requests": {"excess": 0.001, "range_m": 10_000, "least_quality": 0.0}},
        "stages": ["edge"],
    }
    asked["arms"]["private"] = {
        "federation": {**how, "privacy": {"where": "local", "clip": 1, "noise": 1, "seeded": True}},
        "stages": ["edge"],
    }
    asked["arms"]["topics"] = {"federation": {**how, "cloud_topics": "/flcav"}}
    recipe, out = RunRecipe.model_validate(asked), tmp_path_factory.mktemp("buffered")
    interfaces = '<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    peers = '<Discovery><Peers><Peer Address="localhost"/></Peers><ParticipantIndex>auto</ParticipantIndex></Discovery>'
    general = f"<General>{interfaces}<AllowMulticast>false</AllowMulticast></General>"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", "188")
        patch.setenv("CYCLONEDDS_URI", f"<CycloneDDS><Domain Id='any'>{general}{peers}</Domain></CycloneDDS>")
        return out, recipe, run(recipe, out)


def test_buffers_send_what_synchronous_rounds_send_in_less_time(buffered: tuple[Path, RunRecipe, Run]) -> None:
    folder, _, result = buffered
    for stage, waiting in zip(result.arms[MAIN].stages, result.arms["waiting"].stages, strict=True):
        own, other = ([each for each in at.records or () if each.server != CLOUD] for at in (stage, waiting))
        if stage.stage == EDGE:
            assert (len(own), len(other)) == (3, 2)
            assert all(len(each.clients) == 2 for each in own)
        assert sum(each.seconds or 0.0 for each in own) < sum(each.seconds or 0.0 for each in other)
    books = [
        Ledger.load(folder / f"ledgers/{arm}.parquet").used_bytes("wireless", stage=EDGE) for arm in (MAIN, "waiting")
    ]
    assert books[0] == books[1]
    timed = load_rounds(folder / "work/grid-edge-fl-weather/clock-grid.parquet")
    assert [each.round for each in timed] == [1, 2, 3]


def test_the_total_of_epsilon_is_that_of_the_vehicle_that_took_part_most(buffered: tuple[Path, RunRecipe, Run]) -> None:
    private = buffered[2].arms["private"]
    assert private.privacy is not None
    last = max(record.epsilon or 0.0 for stage in private.stages for record in stage.records or ())
    assert private.privacy.epsilon == pytest.approx(last)


def test_topics_change_neither_weights_nor_ledger(buffered: tuple[Path, RunRecipe, Run]) -> None:
    work = buffered[0] / "work"
    for name in ("weights.safetensors", "ledger.parquet"):
        plain = (work / "cloud-fl-weather" / name).read_bytes()
        assert (work / "cloud-fl-weather-topics" / name).read_bytes() == plain
    assert (work / "cloud-fl-weather-topics/bag-from-round1/metadata.yaml").is_file()


def test_a_group_that_asked_trains_and_goes_on_after_a_stop(
    buffered: tuple[Path, RunRecipe, Run], tmp_path: Path
) -> None:
    folder, recipe, result = buffered
    before = {stage.region: stage for stage in result.arms["asking"].stages}
    for stage in before.values():
        assert stage.group is not None
        assert set(stage.group.asked) == set(stage.group.members) != set()
        assert len(stage.group.losses) == stage.rounds + 1
    alone = federate_regions(recipe, folder, arm="asking", jobs=1)
    name = "grid-federate-weather-asking"
    (folder / "work" / name / "done.json").unlink()  # as after a kill between its last round and its end
    again = federate_regions(recipe, folder, arm="asking", jobs=1)
    for one, other in zip(alone.federations, again.federations, strict=True):
        assert one.result == other.result == before[one.result.region]

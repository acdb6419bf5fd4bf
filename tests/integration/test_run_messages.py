"""Messages and rounds of a run at toy scale: every byte in the ledger, noise and masks, the network's losses."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from flwr.app import Array, ArrayRecord, MetricRecord, RecordDict
from flwr.common.serde import recorddict_to_proto
from performed_steps import in_mb, perform, uplinks
from safetensors.numpy import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_run import RECIPE

from flcav.federation.privacy import account_epsilon
from flcav.federation.rules import Rules
from flcav.network.clock.records import load_rounds
from flcav.network.ledger import LINKS, Ledger
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import find_configuration
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE, MAIN, RunRecipe
from flcav.runs.results.plans import ErrorRegistry, Plan
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER
from flcav.runs.results.training import FederatedRound, StageResult

pytestmark = pytest.mark.slow


def test_every_message_is_booked_in_the_bytes_that_flower_sends(finished: Path, result: Run) -> None:
    folder = finished / "work/grid-edge-fl-objects"
    weights = load_file(folder / "round1.safetensors")
    record = ArrayRecord({name: Array(np.ascontiguousarray(value)) for name, value in weights.items()})
    metrics = MetricRecord({"num-examples": 2, "loss": 0.5})
    message = len(recorddict_to_proto(RecordDict({"arrays": record, "metrics": metrics})).SerializeToString())
    book = Ledger.load(finished / "ledgers/main.parquet")
    ups = [e.bytes for e in book.entries if (e.stage, e.direction) == ("edge", "up") and e.round]
    assert len(ups) == 2 * 3  # rounds x vehicles
    assert all(abs(size - message) <= 16 for size in ups)
    assert message / 1e6 == pytest.approx(result.arms[MAIN].plan.tasks["objects"].model_mb, rel=1e-4)
    clouds = [e for e in book.entries if (e.stage, e.direction, e.link) == ("cloud", "up", "wireline")]
    assert [e.client for e in clouds] == ["grid", "ring"]


def test_road_labels_are_booked_as_downlink(finished: Path) -> None:
    def told(step: str) -> list[int]:
        entries = Ledger.load(finished / f"work/{step}/ledger.parquet").entries
        return [e.bytes for e in entries if (e.stage, e.direction, e.round) == ("edge", "down", 0)]

    held, released = StageResult.load(finished / "work/grid-edge-fl-objects").samples, told("grid-errors-objects")
    labels = told("grid-edge-fl-objects")[len(released) :]
    assert len(labels) == held > 0
    assert min(labels) > 100
    assert told("grid-edge-fl-objects-no_pole") == released


def test_the_ledger_is_what_crossed_the_links(finished: Path, result: Run) -> None:
    book, pool = Ledger.load(finished / "ledgers/main.parquet"), Frames.open(finished / "work/suburb-pool-objects")
    uploaded, config = result.pretrained[0].uploaded["suburb"], find_configuration(OBJECTS, "tiny")
    samples = sum(map(len, OBJECTS.pack_samples(pool.data, config, uploaded))) / 1e6
    points = sum(pool.data.frame(i).lidar["lidar"].nbytes for i in uploaded) / 1e6
    assert points < samples < 1.02 * points  # a message is its points, and little else
    books = [Ledger.load(finished / f"work/{region}-errors-objects/ledger.parquet") for region in ("grid", "ring")]
    reported = sum(each.used_mb("wireless", stage="edge") for each in books)
    counted = [ErrorRegistry.load(finished / f"work/{region}-errors-objects").counts for region in ("grid", "ring")]
    assert sum(sum(each.values()) for each in counted) * 50 < reported * 1e6 < 100_000
    for each in books:  # the pretrained network went down by wireline and to each vehicle before
        down = [(e.link, e.bytes) for e in each.entries if e.direction == "down"]
        assert [link for link, _ in down] == ["wireline", "wireless", "wireless"]
        assert len({size for _, size in down}) == 1
    main, model = result.arms[MAIN], result.arms[MAIN].plan.tasks["objects"].model_mb
    for (link, stage), spent in {
        ("wireless", "pretrain"): samples,
        ("wireline", "pretrain"): samples,
        ("wireless", "edge"): 2 * 3 * model + reported,
        ("wireline", "edge"): 0.0,
        ("wireless", "cloud"): 3 * model,
        ("wireline", "cloud"): 2 * model,
    }.items():
        assert book.used_mb(link, stage=stage) == pytest.approx(spent, rel=1e-4)  # type: ignore[arg-type]
    for link in LINKS:
        use = main.links[link]
        assert use.used_mb == sum(e.bytes for e in book.entries if (e.link, e.direction) == (link, "up")) / 1e6
        assert use.used_mb == pytest.approx(use.planned_mb + reported * (link == "wireless"), rel=1e-3)
        assert use.used_mb <= use.budget_mb == getattr(RECIPE.budgets_mb, link)
        assert sum(spent.mb for spent in main.spent if spent.link == link) == pytest.approx(use.used_mb)


def test_boxes_of_the_road_average_are_priced_and_booked_in_stages_two_and_three(
    finished: Path, result: Run, tmp_path: Path
) -> None:
    uploaded = sum(map(len, result.pretrained[0].uploaded.values()))
    fixed = {"samples": uploaded, "edge_rounds": 1, "cloud_rounds": 1}
    averaged = {"objects": {"network": "tiny", "labels": "road-average", "plan": fixed}}
    regions = {name: RECIPE.regions[name] for name in ("suburb", "grid")}
    placement = RECIPE.placement.model_copy(update={"group_range_m": 1000.0})  # every frame is near a sensor
    changes = {"tasks": averaged, "regions": regions, "arms": {}, "placement": placement}
    asked = RunRecipe.model_validate(RECIPE.model_dump() | changes)
    perform(asked, finished, tmp_path, ("plan", "grid-edge-objects", "grid-edge-fl-objects", "cloud-fl-objects"))
    plan, book = Plan.load(tmp_path / "plan").tasks["objects"], Ledger.load(tmp_path / "cloud-fl-objects" / LEDGER)
    sent = uplinks(book.entries, "wireless")
    rounds = [each for each in sent if each.round]
    updates = [each for each in rounds if each.bytes > 0.9e6 * plan.model_mb]
    boxes = [each for each in rounds if each not in updates]
    held = StageResult.load(tmp_path / "grid-edge-fl-objects").samples
    assert len(updates) == 2 * 2
    told = 3 * held  # each frame, one before it and one after
    assert [(each.stage, each.round) for each in boxes] == [(EDGE, 1)] * told + [(CLOUD, 1)] * told
    assert plan.labels_mb is not None
    assert 0.5 < 2 * 2 * plan.labels_mb / in_mb(boxes) < 2
    priced = plan.samples * plan.sample_mb + 2 * 2 * (plan.model_mb + plan.labels_mb)
    assert plan.wireless_mb == pytest.approx(priced)
    assert plan.wireless_mb == pytest.approx(in_mb(sent), rel=asked.headroom)


def rounds_of(result: Run, arm: str, stage: str, server: str) -> list[FederatedRound]:
    records = [record for each in result.arms[arm].stages if each.stage == stage for record in each.records or ()]
    return [record for record in records if record.server == server]


def test_every_round_is_in_the_results_with_its_bytes_and_its_loss(finished: Path, result: Run) -> None:
    book = Ledger.load(finished / "ledgers/main.parquet")
    both = ("grid/cav0", "grid/cav1")
    edge, inner, cloud = (rounds_of(result, MAIN, *at) for at in ((EDGE, "grid"), (CLOUD, "grid"), (CLOUD, "cloud")))
    assert [(each.round, each.clients) for each in (*edge, *inner)] == [(1, both), (2, both), (1, both)]
    assert [(each.clients, each.failed) for each in cloud] == [(("grid", "ring"), {})]
    assert tuple(each.loss for each in edge) == result.arms[MAIN].stages[0].losses
    for link, stage, records in (("wireless", EDGE, edge), ("wireless", CLOUD, inner), ("wireline", CLOUD, cloud)):
        for direction in ("up", "down"):
            sent = [
                e.bytes
                for e in book.entries
                if (e.link, e.stage, e.direction) == (link, stage, direction)
                and e.round
                and e.client.startswith("grid/" if link == "wireless" else ("grid", "ring"))
            ]
            assert sum(getattr(each, f"{direction}_bytes") for each in records) == sum(sent) > 0
    table = pq.read_table(finished / "rounds.parquet").to_pylist()
    assert {row["loss"] for row in table if (row["arm"], row["stage"]) == (MAIN, EDGE)} >= {each.loss for each in edge}
    curves = EventAccumulator(str(finished / "events/main/edge/objects/grid"))
    curves.Reload()
    assert [(event.step, event.value) for event in curves.Scalars("loss")] == [
        (each.round, pytest.approx(each.loss)) for each in edge
    ]
    assert "Rounds of federated learning" in (finished / "report.html").read_text()


def test_a_cloud_round_says_how_far_regions_were_apart(finished: Path, result: Run) -> None:
    (cloud,) = (stage for stage in result.arms[MAIN].stages if stage.stage == CLOUD)
    (record,) = rounds_of(result, MAIN, CLOUD, "cloud")
    ends = [load_file(finished / f"work/{region}-edge-fl-objects/weights.safetensors") for region in ("grid", "ring")]
    names = [name for name in ends[0] if not name.endswith("num_batches_tracked")]
    grid, ring = (np.concatenate([end[name].ravel().astype(float) for name in names]) for end in ends)
    assert record.divergence is not None
    expected = np.linalg.norm(grid - ring) / np.linalg.norm(grid + ring)
    assert record.divergence.begun.whole == pytest.approx(expected)
    assert cloud.statistics is not None
    scored = {each.region: each.averaged for each in cloud.statistics}
    watched = {each.region: each.rounds[-1].score for each in result.watched if each.stage == CLOUD}
    assert scored == pytest.approx(watched)  # the same network on the same frames
    page = (finished / "report.html").read_text()
    assert "Weight divergence of the regions" in page
    assert "by the statistics of batch normalisation" in page


def test_noise_and_masks_hold_in_a_whole_run(finished: Path, result: Run) -> None:
    arms = {MAIN: "", "masked": "-masked", "densest": "-densest"}  # the last with noise
    folders = {arm: finished / f"work/grid-edge-fl-objects{suffix}" for arm, suffix in arms.items()}
    start = load_file(finished / "work/pretrain-objects/weights.safetensors")
    ends = {arm: load_file(folder / "round1.safetensors") for arm, folder in folders.items()}
    for name in [name for name in start if name.endswith("weight") and start[name].size > 1000]:
        np.testing.assert_allclose(ends["masked"][name], ends[MAIN][name], atol=1e-4)
        assert np.std(ends["densest"][name] - start[name]) == pytest.approx(1 / 2, rel=0.1)  # of the sum of two
    told = {arm: [record.epsilon for record in rounds_of(result, arm, EDGE, "grid")] for arm in arms}
    assert told[MAIN] == told["masked"] == [None, None]
    rules = Rules.model_validate({"privacy": {"clip": 1.0, "noise": 1.0}})
    assert rules.privacy is not None
    names = ["grid/cav0", "grid/cav1"]
    epsilon = [account_epsilon(rules.privacy, rules.selection, names, rounds) for rounds in (1, 2)]
    assert told["densest"] == pytest.approx(epsilon)
    book = Ledger.load(folders["masked"] / "ledger.parquet").entries
    ups = [entry.client for entry in book if (entry.round, entry.direction) == (1, "up")]
    assert [ups.count(name) for name in names] == [4, 4]  # keys, shares, update, unmasking
    kept = [name for path in folders["masked"].glob("state*.safetensors") for name in load_file(path)]
    assert kept
    assert all("answered" in name for name in kept)  # of a vehicle nothing else: that it answers each round once


def test_the_network_takes_time_and_loses_vehicles_by_name(finished: Path, result: Run) -> None:
    lost, cloud = rounds_of(result, "equal", EDGE, "grid"), rounds_of(result, "equal", CLOUD, "cloud")
    clock = load_rounds(finished / "work/grid-edge-fl-objects-equal/clock-grid.parquet")
    assert [each.seconds for each in lost] == pytest.approx([each.end_s - each.start_s for each in clock])
    for record, timed in zip(lost, clock, strict=True):
        named = {f"grid/{client.client}": client.dropped for client in timed.clients}
        assert record.failed == {name: why for name, why in named.items() if why}
        assert record.clients == tuple(name for name, why in named.items() if not why)
        assert record.seconds is not None
        assert 0 < record.seconds <= 3
    assert {path.stem for path in finished.glob("pictures/timeline*")} == {"timeline_grid_equal", "timeline_ring_equal"}
    assert (finished / "report.html").read_text().count("(equal), over time") == 2
    slowest = max(rounds_of(result, "equal", CLOUD, region)[0].seconds or 0.0 for region in ("grid", "ring"))
    assert cloud[0].seconds == pytest.approx(slowest + 2 * (0.01 + 8 * 1337440 / 1e9), rel=1e-3)
    assert all(record.seconds is None for record in rounds_of(result, MAIN, EDGE, "grid"))

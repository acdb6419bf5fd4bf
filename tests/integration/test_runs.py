"""Runs at toy scale, as a user has them: run, read, stopped, gone on with, compared; and the studies made of them."""

import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from flwr.app import Array, ArrayRecord, MetricRecord, RecordDict
from flwr.common.serde import recorddict_to_proto
from performed_steps import in_mb, perform, uplinks
from PIL import Image
from safetensors.numpy import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from flcav.cli.main import run as command
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.experiments.arms.run import ARMS, ArmsResult, compare_arms
from flcav.experiments.fig6a.results import MEAN, AllocationResult
from flcav.experiments.fig6a.run import compare_plans
from flcav.experiments.placement.records import COVERAGE, NEAR, TOWN, TRAFFIC
from flcav.experiments.placement.run import prove_placement
from flcav.experiments.run_tables import judge_anew
from flcav.federation.privacy import account_epsilon
from flcav.federation.rules import Rules
from flcav.network.clock.records import load_rounds
from flcav.network.ledger import LINKS, Ledger
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import find_configuration
from flcav.pipeline.alone import federate_regions
from flcav.pipeline.comparing import compare
from flcav.pipeline.frames import Frames
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe, load_run_recipe
from flcav.pipeline.results.plans import ErrorRegistry, Placed, Plan
from flcav.pipeline.results.run import Run, Summary
from flcav.pipeline.results.saved import LEDGER
from flcav.pipeline.results.training import FederatedRound, Pretrained, StageResult, Watched
from flcav.pipeline.running import RESULTS, run, run_seeds
from flcav.pipeline.steps.graph import Graph
from flcav.report.pages.run_page import write_report
from flcav.statistics.verdicts import ESTIMATE, UNDECIDED, verdict
from flcav.world.map.town import load_town

pytestmark = pytest.mark.slow

Studied = tuple[Path, ArmsResult, AllocationResult]
TOY = Path(__file__).parent / "toy.yaml"
RECIPE = load_run_recipe(TOY)
GO = """
import sys
from pathlib import Path
from flcav.pipeline.recipe import load_run_recipe
from flcav.pipeline.running import run
run(load_run_recipe(Path(sys.argv[1])), sys.argv[2])
"""
OWN = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Last:
    def combine(self, start, updates):
        return updates[-1].weights
"""


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Studied:
    """Return the folder of both comparisons of one seed, and their results."""
    out = tmp_path_factory.mktemp("toy") / "studies"
    runs, _ = run_seeds(RECIPE, out, seeds=1)
    return out, compare_arms(RECIPE, runs), compare_plans(RECIPE, {1.0: runs})


@pytest.fixture(scope="module")
def finished(studied: Studied) -> Path:
    """Return the folder of the run, with its report."""
    folder = studied[0] / "seed1"
    write_report(Run.load(folder, RESULTS), folder)
    return folder


@pytest.fixture(scope="module")
def result(finished: Path) -> Run:
    return Run.load(finished, RESULTS)


def without(finished: Path, out: Path, unwanted: Callable[[str], bool]) -> Path:
    """Return a copy of the run's steps in which those of some names have not begun."""
    shutil.copytree(finished / "work", out / "work", ignore=lambda _, names: [name for name in names if unwanted(name)])
    return out / "work"


def timeless(out: Path) -> dict[str, Any]:
    return json.loads((out / RESULTS).read_text()) | {"elapsed_s": 0.0}


def test_every_arm_region_and_task_has_its_measure(result: Run) -> None:
    tested = {(test.arm, test.stage, test.region) for test in result.tested}
    assert {(MAIN, stage, region) for stage in (PRETRAIN, CLOUD) for region in RECIPE.regions} <= tested
    assert {(MAIN, EDGE, "grid"), (MAIN, EDGE, "ring"), ("densest", EDGE, "grid")} <= tested
    assert {("more", CENTRAL, "grid"), ("more", CENTRAL, "ring"), ("oracle", CENTRAL, "grid")} <= tested
    assert ("equal", CLOUD, "suburb") in tested
    for test in result.tested:
        low, high = test.result.estimate.low, test.result.estimate.high
        assert low is not None
        assert high is not None
        assert 0 <= low <= test.result.estimate.mean <= high <= 1
        assert (test.result.frames, test.result.scenes) == (6, 3)
        assert "AP70" in test.result.numbers


def test_sensors_stand_where_most_errors_or_most_traffic_is(result: Run) -> None:
    (placed,) = (each for each in result.arms[MAIN].placed if each.region == "grid")
    assert [pole.pole for pole in placed.poles] == load_town("grid").poles.id.tolist()
    assert placed.covered == max(pole.covered for pole in placed.poles) <= placed.errors
    assert result.arms["densest"].placed[0].chosen == (placed.densest,)


def test_gains_of_a_pole_are_those_of_its_own_arm_over_the_run_itself(studied: Studied, result: Run) -> None:
    proof = prove_placement(RECIPE, [result], [studied[0] / "seed1" / "work"])
    (seed,), sites = proof.regions["grid"].seeds, result.arms[MAIN].placed[0].poles
    (pole,), (site,) = seed.poles, (each for each in sites if each.pole == 8)
    reached = [result.test(arm=arm, stage=EDGE, region="grid", task="objects").estimate.mean for arm in ("pole8", MAIN)]
    assert result.arms["pole8"].placed[0].chosen == (pole.pole,) == (8,)
    assert (pole.predictors[COVERAGE], pole.predictors[TRAFFIC]) == (site.covered, site.actors)
    assert seed.without[TOWN] == reached[1]
    assert pole.gain[TOWN] == pytest.approx(reached[0] - reached[1])
    assert set(pole.gain) == {TOWN, NEAR}
    assert list(proof.regions) == ["grid"]  # no arm has a single pole in `ring`


def test_place_compares_with_the_traffic_of_a_dataset_and_sees_no_errors_behind_houses(
    finished: Path, result: Run, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    town, (x, y) = load_town("grid"), np.meshgrid(*2 * [np.arange(-100, 101, 10)])
    lattice = "\n".join(f"{i},{j},1" for i, j in zip(x.ravel(), y.ravel()))
    (tmp_path / "errors.csv").write_text(f"x,y,z\n{lattice}\n")
    rows = (f"{number},{i},{j},{z}" for number, (i, j, z) in zip(town.poles.id, town.poles.position))
    (tmp_path / "poles.csv").write_text("\n".join(("id,x,y,z", *rows)))
    files = ["--errors", str(tmp_path / "errors.csv"), "--poles", str(tmp_path / "poles.csv")]
    asked = [*files, "--range", "40", "--count", "1", "--data", str(finished / "work/grid-registry-objects/data")]
    told = []
    for more in ([], ["--line-of-sight"]):
        with pytest.raises(SystemExit) as stopped:
            command(["place", *asked, *more, "--json"])
        assert not stopped.value.code
        told.append(json.loads(capsys.readouterr().out))
    whole, seen = told
    apart = np.linalg.norm(np.c_[x.ravel(), y.ravel(), np.ones(x.size)] - town.poles.position[:, None], axis=2)
    assert whole["covered"] == (apart <= 40).sum(axis=1).max()
    assert 0 < seen["covered"] < whole["covered"]
    (densest,) = result.arms["densest"].placed[0].chosen
    assert whole["baselines"]["traffic-density"]["chosen"] == [{"pole": densest, "sensor": None}]
    for each in told:
        for name in ("traffic-density", "visible-objects"):
            assert 0 < each["baselines"][name]["covered"] <= each["covered"]


def test_central_arms_take_as_many_steps_as_stage_two_on_their_own_samples(finished: Path, result: Run) -> None:
    pretrained, plan = result.pretrained[0], result.arms[MAIN].plan.tasks["objects"]
    more, oracle = (StageResult.load(finished / f"work/grid-central-objects-{arm}") for arm in ("more", "oracle"))
    edge = StageResult.load(finished / "work/grid-edge-fl-objects")
    assert more.samples == sum(map(len, pretrained.uploaded.values())) == plan.samples
    assert oracle.samples == edge.samples
    assert more.rounds == oracle.rounds == edge.rounds == plan.edge_rounds == 2


def test_vehicles_learn_from_what_is_near_a_sensor_of_any_arm(finished: Path, result: Run) -> None:
    split = Frames.open(finished / "work/grid-edge-objects")
    places = [Placed.load(folder) for folder in (finished / "work").glob("grid-place*")]
    poles = load_town("grid").poles
    sites = [poles.position[poles.id.tolist().index(pole), :2] for placed in places for pole in placed.chosen]
    near = [
        i
        for i in split.vehicles
        if min(np.hypot(*(split.data.frame(i).world_from_agent[:2, 3] - site)) for site in sites)
        <= RECIPE.placement.group_range_m
    ]
    assert StageResult.load(finished / "work/grid-edge-fl-objects").samples == len(near)
    assert set(split.poles) == {pole for placed in places for pole in placed.chosen}


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


def test_no_two_splits_share_a_scene(finished: Path) -> None:
    folders = sorted(finished.glob("work/*/data"))
    assert len(folders) == 3 + 4 + 4
    scenes = [{key.scene for key in Dataset.open(folder).keys} for folder in folders]
    assert not any(a & b for a, b in combinations(scenes, 2))


def test_the_plan_is_made_anew_from_what_the_run_reached_and_sent(finished: Path, result: Run) -> None:
    main = result.arms[MAIN]
    assert main.earlier is not None
    assert [plan.after for plan in (*main.earlier, main.plan)] == [None, PRETRAIN, EDGE]
    for plan in (*main.earlier[1:], main.plan):
        frames, scores = zip(
            *((each.frames, each.rounds[-1].score) for each in result.watched if each.stage == plan.after), strict=True
        )
        assert plan.reached == {"objects": pytest.approx(np.average(scores, weights=frames))}
    (own,) = (each for each in main.plan.tasks.values())
    assert len(Watched.load(finished / "work/rounds-grid-edge-fl-objects-grid").rounds) == own.edge_rounds
    assert result.arms["equal"].earlier is None


def test_rounds_are_watched_on_validation_frames(finished: Path, result: Run) -> None:
    graph = Graph(RECIPE, TOY.parent)
    for step in graph.steps:
        if step.name.startswith("rounds-"):
            assert "-validation-" in step.arguments["settings"].frames
    assert {(each.stage, each.region) for each in result.watched} == {
        (s, r) for s in (PRETRAIN, EDGE, CLOUD) for r in ("grid", "ring")
    }
    watched = Watched.load(finished / "work/rounds-grid-edge-fl-objects-grid")
    assert [each.round for each in watched.rounds] == [1, 2]


def test_findings_say_what_their_intervals_say(result: Run) -> None:
    own = [each for each in result.differences if each.arm == MAIN]
    assert len(own) == len(result.findings) >= 8
    for difference, finding in zip(own, result.findings, strict=True):
        low, high = difference.estimate.low, difference.estimate.high
        assert low is not None
        assert high is not None
        lost = " lose to " in finding.question  # an estimate, no claim
        assert finding.verdict in ((ESTIMATE,) if lost else (UNDECIDED, verdict(low, high)))
        if "nothing to compare" not in finding.sentence:
            assert f"{difference.estimate.mean:+.3f}".replace("-", "−") in finding.sentence

    assert judge_anew(result) == result.findings


def test_the_report_needs_no_other_file(finished: Path, result: Run) -> None:
    text = (finished / "report.html").read_text()
    assert all(link.startswith("data:") for link in re.findall(r"""(?:src|href)\s*=\s*["']?([^"'\s>]+)""", text))
    assert not re.search(r"url\(|@import|<script|<link|<iframe", text)
    read = html.unescape(re.sub(r"\s+", " ", text))
    assert all(finding.sentence in read for finding in result.findings)
    names = {path.stem for path in (finished / "pictures").iterdir()}
    timelines = {"timeline_grid_equal", "timeline_ring_equal"}
    drawn = {"map_grid", "map_ring", "rounds_objects", "megabytes", "gain", "before_after", "overview"}
    assert names == drawn | timelines
    for path in (finished / "pictures").iterdir():
        with Image.open(path) as picture:
            assert min(picture.size) > 300
            colours = picture.convert("RGB").resize((300, 300)).getcolors(90_000)
            assert colours is not None
            assert len(colours) > 50, path.name


def test_the_run_leaves_history_that_fit_reads(studied: tuple[Path, Any, Any], capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stopped:
        command(["fit", str(studied[0] / "history.csv"), "--json", "--repeats", "20"])
    assert not stopped.value.code
    (curve,) = json.loads(capsys.readouterr().out)["curves"]
    assert curve["points"] == 1 + 2 + 1  # pretrained, each edge round, each cloud round


def test_the_comparison_of_arms_is_that_of_the_run(studied: Studied, result: Run) -> None:
    results = studied[1]
    (seed,) = results.seeds
    for town, arms in ARMS.items():
        for name, (arm, stage) in arms.items():
            test = result.test(arm=arm, stage=stage, region=town, task="objects")
            assert seed.ap[town][name].ap50 == test.estimate.mean
    assert set(seed.gap_closed) == set(ARMS["grid"]) - {"pretrained", "oracle"}
    assert len(seed.differences) == 7 + 4
    assert seed.used_mb["edge + cloud FL"]["wireless"] == result.arms[MAIN].links["wireless"].used_mb
    further, main = result.arms["further"], result.arms[MAIN]
    assert further.links["wireless"].used_mb == main.links["wireless"].used_mb  # an edge round instead of a cloud round
    assert further.links["wireline"].used_mb == pytest.approx(
        sum(each.mb for each in main.spent if (each.stage, each.link) == (PRETRAIN, "wireline"))
    )
    rounds = [each.rounds for each in further.stages if each.stage == MORE_EDGE]
    assert rounds == [main.plan.tasks["objects"].cloud_rounds] * 2
    assert results.summary.ap50["grid"]["oracle"].mean == seed.ap["grid"]["oracle"].ap50


def test_the_proof_by_training_compares_two_plans(studied: Studied, result: Run) -> None:
    (at,) = studied[2].budgets
    (seed,) = at.seeds
    equal, joint = seed.plans["equal-stages"], seed.plans["joint"]
    assert joint.samples == result.arms[MAIN].plan.tasks["objects"].samples
    assert equal.samples == result.arms["equal"].plan.tasks["objects"].samples
    first, *made_anew = result.arms[MAIN].plans  # those made anew rest on scores of the run
    assert made_anew
    assert seed.predicted["joint"] == first.tasks["objects"].predicted
    assert set(seed.realised) == set(seed.differences) == {MEAN, "grid", "ring"}
    towns = [seed.realised[town]["joint"][EDGE].ap50 for town in ("grid", "ring")]
    assert seed.realised[MEAN]["joint"][EDGE].ap50 == pytest.approx(np.mean(towns))
    assert (joint.counts, at.coincide) == (equal.counts, True)  # the limits of the toy's rounds bind both
    assert ["the same" in finding.sentence for finding in at.findings] == [True, False]


def test_a_finished_run_is_not_done_again(finished: Path, tmp_path: Path) -> None:
    without(finished, tmp_path, lambda name: False)
    told: list[str] = []
    run(RECIPE, tmp_path, beside=TOY.parent, notify=lambda step, done, total, note: told.append(note))
    assert told == ["done before"] * len(Graph(RECIPE, TOY.parent).steps)
    assert timeless(tmp_path) == timeless(finished)
    with pytest.raises(InputError, match="another configuration"):
        run(RECIPE.model_copy(update={"seed": 2}), tmp_path, beside=TOY.parent)


def test_stage_two_alone_goes_on_with_a_run_and_ends_with_its_weights(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = without(finished, tmp_path, lambda name: name.startswith(("grid-edge-fl", "test-", "rounds-", "cloud-")))
    with pytest.raises(SystemExit) as stopped:
        command(["federate", str(TOY), "--out", str(tmp_path), "--arm", "no_pole"])  # in two processes
    assert not stopped.value.code
    printed = capsys.readouterr().out.splitlines()
    name = "grid-federate-objects-no_pole"
    assert [line.partition(": loss")[0] for line in printed[:2]] == [f"{name}, round {n} of 2" for n in (1, 2)]
    found = json.loads((tmp_path / "federation-no_pole.json").read_text())["federations"][0]
    assert [each["region"] for each in found["watched"]] == ["suburb", "grid", "ring"]
    at = {each["region"]: f"{each['region']} {each['rounds'][1]['score']:.3f}" for each in found["watched"]}
    assert printed[1].endswith(", ".join(at.values()))
    own, edge = (
        folder / "weights.safetensors" for folder in (work / name, finished / "work/grid-edge-fl-objects-no_pole")
    )
    assert (tmp_path / f"{name}.safetensors").read_bytes() == own.read_bytes() == edge.read_bytes()


def test_stage_two_alone_on_ray_ends_with_the_weights_of_a_run(finished: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    without(finished, tmp_path, lambda name: name.startswith(("grid-edge-fl", "test-", "rounds-", "cloud-")))
    federate_regions(RECIPE, tmp_path, arm="no_pole", beside=TOY.parent, runtime="ray")
    found = load_file(tmp_path / "grid-federate-objects-no_pole.safetensors")
    wanted = load_file(finished / "work/grid-edge-fl-objects-no_pole/weights.safetensors")
    assert found.keys() == wanted.keys()
    for name, array in wanted.items():
        np.testing.assert_allclose(found[name], array, rtol=1e-4, atol=1e-5)


def killed_at(sign: Path, out: Path) -> None:
    """Run the recipe in a process group of its own and kill it once the file `sign` is there."""
    process = subprocess.Popen([sys.executable, "-c", GO, TOY, out], start_new_session=True)
    try:
        while not sign.exists():
            assert process.poll() is None
            time.sleep(0.002)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_a_run_killed_in_pretraining_and_in_edge_fl_ends_the_same(finished: Path, tmp_path: Path) -> None:
    pretrained, first = "pretrain-objects", "grid-edge-fl-objects"
    redone, ending = (first, "cloud-fl-objects"), ("equal", "densest", "no_pole", "pole8", "ring")

    def unwanted(name: str) -> bool:
        again = any(step in name for step in redone) and not name.endswith(ending)
        return again or name in ("look", pretrained)

    work = without(finished, tmp_path, unwanted)
    for step, sign in ((pretrained, "checkpoint.pt"), (first, "round1.safetensors")):
        killed_at(work / step / sign, tmp_path)
        assert not (work / step / "done.json").exists()
    run(RECIPE, tmp_path, beside=TOY.parent, jobs=2)  # alone, each stage has both workers
    assert timeless(tmp_path) == timeless(finished)
    same = [f"{step}/{name}" for step in (pretrained, *redone) for name in ("weights.safetensors", "ledger.parquet")]
    for path in (*same, f"{pretrained}/result.json"):
        assert (work / path).read_bytes() == (finished / "work" / path).read_bytes(), path
    assert [each.step for each in Pretrained.load(work / pretrained).validated] == [5, 10]


def test_runs_are_compared_on_the_same_frames(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "own.yaml").write_text(
        TOY.read_text().split("arms:")[0].replace("placement:", "federation: {strategy: own:Last}\nplacement:")
    )

    def again(name: str) -> bool:
        return (
            "-fl-" in name or name == "look" or name.startswith(("test-", "rounds-", "plan-", "grid-edge", "ring-edge"))
        )

    work = without(finished, tmp_path / "own", again)
    other = run(load_run_recipe(tmp_path / "own.yaml"), work.parent)
    rows = compare(finished, work.parent)
    by_key = {(row.arm, row.stage, row.region): row for row in rows}
    assert set(by_key) == {(test.arm, test.stage, test.region) for test in other.tested}
    assert by_key[MAIN, PRETRAIN, "grid"].difference.mean == 0.0
    edge = by_key[MAIN, EDGE, "grid"]
    assert edge.second == other.test(stage=EDGE, region="grid", task="objects").estimate.mean
    assert edge.difference.mean == pytest.approx(edge.second - edge.first)
    assert {row.verdict for row in rows} == {UNDECIDED}  # the spread of retraining is not known
    weights = "grid-edge-fl-objects/weights.safetensors"
    assert (work / weights).read_bytes() != (finished / "work" / weights).read_bytes()
    with pytest.raises(InputError, match="no finished run"):
        compare(finished, tmp_path)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_leaves_no_process_behind(number: signal.Signals, tmp_path: Path) -> None:
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from flcav.cli.main import run; run()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "demo", "--out", tmp_path],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not (tmp_path / "work/suburb-pool-objects/data/.recording").exists():
        assert process.poll() is None
        time.sleep(0.02)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as the terminal does
    else:
        process.send_signal(number)  # the parent alone
    _, said = process.communicate(timeout=30)
    assert "Traceback" not in said
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert said.endswith("flcav: interrupted; the same command goes on where it stopped\n")
    for _ in range(300):
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("processes of a stopped run go on")


def test_the_summary_of_seeds_is_beside_them(studied: tuple[Path, Any, Any]) -> None:
    summary = json.loads((studied[0] / Summary.file).read_text())
    assert summary["seeds"] == [1]
    assert {row["name"] for row in summary["gap_closed"]} >= {"grid, objects: edge FL"}
    judged = {row["name"] for row in summary["differences"] if "judged" in row}
    assert "grid, objects: edge + cloud FL - further edge FL" in judged
    assert "grid, objects: central training (more) - pretrained" not in judged

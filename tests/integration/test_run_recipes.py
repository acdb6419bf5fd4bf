"""The recipes of runs that come with flcav, each run as it stands but for its size."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from performed_steps import in_mb, perform, uplinks
from safetensors.numpy import load_file

from flcav.cli.main import run as command
from flcav.config import InputError
from flcav.federation.privacy import Privacy
from flcav.network.ledger import LINKS, Ledger
from flcav.perception.objects import distillation
from flcav.perception.objects.task import OBJECTS
from flcav.perception.trajectory.config import CONFIGURATIONS
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.perception.weights import load_network
from flcav.report.pages.run_page import page, write_report
from flcav.reproductions.gap.run import IN_BYTES, UPLOADED, trace_bytes
from flcav.reproductions.megabytes.run import FEDERATED, MORE, SWEEPS, compare_megabytes, trace_seed
from flcav.reproductions.people.run import compare_classes
from flcav.reproductions.radio_labels.run import ARMS, compare_labels
from flcav.runs.analysis.histories import ORIGIN, HistoryOrigin
from flcav.runs.engine import Step, ignore_steps, run_side_by_side
from flcav.runs.forecast import forecast_run
from flcav.runs.frames import Frames
from flcav.runs.recipe import (
    CLOUD,
    EDGE,
    MAIN,
    PRETRAIN,
    SPLITS_OF,
    Arm,
    Budgets,
    Federation,
    Role,
    RunRecipe,
    Split,
    Splits,
    Training,
    load_run_recipe,
)
from flcav.runs.results import tests as results
from flcav.runs.results.plans import Plan
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.results.tests import Difference
from flcav.runs.results.training import Pretrained, StageResult
from flcav.runs.running import RESULTS, run
from flcav.runs.stages.graph import Graph
from flcav.runs.tables import parse_history
from flcav.statistics.verdicts import UNDECIDED
from flcav.world.opendrive.importing import import_town

pytestmark = pytest.mark.slow

RECIPES = Path(__file__).parents[2] / "recipes"
TINY = Splits(
    pool=Split(scenes=1, spins=5, cavs=4),
    validation=Split(scenes=1, spins=1, cavs=1),
    registry=Split(scenes=1, spins=1, cavs=2),
    edge=Split(scenes=1, spins=1, cavs=1),
    test=Split(scenes=2, spins=1, cavs=2),
)
QUICK = Training(steps=1, local_steps=1)


def shrunk(name: str) -> RunRecipe:
    """Return a recipe of a run with little to record and to train."""
    asked = load_run_recipe(RECIPES / "runs" / f"{name}.yaml").model_dump(exclude={"splits", "training"})
    for task in asked["tasks"].values():
        task["training"] = None
        if task["plan"]:
            task["plan"] = {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}
    asked["regions"].pop("ring", None)
    for region in asked["regions"].values():
        region["vehicles"] = 1 if region["role"] == "federate" else None
    limits = {"samples": (20, None), "edge_rounds": (1, 1), "cloud_rounds": (1, 1)}
    placement = asked["placement"] | {"group_range_m": 400.0}
    return RunRecipe.model_validate(
        asked | {"splits": TINY, "training": QUICK, "limits": limits, "placement": placement, "retrainings": 0}
    )


@pytest.fixture(scope="module")
def three_tasks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """Return the folder of a run of three tasks, and what it gave."""
    folder = tmp_path_factory.mktemp("runs") / "three_tasks"
    return folder, run(shrunk("three_tasks"), folder)


def test_a_forecast_is_what_the_run_then_plans(
    three_tasks: tuple[Path, Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    told = forecast_run(shrunk("three_tasks"))
    assert [*tmp_path.iterdir()] == []
    main, found = three_tasks[1].arms[MAIN], told.arms[MAIN]
    for task, plan in main.plan.tasks.items():
        own = found.tasks[task]
        assert (own.samples, own.edge_rounds, own.cloud_rounds) == (plan.samples, plan.edge_rounds, plan.cloud_rounds)
    for link in LINKS:
        use = main.links[link]
        assert found.uplink_mb[link] == pytest.approx(use.planned_mb, rel=0.05)
        assert found.uplink_mb[link] == pytest.approx(use.used_mb, rel=0.05)
    assert 0 < told.minutes < 20
    work = three_tasks[0] / "work"
    recorded = [path for data in work.glob("*/data") for path in data.rglob("*") if path.is_file()]
    assert 0.3 < told.disk_mb / (sum(path.stat().st_size for path in recorded) / 1e6) < 3
    assert any("MB wireless" in line for line in told.lines())


def test_compressed_sweeps_are_in_the_ledger_as_they_are_sent(tmp_path: Path) -> None:
    recipe = shrunk("megabytes")
    found = run(recipe, tmp_path)
    work = tmp_path / "work"
    split = Frames.open(work / "grid-edge-objects")
    network = load_network(OBJECTS, work / "pretrain-objects" / WEIGHTS)
    whole = [*OBJECTS.pack_samples(split.data, network.config, split.vehicles)]
    sent = Ledger.load(work / "grid-central-objects-sweeps3" / LEDGER).entries
    up = [entry.bytes for entry in sent if entry.link == "wireless"]
    assert up == [len(message) for message in OBJECTS.compress_samples(whole)]
    assert sum(up) < sum(map(len, whole)) / 4
    few = {name: Arm(central="federate", uploads=3, compressed=name == "coded") for name in ("floats", "coded")}
    told = forecast_run(recipe.model_copy(update={"arms": few})).arms
    saved_mb = (told["floats"].uplink_mb["wireless"] - told["coded"].uplink_mb["wireless"]) / 3
    assert saved_mb == pytest.approx(
        sum(map(len, whole)) / len(whole) / 1e6 * (1 - sum(up) / sum(map(len, whole))), rel=0.3
    )
    seed = trace_seed(found, work)
    assert {*seed.curves} == {*FEDERATED, SWEEPS, f"{SWEEPS}{MORE}"}
    assert 1 < seed.bytes_per_return < 3
    assert seed.curves[SWEEPS][1].boxes == seed.boxes  # the one frame that there is
    assert compare_megabytes(recipe, {"31": seed}).curves[SWEEPS][1].mb == pytest.approx(sum(up) / 1e6)


def test_labels_by_radio_are_compared_with_ground_truth(tmp_path: Path) -> None:
    recipe = shrunk("radio_labels")
    results = compare_labels(recipe, [run(recipe, tmp_path)])
    (arms,) = results.seeds.values()
    assert [*arms] == [*ARMS]
    start, end = arms["pretrained"].ap50, arms["ground truth"].ap50
    for name, closed in results.closed50.items():
        assert closed.mean == pytest.approx((arms[name].ap50 - start) / (end - start) if end != start else 0)
    added = results.differences["road labels, tracks and messages - tracks and messages"].mean
    assert added == pytest.approx(arms["road labels, tracks and messages"].ap50 - arms["tracks and messages"].ap50)
    assert len(results.sentences()) == 3 + 2 * ("tracks and messages" in results.recall)


def test_classes_are_compared_one_by_one(tmp_path: Path) -> None:
    recipe = shrunk("people")
    done = run(recipe, tmp_path)
    results = compare_classes(recipe, [done])
    (arms,) = results.seeds.values()
    numbers = done.test(arm="heard", stage="edge", region="arterial", task="objects").numbers
    for kind, name in (("Car", "cars"), ("Pedestrian", "pedestrians"), ("Cyclist", "cyclists")):
        assert arms["tracks and messages"].ap50[kind] == (numbers[f"AP50 {kind}"] or 0.0)
        gained = arms["tracks and messages"].ap50[kind] - arms["tracks"].ap50[kind]
        assert results.differences[kind]["tracks and messages - tracks"].mean == pytest.approx(gained)
        assert any(sentence.startswith(f"*{name}, ") for sentence in results.sentences())
    known = done.arms["heard"].stages[0].labels
    assert known is not None
    (labels,) = known
    assert sum(each.targets for each in labels.by_class or ()) == labels.targets
    assert sum(each.right for each in labels.by_class or ()) == pytest.approx((labels.recall or 0) * labels.targets)


def test_a_forecast_refuses_what_the_run_would(tmp_path: Path) -> None:
    recipe = shrunk("three_tasks")
    with pytest.raises(InputError, match="budgets_mb"):
        forecast_run(recipe.model_copy(update={"budgets_mb": Budgets(wireless=0.1, wireline=0.1)}))
    federation = recipe.federation.model_copy(update={"privacy": Privacy(noise=0.5, epsilon=0.1)})
    with pytest.raises(InputError, match="a first round comes to epsilon"):
        forecast_run(recipe.model_copy(update={"federation": federation}))


def test_vehicles_label_by_tracks_of_sweeps_that_are_recorded_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both stages take the tracks of one step; the cloud's own training crosses no link; a frozen head stays."""
    recipe = shrunk("gap")
    asked = (
        "joined",
        "truth",
        "missed",
        "occlusion",
        "bare",
        "frozen",
        "imitating",
        "longer",
        "longest",
        "sweeps6",
        "joint",
    )
    arms = {name: arm for name, arm in recipe.arms.items() if name in asked}
    recipe = recipe.model_copy(update={"arms": arms})
    found = run(recipe, tmp_path)
    work = tmp_path / "work"
    assert {path.name for path in work.glob("*tracks*")} == {"grid-tracks-objects", "grid-tracks-objects-joined"}
    split = Frames.open(work / "grid-edge-objects")
    (poles,) = split.poles.values()
    assert (len(split.data) - len(poles), len(split.vehicles), len(poles)) == (11, 1, 1)  # a window of 2 s
    watched = Frames.open(work / "suburb-validation-objects")
    assert (len(watched.data), len(watched.vehicles)) == (11, 1)
    assert 0 < (Pretrained.load(work / "pretrain-objects").track_threshold or 0) <= 1
    for name in (MAIN, "joined", "truth", "missed", "occlusion"):
        labels = next(each.labels for each in found.arms[name].stages if each.stage == EDGE)
        assert labels is not None
        assert labels[0].recall == (1 if name == "truth" else labels[0].recall)
        if parts := labels[0].by_returns:
            assert [each.returns for each in parts] == [5, 20, 100]
            assert sum(each.targets for each in parts) == labels[0].targets
            assert sum(each.found for each in parts) == pytest.approx((labels[0].recall or 0) * labels[0].targets)
        assert parts or name != "truth"
        assert name not in ("truth", "missed", "occlusion") or labels[0].precision in (1, None)
    sent = Ledger.load(work / "cloud-fl-objects" / LEDGER).entries
    assert {entry.client for entry in sent if entry.stage == CLOUD} == {"grid", "grid/cav0"}
    (cloud,) = (each for each in found.arms[MAIN].stages if each.stage == CLOUD)
    assert cloud.records
    assert cloud.records[0].clients == ("grid", "cloud-replay")
    ended = {
        name: load_file(work / f"{step}" / WEIGHTS)
        for name, step in (
            (PRETRAIN, "pretrain-objects"),
            *((arm, f"cloud-fl-objects-{arm}") for arm in ("bare", "frozen", "imitating")),
        )
    }
    head = {name: own["head.weight"] for name, own in ended.items()}
    same = {name: np.array_equal(own, head[PRETRAIN]) for name, own in head.items()}
    assert same == {PRETRAIN: True, "bare": False, "frozen": True, "imitating": False}
    np.testing.assert_array_equal(head["imitating"], head["bare"])  # a teacher of one step sees nothing
    monkeypatch.setattr(distillation, "SEEN", 0.0)
    (tmp_path / "again").mkdir()
    for stage in ("grid-edge-fl-objects-imitating", "cloud-fl-objects-imitating"):
        perform(recipe, tmp_path, tmp_path / "again", (stage,))
        blind, seen = (load_file(folder / stage / WEIGHTS)["head.weight"] for folder in (work, tmp_path / "again"))
        assert not np.array_equal(blind, seen)
    backbone = next(name for name in ended["frozen"] if name.startswith("backbone") and name.endswith("weight"))
    assert not np.array_equal(ended["frozen"][backbone], ended[PRETRAIN][backbone])

    joint, edge = (StageResult.load(work / step) for step in ("central-objects-joint", "grid-edge-fl-objects"))
    uploaded = Pretrained.load(work / "pretrain-objects").uploaded
    assert joint.samples == sum(map(len, uploaded.values())) + edge.samples
    assert (joint.region, joint.rounds) == (None, edge.rounds)
    tested = {test.region for test in found.tested if test.arm == "joint"}
    assert tested == {"suburb", "grid"}
    against = {
        (each.region, each.stage) for each in found.differences if (each.arm, each.before_arm) == (MAIN, "joint")
    }
    assert against == {("suburb", CLOUD), ("grid", CLOUD)}

    book = Ledger.load(work / "grid-central-objects-sweeps6" / LEDGER)
    (upload,) = (row.bytes / 1e6 for row in book.entries if row.link == "wireless")  # of the one frame there is
    curves = trace_bytes(found, work, "grid")
    assert [point.mb for point in curves[UPLOADED]] == [0, upload]
    spent = {row.stage: row.mb for row in found.arms["sweeps6"].spent if row.link == "wireless"}
    assert spent == {"pretrain": found.arms[MAIN].spent[0].mb, "edge": upload, "cloud": 0}
    up = [row for row in sent if (row.stage, row.link, row.direction) == (EDGE, "wireless", "up")]
    assert {row.round for row in up} == {0, 1}  # errors, and weights
    assert [point.mb for point in curves["edge FL on tracks"]] == [0, sum(row.bytes for row in up) / 1e6]
    longer = curves[IN_BYTES]
    assert [point.label for point in longer] == ["pretraining", "1 round", "6 rounds", "16 rounds"]
    one_mb = (sent_mb := [point.mb for point in longer])[1] - sum(row.bytes for row in up if row.round == 0) / 1e6
    assert [mb - sent_mb[1] for mb in sent_mb[2:]] == pytest.approx([5 * one_mb, 15 * one_mb], rel=0.01)
    assert one_mb < 0.3 * sum(row.bytes for row in up if row.round) / 1e6  # in 8 bits of 32
    assert len({point.ap50 for points in curves.values() for point in points[:1]}) == 1  # all begin with one network


def test_what_vehicles_hear_is_in_the_ledger_of_their_labels(tmp_path: Path) -> None:
    recipe = shrunk("messages")
    arms = {name: recipe.arms[name] for name in ("tracks", "messages")}
    result = run(recipe.model_copy(update={"arms": arms}), tmp_path)
    heard = {}
    for arm in (MAIN, *arms):
        entries = Ledger.load(tmp_path / "work" / result.steps.edge(arm, "grid", "objects") / LEDGER).entries
        heard[arm] = [(entry.direction, entry.client) for entry in entries if entry.link == "sidelink" and entry.bytes]
    assert heard == {MAIN: [("down", "grid/cav0")], "tracks": [], "messages": [("down", "grid/cav0")]}
    assert all(use.used_mb <= use.budget_mb for use in result.arms[MAIN].links.values())


def test_three_tasks_share_a_plan_and_a_ledger(three_tasks: tuple[Path, Run]) -> None:
    recipe = shrunk("three_tasks")
    folder, result = three_tasks
    main = result.arms[MAIN]
    assert list(main.plan.tasks) == ["objects", "weather", "trajectory"]
    assert [plan.predicted is None for plan in main.plan.tasks.values()] == [False, False, True]
    tested = {(test.task, test.region, test.stage) for test in result.tested}
    assert {(task, region, PRETRAIN) for task in recipe.tasks for region in recipe.regions} <= tested
    assert {(task, "grid", stage) for task in recipe.tasks for stage in (EDGE, CLOUD)} <= tested
    for link, use in main.links.items():
        spent = {task: main.sent_mb(task, link) for task in recipe.tasks}
        assert all(mb > 0 for mb in spent.values())
        assert sum(spent.values()) == pytest.approx(use.used_mb)
        assert use.used_mb <= use.budget_mb
        for task in ("weather", "trajectory"):  # what a message weighs was known beforehand
            assert spent[task] == pytest.approx(getattr(main.plan.tasks[task], f"{link}_mb"), rel=0.3)
    pool = Frames.open(folder / "work/suburb-pool-trajectory")
    sent = [*TRAJECTORY.pack_samples(pool.data, CONFIGURATIONS["tiny"], pool.vehicles)]
    told: dict[tuple[str, int], set[bytes]] = {}
    for i, message in zip(pool.vehicles, sent, strict=True):
        told.setdefault((pool.data.keys[i].scene, pool.data.keys[i].index), set()).add(message)
    assert all(len(messages) == 1 for messages in told.values())  # all four vehicles of an instant would send it
    assert len(TRAJECTORY.unpack_samples(sent, CONFIGURATIONS["tiny"])) > 0
    read = Run.load(folder, RESULTS)
    assert page(read) == page(result)  # in the recipe's order, not in that of the alphabet
    assert "trajectory" in write_report(read, folder).read_text()
    assert {"rounds_objects.png", "rounds_weather.png", "rounds_trajectory.png", "before_after.png"} <= {
        path.name for path in (folder / "pictures").iterdir()
    }


@pytest.fixture(scope="module")
def timed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunRecipe, Run]:
    """Return the folder of a run with little time, its recipe, and what it gave."""
    beside = tmp_path_factory.mktemp("timed")
    points = [(s, e, c) for s in (2, 4) for e in range(4) for c in range(3)]
    scores = [0.9 - s**-0.5 / 2 - 0.3 / (e + 1) - 0.05 / (c + 1) for s, e, c in points]
    rows = [f"{s},{e},{c},{score:.4f}" for (s, e, c), score in zip(points, scores, strict=True)]
    (beside / "own.csv").write_text("\n".join(["samples,edge_rounds,cloud_rounds,accuracy", *rows]) + "\n")
    few = {"scenes": 2, "spins": 1, "cavs": 2}
    recipe = RunRecipe.model_validate(
        {
            "splits": {
                **dict.fromkeys(("pool", "validation", "edge", "test"), few),
                "registry": {"scenes": 1, "spins": 6, "cavs": 2},  # 20 s
            },
            "training": {"steps": 1, "local_steps": 1},
            "tasks": {"weather": {"history": "own.csv", "train_s": 1.0}},
            "regions": {"suburb": {"role": "pretrain"}, "ring": {"role": "federate", "speed": {"cav1": 0.5}}},
            "budgets_mb": {"wireless": 90, "wireline": 90},
            "limits": {"samples": [2, None]},
            "horizon_s": 4.0,
            "placement": {"rule": "none"},
            "recording": {"warmup_s": 5.0, "weather": "clear"},
            "arms": {
                "outputs": {"federation": {"strategy": {"fedmd": {"frames": 2, "steps": 1}}}},
                "regional": {"federation": {"personal": {"pull": 0.1}}},
            },
        }
    )
    return beside / "out", recipe, run(recipe, beside / "out", beside=beside)


def test_vehicles_join_the_rounds_that_they_have_time_for(timed: tuple[Path, RunRecipe, Run]) -> None:
    folder, _, result = timed
    main = result.arms[MAIN]
    plan = main.plan.tasks["weather"]
    assert plan.joins is not None
    rounds = plan.edge_rounds + plan.cloud_rounds
    fast, slow = (plan.joins[f"ring/cav{number}"] for number in range(2))
    assert set(fast) | set(slow) == set(range(1, rounds + 1))
    assert len(fast) <= 4
    assert 2 * len(slow) <= 4 < 2 * rounds
    book = Ledger.load(folder / "ledgers/main.parquet").entries
    sent = [(e.stage, e.client, e.round) for e in book if (e.link, e.direction) == ("wireless", "up") and e.round]
    assert sorted(sent) == sorted(
        (EDGE, name, number) if number <= plan.edge_rounds else (CLOUD, name, number - plan.edge_rounds)
        for name, joined in plan.joins.items()
        for number in joined
    )
    for own, other in zip(result.arms["outputs"].stages, main.stages, strict=True):  # of probabilities, and weights
        for few, many in zip(own.records or (), other.records or (), strict=True):
            assert few.clients == many.clients
            if few.server != CLOUD and few.clients:
                assert 0 < few.up_bytes < many.up_bytes / 100
    sent = {(e.link, e.client) for e in Ledger.load(folder / "ledgers/outputs.parquet").entries if not e.round}
    assert {("wireline", "ring"), *(("wireless", f"ring/cav{number}") for number in range(2))} <= sent
    tested = result.arms["regional"].regional
    assert {(test.model, test.region) for test in tested or ()} == {("ring", "suburb"), ("ring", "ring")}
    assert not (folder / "work/ring-edge-fl-weather-regional").exists()


def test_a_plan_within_a_horizon_counts_the_time_on_the_air(timed: tuple[Path, RunRecipe, Run]) -> None:
    folder, recipe, result = timed
    bands = {name: {"network": {"radio": {"bandwidth_mhz": mhz}}} for name, mhz in (("wide", 20), ("narrow", 4))}
    graphs = {
        name: Graph(recipe.model_copy(update={"arms": {}, "federation": Federation.model_validate(own)}), folder.parent)
        for name, own in bands.items()
    }
    steps: dict[Path, Sequence[Step]] = {folder / "work": Graph(recipe, folder.parent).steps}  # of the recordings
    for name, graph in graphs.items():
        (plan,) = (step for step in graph.steps if step.name == "plan")
        steps[folder / name] = [step for step in graph.steps if step.name in plan.needs or step is plan]
    run_side_by_side(steps, jobs=1, notify=ignore_steps)
    plans = [Plan.load(folder / name / "plan").tasks["weather"] for name in graphs]
    known = result.arms[MAIN]
    assert known.earlier is not None
    fast = [len((plan.joins or {})["ring/cav0"]) for plan in (known.earlier[0].tasks["weather"], *plans)]
    assert 4 >= fast[0] >= fast[1] > fast[2] >= 1  # a round trains for 1 s, and narrow bands take as long again


def test_class_probabilities_are_priced_as_they_are_booked(timed: tuple[Path, RunRecipe, Run], tmp_path: Path) -> None:
    made, recipe, result = timed
    uploaded = sum(map(len, result.pretrained[0].uploaded.values()))
    fixed = {"weather": {"plan": {"samples": uploaded, "edge_rounds": 2, "cloud_rounds": 1}}}
    outputs = {"strategy": {"fedmd": {"frames": 2, "steps": 1}}}
    changes = {"tasks": fixed, "federation": outputs, "arms": {}, "replan": "none", "horizon_s": None}
    asked = RunRecipe.model_validate(recipe.model_dump() | changes)
    perform(asked, made, tmp_path, ("plan", "ring-edge-fl-weather", "cloud-fl-weather"))
    plan, book = Plan.load(tmp_path / "plan").tasks["weather"], Ledger.load(tmp_path / "cloud-fl-weather" / LEDGER)
    rounds = [each for each in uplinks(book.entries, "wireless") if each.round]
    assert plan.exchange_mb is not None
    assert [each.bytes / 1e6 for each in rounds] == pytest.approx([plan.exchange_mb] * (2 * 3), rel=0.02)
    assert plan.exchange_mb < plan.model_mb / 100
    for link in ("wireless", "wireline"):
        priced, booked = getattr(plan, f"{link}_mb"), in_mb(uplinks(book.entries, link))
        assert priced == pytest.approx(booked, rel=asked.headroom)


def test_signs_are_federated_and_their_errors_place_the_sensor(tmp_path: Path) -> None:
    recipe = shrunk("three_tasks").model_dump()
    recipe["tasks"] = {"signs": {"plan": {"samples": 3, "edge_rounds": 1, "cloud_rounds": 1}}}
    recipe["placement"]["tasks"] = ["signs"]
    result = run(RunRecipe.model_validate(recipe), tmp_path)
    assert {(test.task, test.region, test.stage) for test in result.tested} == {
        *(("signs", region, stage) for region in recipe["regions"] for stage in (PRETRAIN, CLOUD)),
        ("signs", "grid", EDGE),
    }
    main = result.arms[MAIN]
    assert main.sent_mb("signs", "wireless") > 0
    assert [(placed.region, placed.errors > 0, len(placed.chosen)) for placed in main.placed] == [("grid", True, 1)]
    write_report(result, tmp_path)
    assert {"map_grid.png", "rounds_signs.png"} <= {path.name for path in (tmp_path / "pictures").iterdir()}


def test_a_town_from_a_map_federates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    path = RECIPES / "runs/imported_town.yaml"
    recipe = load_run_recipe(path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="there is no folder"):
        Graph(recipe, path.parent)
    shown = re.search(r"flcav towns import (\S+) --out (\S+)", path.read_text())
    assert shown is not None
    import_town(RECIPES.parent / shown[1], tmp_path / shown[2])
    steps = {step.name: step for step in Graph(recipe, path.parent).steps}  # `test_the_loop` runs such ones
    assert set(steps["mine-edge-objects"].arguments["settings"].version) == {"town.net.xml", "town.yaml"}
    assert "test-cloud-fl-objects-arterial" in steps


def test_a_history_is_made_of_recorded_datasets(
    three_tasks: tuple[Path, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = three_tasks[0] / "work"

    def recorded(region: str, role: Role) -> dict[str, str]:
        of = {split: "objects" if split == "registry" else "weather" for split in SPLITS_OF[role]}  # as recorded
        return {split: str(before / f"{region}-{split}-{task}/data") for split, task in of.items()}

    recipe = shrunk("three_tasks").model_dump(mode="json")
    roles: dict[str, Role] = {"suburb": "pretrain", "grid": "federate"}
    recipe["regions"] = {region: {"role": role, "data": recorded(region, role)} for region, role in roles.items()}
    recipe["tasks"] = {"weather": recipe["tasks"]["weather"]}
    recipe["placement"] = {"rule": "none", "tasks": [], "group_range_m": 400.0}
    (tmp_path / "few.yaml").write_text(json.dumps(recipe))
    out = tmp_path / "history"
    asked = ["--out", str(out), "--jobs", "1", "--edge-rounds", "2", "--cloud-rounds", "1", "--seeds", "1"]
    flcav("history", str(tmp_path / "few.yaml"), "--task", "weather", "--samples", "4,2", *asked, code=0)
    made = parse_history("weather", (out / "history.csv").read_text(), "history.csv")
    assert made.resources.tolist() == [[n, *rounds] for n in (2, 4) for rounds in ([0, 0], [1, 0], [2, 0], [2, 1])]
    assert (made.weight == 1).all()  # validation frames
    origin = HistoryOrigin.load(out, ORIGIN)
    assert (origin.samples, origin.edge_rounds, origin.cloud_rounds, origin.seeds) == ((2, 4), 2, 1, (101,))
    assert origin.recipe.training == QUICK
    result = Run.load(out / "seed101-4", RESULTS)
    assert {(test.region, test.stage) for test in result.tested} == {
        *((region, stage) for region in roles for stage in (PRETRAIN, CLOUD)),
        ("grid", EDGE),
    }
    dealt = Frames.open(out / "seed101-4/work/grid-edge-weather")
    assert dealt.vehicles == Frames.open(before / "grid-edge-weather").vehicles
    flcav("history", str(tmp_path / "few.yaml"), "--task", "weather", "--samples", "4;2", *asked, code=2)
    assert "--samples '4;2': whole numbers from 1" in capsys.readouterr().err
    flcav("history", str(tmp_path / "few.yaml"), "--task", "weather", "--samples", "9999999", *asked, code=2)
    assert "the run of seed 101 with 9999999 samples: field 'tasks.weather.plan.samples'" in capsys.readouterr().err
    flcav("history", str(tmp_path / "few.yaml"), "--task", "signs", "--samples", "4", *asked, code=2)
    assert "'signs' is none of the recipe's tasks: weather" in capsys.readouterr().err


def flcav(*arguments: str, code: int) -> None:
    """Run the command line and check its exit code."""
    with pytest.raises(SystemExit) as ended:
        command(list(arguments))
    assert ended.value.code == code


def test_retrainings_measure_a_spread_that_another_run_of_the_recipe_takes(tmp_path: Path) -> None:
    few = {"scenes": 2, "spins": 1, "cavs": 1}
    asked = {
        "splits": dict.fromkeys(("pool", "validation", "registry", "edge", "test"), few),
        "training": {"steps": 2, "local_steps": 1},
        "tasks": {"weather": {"plan": {"samples": 2, "edge_rounds": 1, "cloud_rounds": 1}}},
        "regions": {"suburb": {"role": "pretrain"}, "ring": {"role": "federate"}},
        "budgets_mb": {"wireless": 9, "wireline": 9},
        "placement": {"rule": "none"},
        "recording": {"warmup_s": 5.0, "weather": "clear"},
    }
    once = run(RunRecipe.model_validate(asked), tmp_path / "own")
    assert {finding.verdict for finding in once.findings} == {UNDECIDED}
    again = run(RunRecipe.model_validate(asked | {"retrainings": 2}), tmp_path / "own")
    work = tmp_path / "own" / "work"
    names = ["pretrain-weather", "pretrain-weather-main-again1", "pretrain-weather-main-again2"]
    assert len({(work / name / WEIGHTS).read_bytes() for name in names}) == 3
    assert len({str(Pretrained.load(work / name).uploaded) for name in names}) == 1
    for test, before in zip(again.tested, once.tested, strict=True):
        assert test.result == before.result
        assert len(test.retrained) == 2
        assert test.spread is not None
        values = [test.result.estimate.mean, *test.retrained]
        assert test.spread.sd == pytest.approx(np.std(values, ddof=1))
        if test.result.estimate.low is not None:
            assert test.estimate.mean == pytest.approx(np.mean(values))
    for each in again.differences:
        pairs = [
            [again_at(again, each, stage).retrained[n] for stage in (each.before_stage, each.stage)] for n in (0, 1)
        ]
        assert each.retrained == pytest.approx([after - before for before, after in pairs])
        if each.over_scenes.low is not None:
            assert each.estimate.mean == pytest.approx(np.mean([each.over_scenes.mean, *each.retrained]))
    taken = run(RunRecipe.model_validate(asked | {"spread": "own/spread.csv"}), tmp_path / "own", beside=tmp_path)
    told = {each.name: each.spread for each in again.differences}
    for each in taken.differences:
        assert each.spread is not None
        assert each.spread.sd == pytest.approx(told[each.name].sd, abs=1e-5)  # type: ignore[union-attr]
    assert "sd of retraining" in write_report(taken, tmp_path / "own").read_text()


def again_at(result: Run, each: Difference, stage: str) -> results.Test:
    return next(test for test in result.tested if (test.stage, test.region) == (stage, each.region))

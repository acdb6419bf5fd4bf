"""The long table of a run's results, against the committed results read as plain JSON."""

import csv
import json
from collections import Counter
from dataclasses import astuple, replace
from pathlib import Path

import pytest

from flcav.runs.extras.groups.rows import CheckedNetwork, Group, LeadTerm
from flcav.runs.extras.lifelong.rows import LifelongArm, Passed
from flcav.runs.results.run import Run
from flcav.runs.results.table import Row, save_table, tabulate
from flcav.storage.records import select

RUNS = Path(__file__).parents[3] / "reproductions" / "runs"
KNOWN = ("demo", "demo/earlier/road", "radio", "demo/earlier/retraining", "three_tasks")


@pytest.fixture(scope="module", params=KNOWN)
def folder(request: pytest.FixtureRequest) -> Path:
    return RUNS / request.param


def test_no_two_rows_are_of_the_same_quantity_at_the_same_place(folder: Path) -> None:
    rows = tabulate(Run.load(folder))
    places = Counter(astuple(replace(row, value=0.0, low=None, high=None)) for row in rows)
    assert [place for place, times in places.items() if times > 1] == []


def test_every_test_and_difference_has_its_interval_and_trainings(folder: Path) -> None:
    raw = json.loads((folder / "results.json").read_text())
    rows = tabulate(Run.load(folder))
    for kind in ("tested", "differences"):
        for each in raw[kind]:
            place = {name: each[name] for name in ("arm", "stage", "region", "task")}
            place["minus"] = f"{each['before_arm']}/{each['before_stage']}" if kind == "differences" else ""
            (whole,) = select(rows, **place, quantity=f"{kind}.estimate")
            assert [whole.value, whole.low, whole.high] == [each["estimate"][end] for end in ("mean", "low", "high")]
            assert whole.measure == (each["result"]["measure"] if kind == "tested" else "")
            retrained = select(rows, **place, quantity=f"{kind}.retrained")
            assert [(row.training, row.value) for row in retrained] == [*enumerate(each["retrained"], start=2)]


def test_rounds_traffic_and_labels_are_rows(folder: Path) -> None:
    raw = json.loads((folder / "results.json").read_text())
    rows = tabulate(Run.load(folder))
    for arm, result in raw["arms"].items():
        for link, use in result["links"].items():
            kinds = ("budget_mb", "planned_mb", "used_mb")
            found = [select(rows, arm=arm, quantity=f"arms.links.{link}.{kind}") for kind in kinds]
            assert [(row.value, row.unit) for (row,) in found] == [(use[kind], "MB") for kind in kinds]
            sent = sum(row.value for row in select(rows, arm=arm, quantity=f"arms.spent.{link}.mb"))
            assert sent == pytest.approx(use["used_mb"])
        trainings = len(result.get("retrained") or ()) // len(raw["recipe"]["tasks"])
        assert {row.training for row in select(rows, arm=arm, quantity="arms.retrained.samples")} == {
            *range(2, 2 + trainings)
        }
        for stage in result["stages"]:
            place = {"arm": arm, "stage": stage["stage"], "task": stage["task"]}
            for record in stage.get("records") or ():
                where = {**place, "server": record["server"], "round": record["round"]}
                found = [
                    select(rows, **where, quantity=f"arms.stages.records.{name}") for name in ("clients", "up_bytes")
                ]
                assert [row.value for (row,) in found] == [len(record["clients"]), record["up_bytes"]]
            for labels in stage.get("labels") or ():
                where = {**place, "region": stage["region"], "round": labels["round"]}
                (right,) = select(rows, **where, quantity="arms.stages.labels.precision")
                assert right.value == labels["precision"]


def test_results_csv_has_a_row_for_each(tmp_path: Path) -> None:
    run = Run.load(RUNS / "demo")
    save_table(run, tmp_path)
    with (tmp_path / "results.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    rows = tabulate(run)
    assert len(read) == len(rows)
    for row, cells in zip(rows, read, strict=True):
        assert (cells["quantity"], cells["region"], float(cells["value"])) == (row.quantity, row.region, row.value)
        assert (cells["low"] or None) == (None if row.low is None else cells["low"])
        assert row.low is None or float(cells["low"]) == row.low


def test_groups_losses_and_lifelong_learning_have_rows_of_their_places() -> None:
    run = Run.load(RUNS / "demo")
    main = run.arms["main"]
    group = Group(
        0.5, {"grid/cav0": CheckedNetwork(4, 0.75)}, "cav0", terms=(LeadTerm("cav0", 1, 2, 1), LeadTerm("cav1", 2))
    )
    stage = replace(main.stages[0], losses=(0.5, 0.25), group=group)
    passed = [Passed(name, ("a", "b"), 2, 3, True, {}, 0.5, 24.0, 0.0, 0.0, 10, 20) for name in ("fog", "rain")]
    arm = LifelongArm.of("replay", "objects", "AP50", ((0.5, 0.4), (0.6, 0.5), (0.6, 0.7)), tuple(passed))
    arms = {**run.arms, "main": replace(main, stages=(stage, *main.stages[1:]))}
    rows = tabulate(replace(run, arms=arms, lifelong=(arm,)))
    places = Counter(astuple(replace(row, value=0.0, low=None, high=None)) for row in rows)
    assert max(places.values()) == 1
    losses = select(rows, arm="main", stage=stage.stage, region=stage.region, quantity="arms.stages.losses")
    assert [(row.round, row.value) for row in losses] == [(1, 0.5), (2, 0.25)]
    (before,) = select(rows, quantity="arms.stages.group.vehicles.grid/cav0.before")
    assert (before.stage, before.value) == (stage.stage, 0.75)
    assert [row.value for row in select(rows, quantity=[f"arms.stages.group.terms{n}.first" for n in ("", ".2")])] == [
        1,
        2,
    ]
    (final,) = select(rows, arm="replay", task="objects", quantity="lifelong.final")
    assert (final.measure, final.value) == ("AP50", pytest.approx(0.65))
    assert [
        row.value for row in select(rows, quantity=("lifelong.passed.fog.asked", "lifelong.passed.rain.up_bytes"))
    ] == [2, 10]


def test_rows_are_selected_by_values_and_by_collections_of_them() -> None:
    rows = [Row(arm=arm, round=n, quantity="loss", value=float(n)) for arm in ("main", "bare") for n in (1, 2)]
    rows.append(Row(arm="main", quantity="loss", value=0.5))
    assert [row.value for row in select(rows, arm="main")] == [1.0, 2.0, 0.5]
    assert [row.value for row in select(rows, arm="main", round=None)] == [0.5]
    assert len(select(rows, arm=("main", "bare"), round=2)) == 2
    assert select(rows, arm="mai") == []

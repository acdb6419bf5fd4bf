"""Records of rounds: from a federation's checkpoint and ledger, as a table and as curves."""

import json
from dataclasses import replace
from html import unescape
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from made_up_run import run as made_up_run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from flcav.federation.privacy import SEEDED, Privacy
from flcav.federation.state import RoundRecord
from flcav.network.ledger import Direction, Ledger, LedgerEntry, Link, LinkMegabytes
from flcav.report.pages import html
from flcav.report.pages.run_page import page
from flcav.runs.analysis.caveats import PLACED_BARE
from flcav.runs.recipe import CLOUD, EDGE, MAIN
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER
from flcav.runs.results.training import FederatedRound, LabelQuality, PrivacySpent, StageResult
from flcav.runs.training.checkpoints import Checkpoint
from flcav.runs.training.records import EVENTS, ROUNDS, read_rounds, tabulate_federated_rounds, write_rounds


def entry(link: Link, direction: Direction, round_: int, client: str, size: int) -> LedgerEntry:
    return LedgerEntry(EDGE, "t", link, direction, round_, client, size)


def checkpoint(folder: Path, entries: list[LedgerEntry], **records: RoundRecord) -> None:
    Ledger(LinkMegabytes(1.0, 1.0), entries).save(folder / LEDGER)
    told = {name.replace("_", "/"): (each,) for name, each in records.items()}
    Checkpoint(1, len(entries), (0.25,), "FedAvg()", {}, told).keep(folder)


def test_a_round_has_the_bytes_of_its_own_messages(tmp_path: Path) -> None:
    earlier = [entry("wireless", "up", 1, "grid/cav0", 10_000), entry("wireless", "down", 0, "grid/cav0", 900)]
    own = [
        entry("wireless", "down", 1, "grid/cav0", 50),
        entry("wireless", "up", 1, "grid/cav0", 7),
        entry("wireless", "up", 1, "grid/cav1", 8),
        entry("wireless", "up", 2, "grid/cav1", 600),
        entry("wireless", "up", 1, "ring/cav1", 90),
        entry("wireline", "up", 1, "grid", 3),
        entry("wireline", "up", 1, "ring", 4),
    ]
    record = RoundRecord(1, ("grid/cav0",), {"grid/cav1": "no power"}, 2.5, 0.25, 6)
    checkpoint(tmp_path, [*earlier, *own], edge=record)
    (found,) = read_rounds(tmp_path, "grid", len(earlier))
    assert found == FederatedRound("grid", 1, ("grid/cav0",), {"grid/cav1": "no power"}, 6, 0.25, 15, 50, 2.5)
    checkpoint(tmp_path, [*earlier, *own], cloud=RoundRecord(1, ("grid", "ring")), edge_grid=record, edge_ring=record)
    sizes = {each.server: (each.up_bytes, each.down_bytes) for each in read_rounds(tmp_path, None, len(earlier))}
    assert sizes == {CLOUD: (7, 0), "grid": (15, 50), "ring": (90, 0)}
    assert read_rounds(tmp_path / "none", "grid", 0) == ()


def with_rounds(*records: FederatedRound) -> Run:
    result = made_up_run()
    stage = StageResult(EDGE, "objects", "grid", 2, 9, 2, (), (0.5, 0.25), records)
    return replace(result, arms={MAIN: replace(result.arms[MAIN], stages=(stage,))})


def test_rounds_are_a_table_curves_and_rows_of_the_page(tmp_path: Path) -> None:
    first = FederatedRound("grid", 1, ("grid/cav0",), {"grid/cav1": "no power"}, 6, 0.5, 2_000_000, 50, 3.5, 12.5)
    run = with_rounds(first, replace(first, round=2, failed={}, loss=0.25, epsilon=5.0))
    write_rounds(run, tmp_path)
    write_rounds(run, tmp_path)  # a run that is collected again leaves one set of curves
    rows = pq.read_table(tmp_path / ROUNDS).to_pylist()
    assert rows == tabulate_federated_rounds(run).to_pylist()
    assert [(row["arm"], row["stage"], row["task"], row["round"]) for row in rows] == [
        (MAIN, EDGE, "objects", number) for number in (1, 2)
    ]
    assert rows[0]["failed"] == ["grid/cav1: no power"]
    curves = EventAccumulator(str(tmp_path / EVENTS / "main/edge/objects/grid"))
    curves.Reload()
    drawn = {name: [event.value for event in curves.Scalars(name)] for name in curves.Tags()["scalars"]}
    assert drawn == {
        "loss": [0.5, 0.25],
        "clients": [1, 1],
        "failed": [1, 0],
        "uplink_mb": [2.0, 2.0],
        "downlink_mb": pytest.approx([5e-5, 5e-5]),
        "epsilon": [3.5, 5.0],
        "seconds": [12.5, 12.5],
    }
    text = html.render(page(run), {})
    for shown in ("<th>ε so far</th><th>seconds</th>", "<td>grid/cav1: no power</td><td>2.0</td>", "<td>3.500</td>"):
        assert shown in text
    for seeded, head in ((False, "ε so far, at δ = 1e-05"), (True, f"ε so far, at δ = 1e-05, {SEEDED}")):
        federation = run.recipe.federation.model_copy(update={"privacy": Privacy(clip=1.0, noise=1.0, seeded=seeded)})
        recipe = run.recipe.model_copy(update={"federation": federation})
        assert f"<th>{head}</th>" in html.render(page(replace(run, recipe=recipe)), {})
    plain = html.render(page(with_rounds(replace(first, epsilon=None, seconds=None))), {})
    assert "<td>grid/cav1: no power</td>" in plain
    assert "<th>ε so far</th>" not in plain
    assert "Rounds of federated learning" not in html.render(page(made_up_run()), {})


def test_the_page_has_precision_and_recall_of_labels_where_they_were_measured() -> None:
    run = made_up_run()
    labels = (LabelQuality(1, 8, 10, 0.75, 0.6, 0.5, 0.21, 0.3), LabelQuality(2, 0, 10, None, 0.0))
    stage = StageResult(EDGE, "objects", "grid", 2, 9, 2, (), (0.5, 0.25), labels=labels)
    measured = replace(run, arms={MAIN: replace(run.arms[MAIN], stages=(stage,))})
    text = html.render(page(measured), {})
    numbers = "<td>0.750</td><td>0.600</td><td>0.500</td><td>0.210</td><td>0.300</td>"
    assert f"<td>grid</td><td>1</td><td>8</td><td>10</td>{numbers}" in text
    assert "<td>–</td><td>0.000</td><td>–</td><td>–</td><td>–</td>" in text
    assert Run.from_json(measured.as_json(), "run").arms[MAIN].stages == (stage,)
    assert "Labels that vehicles learn from" not in html.render(page(run), {})


def test_the_page_and_the_results_have_what_is_spent_together() -> None:
    plain = made_up_run()
    spent = replace(plain.arms[MAIN], privacy=PrivacySpent(21.44, 1e-5, False))
    run = replace(plain, arms={**plain.arms, MAIN: spent})
    told = "a vehicle's whole data in all tasks and trainings together: epsilon 21.44 at delta 1e-05"
    assert f"main, {told}." in unescape(html.render(page(run), {}))
    assert told not in unescape(html.render(page(plain), {}))
    hidden = unescape(html.render(page(replace(run, caveats=(*run.caveats, PLACED_BARE))), {}))
    assert hidden.count(PLACED_BARE) == 1
    assert f"Privacy: {PLACED_BARE}." in hidden
    assert Run.from_json(run.as_json(), "run").arms[MAIN].privacy == spent.privacy
    assert '"privacy": {"epsilon"' not in json.dumps(plain.as_json())

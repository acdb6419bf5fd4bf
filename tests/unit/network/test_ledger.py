"""The ledger: what is refused, what is counted, what survives a save."""

from dataclasses import replace

import pytest

from flcav.config import InputError
from flcav.network.ledger import BudgetExceeded, Ledger, LedgerEntry, LinkMegabytes

UP = LedgerEntry("edge", "objects", "wireless", "up", 1, "grid/cav0", 600_000)
DOWN = replace(UP, direction="down")


def test_an_uplink_message_over_its_budget_is_refused_and_not_recorded():
    ledger = Ledger(LinkMegabytes(wireless_mb=1.0, wireline_mb=5.0), [UP])
    with pytest.raises(BudgetExceeded, match=r"wireless.*cav0 wants 0\.6 MB.*0\.6 of the 1 MB"):
        ledger.enter(replace(UP, round=2))
    assert ledger.entries == (UP,)
    assert ledger.left_mb("wireless") == 0.4
    ledger.enter(replace(UP, round=2, bytes=400_000))  # exactly what is left
    assert ledger.left_mb("wireless") == 0.0


def test_each_link_has_its_own_budget_and_downlink_has_none():
    ledger = Ledger(LinkMegabytes(wireless_mb=0.6, wireline_mb=0.1), [UP])
    ledger.enter(replace(DOWN, bytes=10**9))
    with pytest.raises(BudgetExceeded, match="wireline"):
        ledger.enter(replace(UP, link="wireline"))
    assert ledger.used_mb("wireless") == 0.6
    assert ledger.used_mb("wireless", direction="down") == 1000.0


def test_usage_by_link_stage_and_task_is_exact():
    entries = [
        replace(UP, stage=stage, task=task, link=link, bytes=size)
        for size, (stage, task, link) in enumerate(
            (s, t, k)
            for s in ("pretrain", "edge", "cloud")
            for t in ("objects", "signs")
            for k in ("wireless", "wireline")
        )
    ]
    ledger = Ledger(LinkMegabytes(1, 1), entries)
    assert ledger.used_bytes() == sum(range(12))
    assert ledger.used_bytes(stage="edge") == 4 + 5 + 6 + 7
    assert ledger.used_bytes("wireline", task="signs") == 3 + 7 + 11
    assert ledger.used_bytes("wireless", stage="cloud", task="objects") == 8


def test_a_saved_ledger_goes_on_where_it_stopped(tmp_path):
    ledger = Ledger(LinkMegabytes(1.0, 2.0), [UP, DOWN])
    ledger.save(tmp_path / "ledger.parquet")
    loaded = Ledger.load(tmp_path / "ledger.parquet")
    assert (loaded.entries, loaded.budget) == (ledger.entries, ledger.budget)
    with pytest.raises(BudgetExceeded):
        loaded.enter(replace(UP, round=2))
    assert [path.name for path in tmp_path.iterdir()] == ["ledger.parquet"]


def test_an_empty_ledger_saves_and_loads(tmp_path):
    Ledger(LinkMegabytes(1.0, 2.0)).save(tmp_path / "ledger.parquet")
    assert Ledger.load(tmp_path / "ledger.parquet").entries == ()


def test_loading_something_else_is_one_sentence(tmp_path):
    (tmp_path / "ledger.parquet").write_text("not parquet")
    with pytest.raises(InputError, match=r"ledger\.parquet"):
        Ledger.load(tmp_path / "ledger.parquet")
    with pytest.raises(InputError, match="no such"):
        Ledger.load(tmp_path / "absent.parquet")


@pytest.mark.parametrize("wrong", [{"link": "radio"}, {"direction": "sideways"}, {"bytes": -1}])
def test_an_entry_checks_itself(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(UP, **wrong)

"""The live display, as a terminal shows it."""

import io
import re
import time

import pytest
from rich.console import Console

from flcav import progress


@pytest.fixture
def shown(monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda **_: Console(file=out, force_terminal=True, width=120))
    return out


def test_work_done_before_does_not_shorten_the_time_left(shown):
    with progress.show_progress("train") as report:
        for done in range(900, 906):
            report(done, 2000, "loss 0.31")
            time.sleep(0.05)
    left = re.findall(r"905/2000 (\S+)", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.getvalue()))[-1]
    hours, minutes, seconds = map(int, left.split(":"))
    assert 40 <= 3600 * hours + 60 * minutes + seconds <= 600  # 1095 more of at least 0.05 s each
    assert "loss 0.31" in shown.getvalue()


def test_nothing_is_drawn_where_nobody_looks(monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda **_: Console(file=out))
    with progress.show_progress("train") as report:
        report(1, 2, "loss 0.31")
    assert out.getvalue() == ""


def test_a_bar_has_no_count_before_its_total_is_known(shown):
    with progress.show_progress("train") as report:
        time.sleep(0.3)
        assert "train" in shown.getvalue()
        assert "?" not in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.getvalue())
        report(3, 7, "")
    assert "3/7" in shown.getvalue()

"""The live display, as a terminal shows it."""

import io
import re
import sys
import time
from types import ModuleType

import pytest
from rich.console import Console

from flcav.interface import progress
from flcav.interface.progress import DAMAGED, print_progress
from flcav.runs.engine import print_steps


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


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def unwatched(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    return monkeypatch


def test_progress_is_one_line_of_a_terminal(unwatched: pytest.MonkeyPatch):
    stream = Terminal()
    unwatched.setattr(sys, "stderr", stream)
    for done in range(3):
        print_progress(done + 1, 3, "loss 0.5")
    print_steps("plan", 1, 1, "done")
    print_steps("plan", 1, 2, "half")
    written = stream.getvalue()
    assert [line.strip() for line in written.replace("\n", "").split("\r")[1:]] == [
        "1/3 loss 0.5",
        "2/3 loss 0.5",
        "3/3 loss 0.5",
        "1/1 plan done",
    ]
    assert written.count("\n") == 2
    print_progress(1, 9, f"file {DAMAGED}")
    assert stream.getvalue().count("\n") == 3


def test_progress_shows_in_a_notebook_and_nowhere_else(unwatched: pytest.MonkeyPatch):
    stream = io.StringIO()
    unwatched.setattr(sys, "stderr", stream)
    print_progress(1, 2)
    assert stream.getvalue() == ""
    unwatched.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    print_progress(1, 2)
    assert stream.getvalue().strip() == "1/2"

"""What `docs/architecture.md` says of files: they are there, a frame's way is short, and the tasks' names are alike."""

import re
import sys
from pathlib import Path
from types import FrameType

import numpy as np

import flcav
from flcav.federation import LocalUpdate, Schedule, federate
from flcav.federation.trainable import Weights
from flcav.perception.tasks import TASKS

PACKAGE = Path(flcav.__file__).parent
PAGE = (PACKAGE.parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
MOST = 30  # files on the way of a frame


def files_of(section: str) -> list[str]:
    text = PAGE.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| \d+ \| (.*?) \|", text, re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`([\w/]+\.py)`", row)]


def test_the_way_of_a_frame_leads_through_few_files_that_are_there():
    files = files_of("From traffic to the report")
    assert 20 < len(files) <= MOST
    assert [name for name in files if not (PACKAGE / name).is_file()] == []


class Vehicle:
    samples = 1

    def train(self, weights: Weights, **_: object) -> LocalUpdate:
        return LocalUpdate({name: array + 1 for name, array in weights.items()}, self.samples, 0.0)


def test_the_way_of_a_round_is_that_of_a_trace():
    """A first round imports and compiles what it needs; the second one is traced."""
    schedule = Schedule(rounds=1, steps=1, learning_rate=0.1, final_learning_rate=0.1, seed=0)
    entered: set[str] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        entered.add(frame.f_code.co_filename)

    before = sys.getprofile()
    for profile in (before, note):
        sys.setprofile(profile)
        try:
            federate({"cav0": Vehicle(), "cav1": Vehicle()}, {"w": np.zeros(2)}, schedule)
        finally:
            sys.setprofile(before)
    here = {Path(name).relative_to(PACKAGE).as_posix() for name in entered if Path(name).is_relative_to(PACKAGE)}
    assert here == {*files_of("A round, in the order of a trace")}


def test_files_to_start_reading_at_are_there():
    rows = re.findall(r"^\| `(\w+/)` \|.*\| (.*) \|$", PAGE, re.MULTILINE)
    assert len(rows) > 10
    named = [PACKAGE / folder / name for folder, files in rows for name in re.findall(r"`([^`]+)`", files)]
    assert [path for path in named if not path.exists()] == []


def test_no_folder_is_crowded():
    counts = {folder: len(list(folder.glob("[!_]*.py"))) for folder in PACKAGE.rglob("*") if folder.is_dir()}
    assert {folder.relative_to(PACKAGE).as_posix(): count for folder, count in counts.items() if count > 16} == {}


def test_the_tasks_call_the_same_role_by_the_same_file_name():
    _, _, section = PAGE.partition("## The files of a task")
    section, _, _ = section.partition("\n## ")
    roles = dict(re.findall(r"^\| [\w ]+ \| `(\w+\.py)` \| (.*) \|$", section, re.MULTILINE))
    always = {file for file, held in roles.items() if not held.startswith("where there")}
    assert len(always) > 3
    for task in TASKS:
        others = set(re.findall(rf"`{task}/(\w+\.py)`", section))
        files = {path.name for path in (PACKAGE / "perception" / task).glob("[!_]*.py")}
        assert always <= files <= roles.keys() | others, task
        assert others <= files, task

"""What `docs/architecture.md` says of files: they are there, a frame's way is short, and the tasks' names are alike."""

import re
from pathlib import Path

import flcav
from flcav.perception.tasks import TASKS

PACKAGE = Path(flcav.__file__).parent
PAGE = (PACKAGE.parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
MOST = 30  # files on the way of a frame


def test_the_way_of_a_frame_leads_through_few_files_that_are_there():
    files = re.findall(r"^\| \d+ \| `([\w/.]+)` \|", PAGE, re.MULTILINE)
    assert 20 < len(files) <= MOST
    assert [name for name in files if not (PACKAGE / name).is_file()] == []


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

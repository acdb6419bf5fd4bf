"""What `docs/architecture.md` says of files: they are there, and a frame's way through them is short."""

import re
from pathlib import Path

import flcav

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
    crowded = {folder.relative_to(PACKAGE).as_posix(): count for folder, count in counts.items() if count > 16}
    assert crowded.keys() <= {"perception/objects"}

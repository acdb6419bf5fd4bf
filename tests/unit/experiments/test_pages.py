import re
from pathlib import Path

import pytest
from reproduction_pages import fill, fill_folder, tables_of

from flcav.config import InputError, read_json
from flcav.reproductions.demo_arms.run import ARMS, ArmsResult, order_arms
from flcav.runs.results.run import Summary
from flcav.runs.running import RESULTS
from flcav.storage.markdown import format_table

REPRODUCTIONS = Path(__file__).parents[3] / "reproductions"
RUNS = sorted((REPRODUCTIONS / "runs").glob("*"))
PAGES = [
    *(path.parent for path in sorted(REPRODUCTIONS.rglob("run.py")) if (path.parent / "result.json").is_file()),
    *RUNS,
]
MADE = [folder for folder in PAGES if any((folder / name).exists() for name in ("result.json", RESULTS, Summary.file))]


@pytest.mark.parametrize("folder", MADE, ids=lambda folder: folder.name)
def test_committed_tables_are_those_of_the_committed_numbers(folder: Path) -> None:
    assert fill_folder(folder) == (folder / "README.md").read_text()


@pytest.mark.parametrize("folder", PAGES, ids=lambda folder: folder.name)
def test_pages_have_the_fixed_form(folder: Path) -> None:
    page = (folder / "README.md").read_text()
    parts = [
        "| question |",
        "| **verdict** |",
        "| **key figure** |",
        "**Claim.**",
        "**Command.**",
        "**Expected.**",
        "## Obtained",
        "## Limits",
    ]
    places = [page.index(part) for part in parts]
    assert places == sorted(places)
    assert "<!-- end -->" in page


@pytest.mark.parametrize("folder", PAGES, ids=lambda folder: folder.name)
def test_pages_count_looks_and_say_what_they_can_tell(folder: Path) -> None:
    page = (folder / "README.md").read_text()
    looks = re.search(r"^## Appendix: changes after evaluations\n(?P<rows>.*)\Z", page, re.M | re.S)
    assert looks, "a section of what was changed after which look"
    assert not re.search(r"^## ", looks["rows"], re.M), "it is the last section"
    looks = re.match(r"(?P<rows>.*?)(?=^### |\Z)", looks["rows"], re.M | re.S)
    assert looks
    assert looks["rows"].count("\n|") >= 3, "a table of it"
    assert re.search(r"[Pp]ower|[Nn]o comparison|compares no|to detect|that detect|detecting a", page), (
        "power, or no comparison"
    )


def box_of(page: str) -> tuple[str, str, str]:
    """Return question, verdict and key figure of a page."""
    rows = r"\| question \| (.*) \|\n\|---\|---\|\n\| \*\*verdict\*\* \| (.*) \|\n\| \*\*key figure\*\* \| (.*) \|\n"
    box = re.match(rf"# .*\n\n{rows}", page)
    assert box, "a page begins with a box"
    return box[1], box[2], box[3]


@pytest.mark.parametrize("folder", MADE, ids=lambda folder: folder.name)
def test_the_key_figure_is_one_of_the_tables(folder: Path) -> None:
    *_, figure = box_of((folder / "README.md").read_text())
    number, count = r"(?<![\w.])[+-]?\d*\.?\d+(?!\w|\.\d)", r"\d+ (seeds|trainings)"
    texts = (re.sub(count, "", figure), " ".join(tables_of(folder).values()))
    shown, known = ({*re.findall(number, text.replace("−", "-"))} for text in texts)
    assert shown <= known, "numbers of the key figure stand in the tables of the results"


def test_the_index_has_the_question_and_the_verdict_of_every_page() -> None:
    index = (REPRODUCTIONS.parent / "docs" / "reproductions.md").read_text()
    rows = re.findall(r"^\| \[[^]]*\]\(\.\./reproductions/(.*)/README\.md\) \| (.*) \| (.*) \|$", index, re.M)
    pages = {path.parent.relative_to(REPRODUCTIONS).as_posix(): path for path in REPRODUCTIONS.rglob("README.md")}
    assert {name: said for name, *said in rows} == {
        name: [*box_of(path.read_text())[:2]] for name, path in pages.items()
    }


def test_every_table_is_on_its_page() -> None:
    for folder in MADE:
        page = (folder / "README.md").read_text()
        assert all(f"<!-- {name} -->" in page for name in tables_of(folder)), folder.name


def test_filling_replaces_what_stood_there_and_names_what_is_not_known() -> None:
    page = "words\n<!-- a -->\nold\n<!-- end -->\nmore\n<!-- b -->\n<!-- end -->\n"
    filled = fill(page, {"a": "1", "b": "2"})
    assert filled == "words\n<!-- a -->\n1\n<!-- end -->\nmore\n<!-- b -->\n2\n<!-- end -->\n"
    assert fill(filled, {"a": "1", "b": "2"}) == filled
    with pytest.raises(InputError, match="no table 'b', only a"):
        fill(page, {"a": "1"})


def test_markdown() -> None:
    assert format_table(("x", "y"), [[1, ""], ["b", 2]]) == "| x | y |\n|---|---|\n| 1 | |\n| b | 2 |"


def test_arms_are_drawn_in_their_own_order_whatever_that_of_the_file() -> None:
    results = ArmsResult.from_json(read_json(REPRODUCTIONS / "demo_arms" / "result.json"), "demo")
    drawn = order_arms(results.summary.ap50)
    assert {town: set(arms) for town, arms in drawn.items()} == {
        town: set(arms) for town, arms in results.summary.ap50.items()
    }
    for town, arms in drawn.items():
        assert list(arms) == [arm for arm in ARMS[town] if arm in arms]
    assert (*drawn["grid"],)[0] == "pretrained"
    assert (*drawn["grid"],)[-1] == "oracle"

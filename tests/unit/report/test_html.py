from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import made_up_run
import pytest
from jinja2 import UndefinedError

from flcav.report.pages.html import render
from flcav.report.pages.run_page import Seen, page
from flcav.runs.recipe import MAIN
from flcav.runs.results.plans import Plan
from flcav.runs.results.run import Run
from flcav.runs.results.tests import FoundCount, HomeCost, RunFinding
from flcav.runs.running import RESULTS
from flcav.statistics.estimates import Estimate

DEMO = Path(__file__).parents[3] / "reproductions" / "runs" / "demo" / "earlier" / "road"
PIXEL = b"\x89PNG made up"
PICTURES: dict[str, bytes] = {"before_after": PIXEL}
DRAWINGS: dict[str, str] = dict.fromkeys(("rounds_objects", "megabytes"), "<svg><g></g></svg>")


def results() -> dict[str, Any]:
    return page(made_up_run.run())


class Page(HTMLParser):
    """What a page is made of."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words.extend(data.split())

    @property
    def text(self) -> str:
        return " ".join(self.words)


def test_the_page_needs_nothing_but_itself() -> None:
    text = render(results(), PICTURES, drawings=DRAWINGS)
    read = Page(text)
    assert read.open == []
    assert not {"script", "link", "iframe"} & {tag for tag, _ in read.tags}
    sources = [str(attributes["src"]) for _, attributes in read.tags if "src" in attributes]
    assert len(sources) == 1
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert sum(tag == "svg" for tag, _ in read.tags) == 2
    links = {str(attributes["href"]) for _, attributes in read.tags if "href" in attributes}
    places = {f"#{attributes['id']}" for _, attributes in read.tags if "id" in attributes}
    assert {link for link in links if link.startswith("#")} <= places
    files = {"results.csv", "results.json", "pictures/", "ledgers/", "work/"}
    assert {link for link in links if not link.startswith("#")} == files  # beside the page
    assert "url(" not in text
    assert "viewport" in {attributes.get("name") for tag, attributes in read.tags if tag == "meta"}
    assert all(attributes.get("alt") for tag, attributes in read.tags if tag == "img")


def test_the_page_tells_the_numbers() -> None:
    text = Page(render(results(), PICTURES)).text
    for shown in (
        "objects AP50 edge FL 0.475 0.446–0.502",  # (0.503 + 0.447) / 2, and both intervals in quadrature, halved
        "Means over grid and ring, with 95 % intervals",
        "edge + cloud FL ring 0.468 0.427–0.506 not known 0.278 0.960 96 8",
        "ideal road detector, upper bound",
        "grid, objects: edge FL - pretrained +0.091 +0.041 to +0.141 0.015 of 9",
        "wireless 230.0 216.0 214.7",
        "2 · placed 19 of 61 6.2",
        "8 · densest traffic 6 of 61 12.4",
        "objects before the run 320 6 3 216.0 128.1 0.530",
        "Seed 7; 538 s; x86-64; revision 0123456789; flcav 0.1.0",
    ):
        assert shown in text


def test_an_interval_that_one_scene_leaves_unknown_is_said() -> None:
    told = results()
    first = told["means"][0]
    told["means"][0] = replace(first, estimate=replace(first.estimate, low=None, high=None))
    assert f"pretrained {first.estimate.mean:.3f} no interval: one scene" in Page(render(told, PICTURES)).text


def test_verdicts_stand_at_their_findings() -> None:
    text = render(results(), PICTURES)
    told = Page(text).text
    assert "undecided Does cloud help? What cloud did." in told
    assert told.count("What pole did.") == 1
    assert '<span class="badge did-not-hold">did not hold</span>' in text
    assert "Edge FL beats the pretrained network grid 0.412 → 0.503 +0.091 +0.041 to +0.141 held" in told


def test_the_bars_of_differences_share_an_axis_with_0_on_it() -> None:
    told = results()
    low, high = told["axis"]
    assert low < 0 < 0.141 < high
    text = render(told, {})
    assert f"left: {100 * (0.091 - low) / (high - low):.2f}%" in text
    assert f"left: {100 * (0.041 - low) / (high - low):.2f}%; width: {100 * 0.1 / (high - low):.2f}%" in text


def test_the_map_of_changes_comes_first_with_its_counts() -> None:
    changes = made_up_run.changes()
    run = made_up_run.run()
    text = render(page(run, Seen({"grid": changes})), PICTURES, drawings=DRAWINGS | {"map_grid": "<svg></svg>"})
    read = Page(text)
    assert next(tag for tag, _ in read.tags if tag in ("svg", "img")) == "svg"
    assert f"{changes.gone} of 61 errors in grid are gone, 2 are new." in read.text
    assert "Pole 2 of 9, by most errors in reach: 19 of them within 40 m, 0 in sight past the houses." in read.text


def test_the_score_from_which_detections_count_is_that_of_their_task() -> None:
    run = made_up_run.run()
    counted = FoundCount("main", "edge", "grid", "objects", "cars", 20, 12.0, 3.0, 1)
    said = "Counts are of test frames, of detections that score 0.3 or more."
    for counts, told in (((counted,), said), ((replace(counted, task="weather", false=None),), said[:25] + ".")):
        assert told in Page(render(page(replace(run, counts=counts)), {})).text
    both = (counted, replace(counted, task="signs"))
    told = Page(render(page(replace(run, counts=both)), {})).text
    assert "of objects detections that score 0.3 or more, of signs detections that score" in told


def test_plans_that_were_made_anew_are_told() -> None:
    told = results()
    (first,) = told["plans"]
    later = replace(first.tasks["objects"], cloud_rounds=5)
    told["plans"] = (first, Plan("joint", {"objects": later}, "pretrain", {"objects": 0.471}))
    text = Page(render(told, {})).text
    assert "objects after stage I 0.471 320 6 5 216.0 128.1 0.530" in text
    assert "updated between stages" in text


def test_values_are_escaped() -> None:
    told = results()
    told["findings"] = (RunFinding("grid", "Really?", "held", "<script>alert('x')</script> & more"),)
    text = render(told, {})
    assert "<script" not in text
    assert "&lt;script&gt;" in text


def test_a_picture_that_was_not_made_is_left_out() -> None:
    read = Page(render(results(), PICTURES, drawings={"megabytes": "<svg></svg>"}))
    assert [tag for tag, _ in read.tags].count("svg") == 1
    assert [tag for tag, _ in read.tags].count("img") == 1


def test_missing_results_are_not_passed_over() -> None:
    told = results()
    del told["plans"]
    with pytest.raises(UndefinedError, match="plans"):
        render(told, PICTURES)


def test_the_uploads_of_vehicles_are_on_the_page_where_they_are_planned() -> None:
    run = made_up_run.run()
    own = run.arms[MAIN].plan.tasks["objects"]
    plan = Plan("joint", {"objects": replace(own, uploads={"suburb/cav0": 211, "suburb/cav1": 109})})
    arm = replace(run.arms[MAIN], plan=plan)
    words = Page(render(page(replace(run, arms={**run.arms, MAIN: arm})), PICTURES)).words
    told = " ".join(" ".join(words).split())
    assert "suburb/cav0 211 suburb/cav1 109" in told


def test_what_federated_learning_costs_at_home_is_on_the_page() -> None:
    run = Run.load(DEMO, RESULTS)
    told = Page(render(page(run), {})).text
    assert "At home in suburb, that network loses AP70 0.547 → 0.125." in told
    cost = HomeCost("suburb", "objects", "AP70", 0.5, 0.1, Estimate(-0.4, -0.5, -0.3), 3)
    told = Page(render(page(replace(run, home=(cost,))), {})).text
    assert "AP70 at home, in suburb 0.500 → 0.100 −0.400 (−0.500 to −0.300)" in told
    assert "At home" not in Page(render(results(), PICTURES)).text

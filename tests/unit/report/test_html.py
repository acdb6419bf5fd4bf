from html.parser import HTMLParser

import made_up_run
import pytest
from jinja2 import UndefinedError

from flcav.report.html import render

PIXEL = b"\x89PNG made up"
PICTURES: dict[str, bytes] = dict.fromkeys(("town_map", "before_after", "ap_by_round", "megabytes"), PIXEL)


def results() -> dict:
    findings = [
        {"name": name, "question": f"Does {name} help?", "verdict": verdict, "sentence": f"What {name} did."}
        for name, verdict in (("edge", "held"), ("cloud", "undecided"), ("pole", "did not hold"))
    ]
    return made_up_run.results() | {"findings": findings}


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
    text = render(results(), PICTURES)
    page = Page(text)
    assert page.open == []
    assert not {"script", "link", "iframe"} & {tag for tag, _ in page.tags}
    sources = [attributes[key] for _, attributes in page.tags for key in ("src", "href") if key in attributes]
    assert len(sources) == 4
    assert all(str(source).startswith("data:image/png;base64,") for source in sources)
    assert "url(" not in text
    assert "viewport" in {attributes.get("name") for tag, attributes in page.tags if tag == "meta"}
    assert all(attributes.get("alt") for tag, attributes in page.tags if tag == "img")


def test_the_page_tells_the_numbers() -> None:
    text = Page(render(results(), PICTURES)).text
    for shown in (
        "pretrained 0.412 0.371–0.450",
        "edge + cloud FL 0.511 0.470–0.549",
        "96 test frames of 8 scenes",
        "ideal road detector: an upper bound",
        "wireless 230.0 216.0 214.7",
        "2 · placed 19 of 61 6.2",
        "8 · densest traffic 6 of 61 12.4",
        "320 samples, 6 edge rounds, 3 cloud rounds for 4 + 3 vehicles",
        "Seed 7; 538 s; flcav 0.1.0",
    ):
        assert shown in text


def test_an_interval_that_one_scene_leaves_unknown_is_said() -> None:
    told = results()
    told["stages"][0] = told["stages"][0] | {"ap50_low": None, "ap50_high": None}
    assert "pretrained 0.412 no interval: one scene" in Page(render(told, PICTURES)).text


def test_verdicts_stand_at_their_findings_and_under_the_pictures() -> None:
    text = render(results(), PICTURES)
    page = Page(text).text
    assert "undecided Does cloud help? What cloud did." in page
    assert page.count("What pole did.") == 2
    assert '<span class="badge did-not-hold">did not hold</span>' in text


def test_values_are_escaped() -> None:
    told = results()
    told["findings"][0]["sentence"] = "<script>alert('x')</script> & more"
    text = render(told, {})
    assert "<script" not in text
    assert "&lt;script&gt;" in text


def test_a_picture_that_was_not_made_is_left_out() -> None:
    page = Page(render(results(), {"megabytes": PIXEL}))
    assert [tag for tag, _ in page.tags].count("img") == 1


def test_missing_results_are_not_passed_over() -> None:
    told = results()
    del told["placement"]["covered"]
    with pytest.raises(UndefinedError, match="covered"):
        render(told, PICTURES)

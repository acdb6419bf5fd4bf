"""The report of a run shows its sweep in three dimensions, from its file alone, and a picture where that cannot be."""

import shutil

import pytest
from conftest import CHROMIUM
from test_other_tabs import AXE

from flcav.report.pages.run_page import write_report
from flcav.runs.results.run import Run


@pytest.fixture(scope="module")
def report(recorded_run, tmp_path_factory):
    run = tmp_path_factory.mktemp("report") / "recorded"
    shutil.copytree(recorded_run, run)
    return write_report(Run.load(run), run)


def test_the_sweep_of_a_report_is_drawn_when_it_is_reached(opened, report):
    page = opened("about:blank")
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(report.as_uri())
    assert page.locator(".flcav-sweep canvas").count() == 0 or page.locator(".flcav-sweep").bounding_box()["y"] < 1300
    page.locator(".flcav-sweep").scroll_into_view_if_needed()
    canvas = page.locator(".flcav-sweep canvas")
    canvas.wait_for(timeout=60_000)
    assert "pretrained: 0 found, 2 missed, 0 false" in canvas.get_attribute("aria-label")
    assert page.locator(".sides").inner_text().split("\n")[-1] == "after edge FL 1 found, 1 missed, 1 false"
    assert not page.locator(".flcav-sweep img").is_visible()
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == [report.as_uri()]
    before = canvas.evaluate("canvas => canvas.toDataURL()")
    canvas.focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_function("was => document.querySelector('.flcav-sweep canvas').toDataURL() !== was", arg=before)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_report_fits_a_phone_and_axe_finds_nothing_in_its_sweep(opened, report, scheme):
    if not AXE.exists():
        pytest.skip("no axe-core: npm ci in src/flcav/planner/web")
    page = opened(report.as_uri(), width=390, height=844, color_scheme=scheme)
    page.locator(".flcav-sweep").scroll_into_view_if_needed()
    page.locator(".flcav-sweep canvas").wait_for(timeout=60_000)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.add_script_tag(path=AXE)
    found = page.evaluate("() => axe.run(document.querySelector('.flcav-sweep').parentElement)")["violations"]
    assert [(each["id"], [node["html"][:120] for node in each["nodes"]]) for each in found] == []


def test_without_webgl_the_picture_stays(report, browser):
    bare = browser.browser_type.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
    try:
        page = bare.new_page()
        page.goto(report.as_uri())
        page.locator(".flcav-sweep").scroll_into_view_if_needed()
        page.get_by_text("it has no WebGL").wait_for(timeout=60_000)
        assert page.locator(".flcav-sweep img").is_visible()
        assert page.locator(".keys").is_hidden()
    finally:
        bare.close()

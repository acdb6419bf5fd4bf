"""Three dimensions: the map with sensors that are dragged, and a sweep before and after, also in a page of its own."""

import base64
import json
import re
import subprocess

import numpy as np
import pytest
from conftest import serve
from made_run import FLCAV
from test_place import COVERED, drag, middle_of, placed, seen_from, show, wait_for

from flcav.dataset.store import Dataset
from flcav.planner.replaying import open_run
from flcav.report.scene import SCENE


def solid(opened, address: str, **options):
    page = show(opened, address, **options)
    page.get_by_role("button", name="3D").click()
    page.wait_for_selector(".scene canvas")
    page.wait_for_function("() => document.querySelector('#pole-1')?.style.transform")
    return page


def middle(page, selector: str) -> tuple[float, float]:
    box = page.locator(selector).bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_three_dimensions_are_loaded_when_they_are_wanted(opened, served):
    page = show(opened, served.address)
    assert page.evaluate("typeof flcavScene") == "undefined"
    page.get_by_role("button", name="3D").click()
    page.wait_for_selector(".scene canvas")
    assert page.evaluate("typeof flcavScene") == "object"
    assert "v=3d" in page.url
    other = opened(f"{page.url}&{served.address.partition('#')[2]}")
    other.wait_for_selector(".scene canvas")


def test_what_is_seen_in_three_dimensions_is_what_is_seen_from_above(opened, served, table):
    page = solid(opened, served.address)
    page.locator("#pole-1").click()
    wait_for(page, COVERED, str(seen_from(table, 2)))
    drag(page, middle(page, ".pin.stand"), middle(page, "#pole-4"), steps=15)
    wait_for(page, "#stands", "Pole 5")
    wait_for(page, COVERED, str(seen_from(table, 5)))
    drag(page, middle_of(page, ".kind .chip"), middle(page, "#pole-6"))
    wait_for(page, "#stands", "Pole 7")
    wait_for(page, "#best", "with 2 sensors")
    page.keyboard.press("o")
    wait_for(page, COVERED, str(placed(table, 2)["covered"]))


def test_sensors_move_by_keys_in_three_dimensions(opened, served):
    page = solid(opened, served.address)
    page.locator("#pole-3").focus()
    page.keyboard.press("Enter")
    page.wait_for_function("() => document.activeElement.id.startsWith('stand-')")
    before = page.locator(".pin.stand").get_attribute("data-at")
    page.keyboard.press("ArrowUp")
    wait_for(page, "#stands", "At ")
    after = page.locator(".pin.stand").get_attribute("data-at")
    (x0, y0, _), (x1, y1, _) = (map(float, text.split(",")) for text in (before, after))
    assert (x1 - x0, y1 - y0) == (pytest.approx(0, abs=0.06), pytest.approx(1, abs=0.06))


def test_the_town_is_turned_by_keys(opened, served):
    page = solid(opened, served.address)
    before = page.locator("#pole-0").evaluate("pin => pin.style.transform")
    page.locator(".scene canvas").focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_function("was => document.querySelector('#pole-0').style.transform !== was", arg=before)


def test_a_saved_page_has_three_dimensions_too(opened, table, tmp_path):
    page_file = tmp_path / "grid.html"
    typed = [str(FLCAV), "planner", "grid", "--errors", str(table), "--html", str(page_file)]
    subprocess.run(typed, check=True, capture_output=True)
    assert page_file.stat().st_size < 5_000_000
    page = solid(opened, page_file.as_uri())
    page.locator("#pole-1").click()
    wait_for(page, COVERED, str(seen_from(table, 2)))


def test_a_slope_is_a_slope(opened):
    planner = serve("hilly_suburb")
    try:
        page = solid(opened, planner.address)
        page.locator("#pole-0").click()
        page.locator(".pin.stand").wait_for()
    finally:
        planner.stop()


def test_a_sweep_is_shown_in_any_page(opened, recorded_run, tmp_path):
    desk = open_run(recorded_run)
    assert desk.footage is not None
    data, program = json.dumps(desk.footage.sweep()), SCENE.read_text()
    page_file = tmp_path / "sweep.html"
    page_file.write_text(
        '<!doctype html><meta charset="utf-8"><div class="flcav-sweep" data-from="sweep" style="height: 300px"></div>'
        f'<script type="application/json" id="sweep">{data}</script><script>{program}</script>'
    )
    page = opened(page_file.as_uri())
    page.wait_for_selector(".flcav-sweep canvas")
    told = page.locator(".flcav-sweep canvas").get_attribute("aria-label")
    assert "pretrained: 0 found, 2 missed, 0 false; after edge FL: 1 found, 1 missed, 1 false" in told


def test_points_and_boxes_of_a_sweep_are_those_of_its_frame(opened, recorded_run, recorded):
    page = opened(recorded.address)
    page.locator(".sweep").scroll_into_view_if_needed()
    page.wait_for_selector(".sweep canvas")
    assert re.findall(r"\d+ found, \d+ missed, \d+ false", page.locator(".sides").inner_text()) == [
        "0 found, 2 missed, 0 false",
        "1 found, 1 missed, 1 false",
    ]
    frame = Dataset.open(recorded_run / "work" / "grid-test-objects" / "data").frame(0)
    desk = open_run(recorded_run)
    assert desk.footage is not None
    sent = np.frombuffer(base64.b64decode(str(desk.footage.sweep()["points"])), "<i2").reshape(-1, 3) / 100
    assert np.abs(sent - next(iter(frame.lidar.values()))[:, :3]).max() <= 0.00501

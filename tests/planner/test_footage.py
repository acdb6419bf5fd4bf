"""What a run recorded, in its replay: drives, misses, messages, a sweep and a picture; and a run that is dropped."""

import base64
import json
import re
import shutil

import numpy as np
import pytest
from conftest import serve
from made_run import DEMO
from test_place import wait_for

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.perception.errors import load_errors
from flcav.planner.footage import Footage, find_frame
from flcav.planner.replaying import open_run
from flcav.runs.frames import Frames
from flcav.runs.stages.testing import detect_before_after


@pytest.fixture(scope="module")
def footage(recorded_run) -> Footage:
    found = open_run(recorded_run).footage
    assert found is not None
    return found


def test_vehicles_drive_along_their_recorded_poses(footage, recorded_run):
    drive = footage.drive("grid")
    data = Dataset.open(recorded_run / "work" / "grid-registry-objects" / "data")
    users = {user["name"]: user for user in drive["registry"][0]["users"]}  # type: ignore
    assert drive["registry"][0]["times"] == [0.0, 2.0, 4.0]  # type: ignore
    for i, key in enumerate(data.keys):
        pose = data.world_from_agent(i)
        x, y, yaw, _ = users[key.agent]["path"][key.index]
        assert (x, y) == (pytest.approx(pose[0, 3], abs=0.01), pytest.approx(pose[1, 3], abs=0.01))
        assert np.cos(yaw - np.arctan2(pose[1, 0], pose[0, 0])) == pytest.approx(1, abs=1e-3)


def test_a_miss_pops_up_when_it_was_made(footage):
    drive = footage.drive("grid")
    assert [(error["kind"], error["when"]) for error in drive["errors"]] == [("miss", 4.0)] * 2  # type: ignore
    assert drive["all"] == 2


def test_only_what_the_run_has_is_told(footage):
    for ask in (lambda: footage.drive("ring"), lambda: footage.drive("../grid"), lambda: footage.picture("weather")):
        with pytest.raises(InputError):
            ask()
    bare = open_run(DEMO).footage
    assert bare is not None
    assert bare.shown == {"regions": [], "sweep": False, "pictures": []}
    with pytest.raises(InputError):
        bare.sweep()


def test_the_sweep_of_an_error_is_that_of_the_vehicle_that_made_it(footage, recorded_run):
    data = Dataset.open(recorded_run / "work" / "grid-registry-objects" / "data")
    error = load_errors(footage.errors_of("grid"))[0]
    number = find_frame(Frames.open(recorded_run / "work" / "grid-registry-objects"), error)
    assert number is not None
    frame = data.frame(len(data) - 1)
    assert data.keys[number] == data.keys[len(data) - 1]
    sweep = footage.error_sweep("grid", 0)
    world = frame.world_from_sensor(next(iter(frame.lidar))) @ np.array((*sweep["mark"], 1.0))
    assert world[:3] == pytest.approx((error.x, error.y, error.z), abs=0.02)
    assert sweep["before"]["title"] == "pretrained"  # type: ignore
    assert sweep["before"]["found"] == [False] * len(sweep["targets"])  # type: ignore
    assert sweep["after"]["title"] == "after edge FL"  # type: ignore
    before, after = (recorded_run / "work" / name for name in ("pretrain-objects", "grid-edge-fl-objects"))
    found = detect_before_after(before, after, Frames(data, (number,), {}))
    assert sweep["after"]["found"] == list(found.after.found)  # type: ignore


def test_the_sweep_of_an_error_without_a_distance_is_not_known(footage):
    for ask, told in (
        (lambda: footage.error_sweep("grid", 1), "does not tell in which sweep"),
        (lambda: footage.error_sweep("grid", 2), "grid has 2 errors"),
        (lambda: footage.error_sweep("ring", 0), "no longer has the sweeps"),
    ):
        with pytest.raises(InputError, match=told):
            ask()


def test_labels_of_a_picture_are_those_of_its_frame(footage, recorded_run):
    shot = footage.picture("objects")
    data = Dataset.open(recorded_run / "work" / "grid-test-objects" / "data")
    camera = data.cameras(0)[0]
    visible = [
        np.isfinite(data.frame(i).annotations.views[camera].shown_box).all(axis=1).sum() for i in range(len(data))
    ]
    assert len(shot["labels"]) == max(visible)  # type: ignore
    assert shot["picture"].startswith("data:image/jpeg;base64,")  # type: ignore


def seen(page) -> str:
    """Return what the canvas of the drive shows."""
    return page.evaluate("document.querySelector('canvas.drive').toDataURL()")


def test_a_recorded_run_is_played(opened, recorded):
    page = opened(recorded.address)
    page.wait_for_selector("canvas.drive")
    before = seen(page)
    assert "2 of the 2 errors" in page.locator("canvas.drive").get_attribute("aria-label")
    page.keyboard.press("Space")
    page.wait_for_function("was => document.querySelector('canvas.drive').toDataURL() !== was", arg=before)
    wait_for(page, "#moment", "edge round 1")
    assert "sends the model to cav0, cav1" in page.locator("canvas.drive").get_attribute("aria-label")
    one = seen(page)
    page.wait_for_function("was => document.querySelector('canvas.drive').toDataURL() !== was", arg=one)
    page.keyboard.press("Space")
    page.wait_for_selector(".shot image")
    assert page.locator(".shot .label").count() > 0


def test_the_errors_of_a_recorded_run_are_on_its_map(opened, recorded):
    page = opened(recorded.address)
    page.get_by_role("button", name="Place", exact=True).click()
    page.wait_for_selector(".map svg")
    wait_for(page, "#total", "2")


def test_an_error_opens_its_sweep_by_keys_and_by_a_tap(opened, recorded):
    page = opened(recorded.address, has_touch=True)
    page.get_by_role("button", name="Place", exact=True).click()
    page.wait_for_selector(".map svg")
    one = page.locator("#error-0")
    assert re.match(
        r"Car missed, \d+ m from the vehicle, 20 % hidden, not covered; Enter", one.get_attribute("aria-label")
    )
    one.focus()
    assert "20 %" in page.locator(".tip").inner_text()
    page.keyboard.press("Enter")
    page.wait_for_selector("dialog .sweep canvas", timeout=60_000)  # networks are loaded first
    assert "pretrained: 0 found" in page.locator("dialog canvas").get_attribute("aria-label")
    page.keyboard.press("Escape")
    page.locator("dialog").wait_for(state="detached")
    page.wait_for_function("() => document.activeElement.id === 'error-0'")
    page.keyboard.press("Escape")
    page.locator(".tip").wait_for(state="detached")
    where = page.locator("#error-0").bounding_box()
    page.touchscreen.tap(where["x"] + 6, where["y"] + 6)  # beside it, as fingers do
    page.get_by_role("button", name="Show its sweep").tap()
    page.wait_for_selector("dialog .sweep canvas", timeout=60_000)
    page.get_by_role("button", name="Back to the map").tap()
    page.locator("dialog").wait_for(state="detached")


def test_what_an_earlier_table_does_not_tell_is_unknown(opened, recorded):
    page = opened(recorded.address)
    page.get_by_role("button", name="Place", exact=True).click()
    page.wait_for_selector(".map svg")
    page.locator("#error-1").hover()
    assert "unknown" in page.locator(".tip").inner_text()
    page.locator("#error-1").focus()
    wait_for(page, ".tip", "the table has no distances")
    assert page.get_by_role("button", name="Show its sweep").count() == 0
    page.keyboard.press("Enter")
    assert page.locator("dialog").count() == 0


def test_region_and_moment_of_a_replay_are_in_its_address(opened, recorded_run, tmp_path):
    run = tmp_path / "recorded"
    shutil.copytree(recorded_run, run, symlinks=True)
    shutil.copytree(run / "work" / "grid-registry-objects", run / "work" / "ring-registry-objects")
    planner = serve(run)
    try:
        page = opened(planner.address)
        page.wait_for_selector("canvas.drive")
        page.get_by_role("button", name="ring", exact=True).click()
        for _ in range(3):
            page.keyboard.press("ArrowRight")
        wait_for(page, "#moment", "edge round 3")
        page.wait_for_function("() => location.hash.includes('r=ring&m=3')")
        assert len(page.url) < 2000
        assert "token" not in page.url
        other = opened(f"{page.url}&{planner.address.partition('#')[2]}")
        wait_for(other, "#moment", "edge round 3")
        assert other.get_by_role("button", name="ring", exact=True).get_attribute("aria-pressed") == "true"
        other.wait_for_function("() => location.hash.includes('tab=replay') && location.hash.includes('r=ring&m=3')")
    finally:
        planner.stop()


def pack(folder, *names: str) -> dict[str, str]:
    return {name: base64.b64encode((folder / name).read_bytes()).decode() for name in names}


# As the browser hands over a folder that was dropped: entries, of which the page reads what it needs.
DROP = """files => {
    const bytes = text => Uint8Array.from(atob(text), sign => sign.charCodeAt(0));
    const asFile = (name, text) => ({isFile: true, name, file: done => done(new File([bytes(text)], name))});
    const asFolder = (name, tree) => ({isDirectory: true, name, createReader: () => {
        let left = Object.entries(tree).map(([each, inner]) => asEntry(each, inner));
        return {readEntries: done => { const now = left; left = []; done(now); }};
    }});
    const asEntry = (name, tree) => (typeof tree === 'string' ? asFile : asFolder)(name, tree);
    const root = {};
    for (const [path, text] of Object.entries(files)) {
        const parts = path.split('/');
        let at = root;
        for (const part of parts.slice(0, -1)) at = at[part] ??= {};
        at[parts.at(-1)] = text;
    }
    const event = new Event('drop', {cancelable: true});
    event.dataTransfer = {items: [{webkitGetAsEntry: () => asFolder('recorded', root)}], files: []};
    window.dispatchEvent(event);
}"""


def test_a_runs_folder_is_opened_in_the_page(opened, recorded_run):
    planner = serve()
    try:
        page = opened(planner.address)
        page.locator(".card").first.wait_for()
        small = ["results.json", "work/grid-errors-objects/errors.parquet"]
        names = [*small, "work/grid-registry-objects/data/manifest.json"]
        with page.expect_request("**/api/drop-run") as asked:
            page.evaluate(DROP, pack(recorded_run, *names))
        assert sorted(json.loads(asked.value.post_data)["files"]) == small
        page.locator("#gained").wait_for(timeout=60_000)  # what reads a run is loaded first
        wait_for(page, ".bar-alert", "flcav planner recorded")
        page.get_by_role("button", name="Place", exact=True).click()
        wait_for(page, "#total", "2")
        page.evaluate(DROP, {"notes.txt": ""})
        wait_for(page, ".alert", "no folder of a finished run")
    finally:
        planner.stop()

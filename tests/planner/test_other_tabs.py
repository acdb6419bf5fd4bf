"""The tabs Plan and Replay, accessibility by axe, and whether the bundle is that of its sources."""

import json
import os
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import PROBLEM
from made_run import DEMO
from test_place import wait_for

import flcav.planner
from flcav.optimization.graph import load_problem
from flcav.planner.planning import plan_budgets, with_budgets
from flcav.planner.server import ASSETS
from flcav.report.scene import SCENE

WEB = Path(flcav.planner.__file__).parent / "web"
AXE = WEB / "node_modules" / "axe-core" / "axe.min.js"


def test_a_plan_follows_its_sliders(opened, plan):
    page = opened(plan.address)
    told = plan_budgets(load_problem(PROBLEM))
    wait_for(page, "#objective", f"{told['objective']:#.2g}")
    page.get_by_label("Wireless in MB").fill("3000")
    page.get_by_label("Wireless in MB").press("Enter")
    page.get_by_label("Wireline in MB").fill("5000")
    page.get_by_label("Wireline in MB").press("Enter")
    less = plan_budgets(with_budgets(load_problem(PROBLEM), 3000, 5000, None))
    wait_for(page, ".task table", f"samples{less['tasks'][0]['samples']}")  # type: ignore
    assert page.locator(".task tbody tr").first.inner_text().split()[1] == str(less["tasks"][0]["samples"])  # type: ignore
    wait_for(page, ".plan .panel", "10 % more wireless (+300 MB)")
    assert "b=3000,5000" in page.url
    times = page.evaluate("performance.getEntriesByName('plan').map(each => each.duration)")
    print(f"plan: median {sorted(times)[len(times) // 2]:.0f} ms of {len(times)}")


def test_budgets_that_allow_no_plan_are_told(opened, plan):
    page = opened(plan.address)
    page.get_by_label("Wireless in MB").fill("10")
    page.get_by_label("Wireless in MB").press("Enter")
    wait_for(page, ".sheet", "No plan fits")


def test_a_run_is_played_by_keys_and_names_the_round_that_gained_most(opened, replay):
    page = opened(replay.address)
    results = json.loads((DEMO / "results.json").read_text())
    scores = {
        (watched["stage"], each["round"], watched["region"]): each["score"]
        for watched in results["watched"]
        for each in watched["rounds"]
    }
    moments = [("pretrain", 0), *(("edge", number) for number in range(1, 11)), ("cloud", 1)]
    means = [sum(scores[(*moment, region)] for region in ("grid", "ring")) / 2 for moment in moments]
    gains = [after - before for before, after in pairwise(means)]
    best = moments[1 + gains.index(max(gains))]
    wait_for(page, "#gained", f"{best[0]} round {best[1]} gained most: +{max(gains):.3f}")
    page.keyboard.press("ArrowRight")
    wait_for(page, "#moment", "edge round 1")
    page.keyboard.press("Space")
    wait_for(page, "#moment", "cloud round 1")
    used = results["arms"]["main"]["links"]["wireless"]["used_mb"]
    wait_for(page, ".replay .panel", f"{used:.1f} of 60 MB")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390])
@pytest.mark.parametrize("tab", ["place", "solid", "plan", "replay", "recorded"])
def test_axe_finds_no_violation(opened, served, plan, replay, recorded, tab, width, scheme):
    if not AXE.exists():
        pytest.skip("no axe-core: npm ci in src/flcav/planner/web")
    planner = {"place": served, "solid": served, "plan": plan, "replay": replay, "recorded": recorded}[tab]
    page = opened(planner.address, width=width, color_scheme=scheme, bypass_csp=True)
    if tab == "place":
        page.locator("#pole-1").click()
        wait_for(page, "#best", "with 1 sensor")
    if tab == "solid":
        page.get_by_role("button", name="3D").click()
    if tab == "recorded":
        page.locator(".sweep").scroll_into_view_if_needed()
        page.wait_for_selector(".shot")
    shown = {
        "place": ".step",
        "solid": ".scene canvas",
        "plan": ".task",
        "replay": ".scores",
        "recorded": ".sweep canvas",
    }
    page.wait_for_selector(shown[tab])
    page.add_script_tag(path=AXE)
    found = page.evaluate("() => axe.run()")["violations"]
    assert [
        (each["id"], [node["html"][:120] + node["failureSummary"][:200] for node in each["nodes"]]) for each in found
    ] == []


def test_the_bundle_is_that_of_its_sources(tmp_path):
    if not (WEB / "node_modules").exists() or shutil.which("npm") is None:
        pytest.skip("no esbuild: npm ci in src/flcav/planner/web")
    subprocess.run(["npm", "run", "-s", "bundle"], cwd=WEB, check=True, env={**os.environ, "OUT": str(tmp_path)})
    for path in (ASSETS / "planner.js", SCENE):
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()

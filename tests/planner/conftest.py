"""The planner in a browser: Debian's Chromium, driven by Playwright; without either, every test is skipped by name."""

import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_run import DEMO, FLCAV, make_run

from flcav.world.map.town import load_town

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SOFTWARE_GL = "--enable-unsafe-swiftshader"  # three dimensions without a GPU; pages are drawn as without it
PROBLEM = Path(__file__).parents[2] / "recipes" / "allocation" / "objects.yaml"


@dataclass
class Served:
    """A planner that is served, and where."""

    process: subprocess.Popen[str]
    address: str

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(timeout=20)


def serve(*arguments: object) -> Served:
    typed = [str(FLCAV), "planner", *map(str, arguments)]
    process = subprocess.Popen(typed, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/#token=[\w-]+", line), line
    return Served(process, line)


def write_errors(path: Path, count: int) -> Path:
    """Write errors along the streets of the grid, reproducibly."""
    rng, roads = np.random.default_rng(2), load_town("grid").roads
    lines = ["x,y,z,weight,kind,class,returns,occlusion,scene,track"]
    for number in range(count):
        road = roads[rng.integers(len(roads))]
        x, y = np.mean(road[rng.integers(len(road), size=2)], axis=0)
        kind, label = ("miss", "false_positive")[number % 5 == 0], ("Car", "Pedestrian")[number % 3 == 0]
        lines.append(f"{x:.2f},{y:.2f},0.8,1,{kind},{label},12,0.3,grid-0-000,t{number}")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def table(tmp_path_factory) -> Path:
    """113 errors along the streets of the grid."""
    return write_errors(tmp_path_factory.mktemp("planner") / "errors.csv", 113)


@pytest.fixture(scope="session")
def served(table) -> Iterator[Served]:
    planner = serve("grid", "--errors", table)
    yield planner
    planner.stop()


@pytest.fixture(scope="session")
def plan() -> Iterator[Served]:
    planner = serve(PROBLEM)
    yield planner
    planner.stop()


@pytest.fixture(scope="session")
def replay() -> Iterator[Served]:
    planner = serve(DEMO)
    yield planner
    planner.stop()


@pytest.fixture(scope="session")
def recorded_run(tmp_path_factory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="session")
def recorded(recorded_run) -> Iterator[Served]:
    planner = serve(recorded_run)
    yield planner
    planner.stop()


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install playwright")
    if CHROMIUM is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", SOFTWARE_GL])
        yield found
        found.close()


@pytest.fixture
def opened(browser) -> Iterator[Any]:
    """Return a function that opens an address in a window of its own, and check that no page had an error."""
    contexts, faults = [], []

    def show(address: str, width: int = 1440, height: int = 900, **options: object) -> Any:
        context = browser.new_context(viewport={"width": width, "height": height}, accept_downloads=True, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda asked: faults.append(asked.url) if _is_foreign(asked.url) else None)
        page.goto(address)
        return page

    yield show
    for context in contexts:
        context.close()
    assert faults == []


def _is_foreign(address: str) -> bool:
    return not address.startswith(("http://127.0.0.1:", "data:", "blob:", "file:"))

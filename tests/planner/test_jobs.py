"""Ten jobs that strangers bring to the planner, each done through the page alone, by pointer and again by keyboard.

What is printed is how long the machine took, from the open page to the answer: a person also reads and thinks.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from conftest import Served, serve
from test_place import wait_for

MAP = Path(__file__).parents[2] / "recipes" / "maps" / "quarter.xodr"
ACCIDENTS = "date;latitude;longitude\n2026-03-02;49,00012;8,39931\n2026-03-19;49,00021;8,39922\n"
LISTENING_MS = 300  # until the browser tells of file dialogues: one that opens before stays open, and blocks the next
MOST_TABS = 120  # presses of Tab until what is wanted has the focus


@dataclass
class Pointer:
    """A user with a mouse."""

    page: Any

    def press(self, target: Any) -> None:
        target.click()

    def fill(self, target: Any, text: str) -> None:
        target.click(click_count=3)
        self.page.keyboard.type(text)
        self.page.keyboard.press("Enter")

    def choose(self, target: Any, file: Path) -> None:
        with self.page.expect_file_chooser() as dialogue:
            self.page.wait_for_timeout(LISTENING_MS)
            target.locator("xpath=..").click()
        dialogue.value.set_files(file)


@dataclass
class Keys:
    """A user without one: Tab goes to what is wanted, Enter or Space press it."""

    page: Any

    def reach(self, target: Any) -> None:
        target.wait_for(state="attached")
        wanted = target.element_handle()
        for _ in range(MOST_TABS):
            if wanted.evaluate("wanted => wanted === document.activeElement"):
                return
            self.page.keyboard.press("Tab")
        raise AssertionError(f"{target} is not reached by Tab")

    def press(self, target: Any) -> None:
        self.reach(target)
        self.page.keyboard.press("Enter")

    def fill(self, target: Any, text: str) -> None:
        self.reach(target)
        self.page.keyboard.press("Control+a")
        self.page.keyboard.type(text)
        self.page.keyboard.press("Enter")

    def choose(self, target: Any, file: Path) -> None:
        self.reach(target)
        with self.page.expect_file_chooser() as dialogue:
            self.page.wait_for_timeout(LISTENING_MS)
            self.page.keyboard.press("Enter")
        dialogue.value.set_files(file)


Hand = Pointer | Keys


def number(page: Any, selector: str) -> int:
    return int(page.locator(selector).inner_text())


def show_best_three(page: Any, hand: Hand) -> None:
    hand.fill(page.get_by_label("The best with"), "3")
    wait_for_optimum(page, 3)


def wait_for_optimum(page: Any, sensors: int) -> None:
    """Wait until so many sensors stand, and as much is covered as they can."""
    wait_for(page, "#best", f"with {sensors} sensors")
    page.wait_for_function(
        """() => document.querySelector("#best").innerText.split(":")[1].match(/\\d+/)[0]
            === document.querySelector("#covered").innerText"""
    )


def three_sensors_within_a_price(page: Any, hand: Hand) -> str:
    hand.fill(page.get_by_label("Price of sensor"), "1200")
    hand.fill(page.get_by_label("The best for a cost of"), "3600")
    wait_for(page, "#cost", "3600")
    wait_for(page, "#best", "proven")
    assert page.locator(".stand:not(.legend *)").count() == 3
    return f"{number(page, '#covered')} errors for 3600"


def the_value_of_a_fourth(page: Any, hand: Hand) -> str:
    show_best_three(page, hand)
    three = number(page, "#covered")
    wait_for(page, "#next", "With one more")
    told = page.locator("#next").inner_text()
    hand.press(page.locator(".step").nth(3))
    wait_for_optimum(page, 4)
    assert f"+{number(page, '#covered') - three}" in told
    return told


def own_accidents(page: Any, hand: Hand) -> str:
    hand.choose(page.locator("header .file input"), ACCIDENTS_FILE[0])
    wait_for(page, "#total", "2")
    hand.press(page.locator("#pole-0"))
    wait_for(page, "#best", "with 1 sensor")
    return page.locator("#best").inner_text()


def an_own_map(page: Any, hand: Hand) -> str:
    pytest.importorskip("sumolib", reason="no netconvert: pip install flcav[towns]")
    hand.choose(page.locator("header .file input"), MAP)
    page.wait_for_selector(".map svg[aria-label='Map of quarter']", timeout=120_000)
    hand.press(page.locator("#pole-0"))
    page.locator(".reach path").first.wait_for(state="attached")
    return f"{page.locator('.pole:not(.legend *)').count() + 1} candidate places"


def where_a_new_pole_pays(page: Any, hand: Hand) -> str:
    show_best_three(page, hand)
    before = number(page, "#covered")
    hand.press(page.get_by_role("button", name="Find the place"))
    found = page.locator(".stands li", has_text="Stand one there").first
    told = found.locator(".pick").inner_text()
    gain = int(re.findall(r"\+(\d+)", told)[0])
    hand.press(found.get_by_role("button"))
    wait_for(page, "#covered", str(before + gain))
    return " ".join(told.split())


def a_plan_for_three_and_five_gigabytes(page: Any, hand: Hand) -> str:
    hand.fill(page.get_by_label("Wireless in MB"), "3000")
    hand.fill(page.get_by_label("Wireline in MB"), "5000")
    page.wait_for_function("() => location.hash.includes('b=3000,5000')")
    page.wait_for_selector(".sheet[aria-busy=false]")
    rows = page.locator(".task tbody tr")
    return ", ".join(" ".join(rows.nth(row).inner_text().split()[:-1]) for row in range(3))


def what_a_tenth_more_buys(page: Any, hand: Hand) -> str:
    wait_for(page, ".plan .panel", "10 % more wireless")
    wait_for(page, ".plan .panel", "10 % more wireline")
    return page.locator(".plan .facts li").first.inner_text()


def the_round_that_gained_most(page: Any, hand: Hand) -> str:
    hand.press(page.get_by_role("button", name="Play"))
    wait_for(page, "#moment", "edge round 1")
    page.wait_for_function("() => document.querySelector('#moment').textContent === 'cloud round 1'", timeout=60_000)
    return page.locator("#gained").inner_text()


def a_state_for_a_colleague(page: Any, hand: Hand) -> str:
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    show_best_three(page, hand)
    covered = page.locator("#covered").inner_text()
    hand.press(page.get_by_role("button", name="Copy link"))
    wait_for(page, "p.said", "The link is copied")
    sent = page.evaluate("navigator.clipboard.readText()")
    assert "token" not in sent
    colleague = page.context.new_page()
    base, _, token = COLLEAGUE[0].address.partition("#")
    colleague.goto(f"{base}#{sent.partition('#')[2]}&{token}")
    wait_for(colleague, "#best", "with 3 sensors")
    wait_for(colleague, "#covered", covered)
    assert colleague.url.partition("#")[2] == sent.partition("#")[2]
    return f"{len(sent)} characters"


ACCIDENTS_FILE: list[Path] = []
COLLEAGUE: list[Served] = []
Job = Callable[[Any, Hand], str]
JOBS: dict[Job, str] = {
    three_sensors_within_a_price: "served",
    the_value_of_a_fourth: "served",
    own_accidents: "served",
    an_own_map: "served",
    where_a_new_pole_pays: "served",
    a_plan_for_three_and_five_gigabytes: "plan",
    what_a_tenth_more_buys: "plan",
    the_round_that_gained_most: "replay",
    a_state_for_a_colleague: "served",
}


@pytest.fixture(scope="module")
def colleague(table, tmp_path_factory):
    """A second planner with the same table, and a file of accidents."""
    ACCIDENTS_FILE.append(tmp_path_factory.mktemp("own") / "accidents.csv")
    ACCIDENTS_FILE[-1].write_text(ACCIDENTS)
    COLLEAGUE.append(serve("grid", "--errors", table))
    yield
    COLLEAGUE.pop().stop()


@pytest.mark.parametrize("hand", [Pointer, Keys], ids=["pointer", "keyboard"])
def test_jobs_of_strangers_are_done_in_the_page(opened, colleague, request, hand):
    """The tenth job is all nine by keyboard alone."""
    total = 0.0
    for job, planner in JOBS.items():
        page = opened(request.getfixturevalue(planner).address)
        page.wait_for_selector({"served": ".map svg", "plan": ".task", "replay": ".scores"}[planner])
        start = time.perf_counter()
        told = job(page, hand(page))
        taken = time.perf_counter() - start
        total += taken
        print(f"{hand.__name__.lower()}: {job.__name__.replace('_', ' ')}: {taken:.1f} s of the machine: {told}")
    print(f"{hand.__name__.lower()}: {len(JOBS)} jobs in {total:.0f} s of the machine")

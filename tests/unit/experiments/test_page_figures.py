"""Figures in the sentences of pages are those of the committed results: `reproductions/figures.yaml` ties them.

Each entry has a part of a sentence as it stands on a page (`says`), the file of results that it is `of`, and what each
number in it `is`, a line for each: an expression of the results, rounded here to the digits that the page shows, or _
for a number that is a setting. What words claim (below, one in seven) `holds` by further expressions. Decimals in
sentences that no entry ties are counted by page as `untied`, and may only become fewer.
"""

import re
from collections.abc import Iterator, Mapping
from decimal import Decimal
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from flcav.config import Json, read_json
from flcav.runs.results.run import Run, Summary
from flcav.runs.spread import read_spreads, widen_anew

ROOT = Path(__file__).parents[3]
TIES: Mapping[str, Any] = yaml.safe_load((ROOT / "reproductions" / "figures.yaml").read_text(encoding="utf-8"))
PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]
PAGES += sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "reproductions").rglob("README.md"))
GENERATED = {"docs/commands.md", "docs/recipes.md"}
NUMBER = re.compile(r"(?<!\w)[−+-]?(?:\d+(?:,\d{3})+|\d*\.?\d+)(?: %)?")
DECIMAL = re.compile(r"(?<![\w.,])[−+-]?\d*\.\d+(?![\w.]*\w)")
NO_SENTENCE = re.compile(
    r"^```.*?^```$|<!-- [a-z ]+ -->\n.*?<!-- end -->|^\|.*?$|^#.*?$|^    .*?$|!\[.*?\]\(.*?\)", re.M | re.S
)
MARKUP = re.compile(r"\[([^]]*)\]\([^)]*\)|[`*]")
NAMES = {"abs": abs, "all": all, "any": any, "len": len, "max": max, "min": min, "mean": np.mean, "sd": np.std,
         "round": round, "sum": sum}  # fmt: skip


class Held(SimpleNamespace):
    """A JSON object whose values are had by name or by key."""

    def __getitem__(self, key: str) -> Any:
        return vars(self)[key]

    def values(self) -> list[Any]:
        return list(vars(self).values())


def hold(value: Json) -> Any:
    if isinstance(value, Mapping):
        return Held(**{key: hold(each) for key, each in value.items()})
    return [hold(each) for each in value] if isinstance(value, list) else value


@cache
def names_of(file: str) -> Mapping[str, Any]:
    """Return what expressions know: the results `r`, and of a run its tests and differences by stage and region."""
    path = ROOT / "reproductions" / file
    if not file.startswith("runs/") or path.name == Summary.file:
        return {**NAMES, "r": hold(read_json(path))}
    run = Run.load(path.parent, path.name)
    if run.recipe.spread is not None and not run.recipe.retrainings:
        run = widen_anew(run, read_spreads(run.recipe.spread, Path()))

    def test(stage: str, region: str, task: str = "objects", arm: str = "main") -> Any:
        return next(t for t in run.tested if (t.stage, t.region, t.task, t.arm) == (stage, region, task, arm))

    def change(after: str, before: str, region: str, task: str = "objects", arm: str = "main", of: str = "") -> Any:
        key = (after, before, region, task, arm, of or arm)
        return next(
            d for d in run.differences if (d.stage, d.before_stage, d.region, d.task, d.arm, d.before_arm) == key
        )

    def place(region: str) -> Any:
        return next(placed for placed in run.arms["main"].placed if placed.region == region)

    return {**NAMES, "r": run, "test": test, "change": change, "place": place, "mb": run.arms["main"].links}


def compute(expression: str, file: str) -> Any:
    return eval(expression, {"__builtins__": {}, **names_of(file)})


def sentences(page: str) -> str:
    """Return the sentences of a page in one line: without tables, code, headings, pictures and marks of Markdown."""
    text = NO_SENTENCE.sub(" ", (ROOT / page).read_text(encoding="utf-8"))
    return " ".join(MARKUP.sub(lambda link: link[1] or "", text).split())


def shown(number: str, value: float) -> Decimal:
    """Return `value` with the digits of `number`, as a page shows it."""
    digits = number.removesuffix(" %").partition(".")[2]
    return Decimal(f"{100 * value if number.endswith('%') else value:.{len(digits)}f}")


def read(number: str) -> Decimal:
    return Decimal(number.removesuffix(" %").replace("−", "-").replace(",", ""))


def entries() -> Iterator[Any]:
    for page, own in TIES.items():
        for number, entry in enumerate(own.get("figures", ())):
            yield pytest.param(page, entry, id=f"{page}-{number}")


@pytest.mark.parametrize(("page", "entry"), [*entries()])
def test_sentences_say_what_the_results_hold(page: str, entry: Mapping[str, Any]) -> None:
    says = " ".join(entry["says"].split())
    assert says in sentences(page), f"{page} no longer says this: change or remove the entry in figures.yaml"
    numbers = NUMBER.findall(says)
    values = entry.get("is", "").splitlines()
    assert len(numbers) == len(values), f"{numbers} are {len(numbers)} numbers, for {len(values)} expressions"
    for number, expression in zip(numbers, values, strict=True):
        if expression != "_":
            value = float(compute(expression, entry["of"]))
            assert read(number) == shown(number, value), f"{expression} is {value}, and {page} says {number}"
    for claim in entry.get("holds", "").splitlines():
        assert compute(claim, entry["of"]), f"{claim} does not hold, and {page} says: {says}"


def count_untied(page: str) -> int:
    """Return how many decimals in a page's sentences no entry ties."""
    text = sentences(page)
    for entry in TIES.get(page, {}).get("figures", ()):
        text = text.replace(" ".join(entry["says"].split()), " ")
    return len(DECIMAL.findall(text))


def test_figures_without_results_become_fewer() -> None:
    found = {page: count_untied(page) for page in PAGES if page not in GENERATED}
    listed = {page: own["untied"] for page, own in TIES.items()}
    new = {page: count for page, count in found.items() if count > listed.get(page, 0)}
    assert new == {}, "tie these pages' new figures to results in figures.yaml"
    fewer = {page: count for page, count in listed.items() if count > found.get(page, 0)}
    assert fewer == {}, f"these are tied: lower `untied` to { ({page: found.get(page, 0) for page in fewer}) }"


def test_an_edited_figure_and_a_changed_result_are_seen() -> None:
    assert read("−0.03") == shown("−0.03", -0.0310)
    assert read(".28") != shown(".28", 0.2745)
    assert read("1,000") == shown("1,000", 1000.4)
    assert read("12 %") == shown("12 %", 0.1184)
    assert read("+0.059") == shown("+0.059", 0.05871)

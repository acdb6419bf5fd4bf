"""The tables on the page of the weather task's study, from its numbers."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flcav.markdown import bullets, interval, table
from flcav.verdicts import aim_sentence

WANTED = 0.95  # accuracy


def tables(results: Mapping[str, Any]) -> dict[str, str]:
    """Return Markdown by name: findings, accuracy, recall, seeds."""
    return {
        "findings": bullets(_findings(results)),
        "accuracy": _accuracy(results),
        "recall": _recall(results),
        "seeds": _seeds(results),
    }


def _findings(results: Mapping[str, Any]) -> list[str]:
    said = []
    for test, numbers in results["summary"].items():
        for name, mean in numbers.items():
            where = "within the classes' regions" if name == "accuracy" else "by the nearest class, everywhere"
            aim = f"Accuracy of {WANTED} on {test}, {where}"
            said.append(aim_sentence(aim, WANTED, mean, len(results["seeds"])) + ".")
    return said


def _accuracy(results: Mapping[str, Any]) -> str:
    rows = []
    for test, numbers in results["summary"].items():
        tested = [seed["tests"][test] for seed in results["seeds"]]
        for name, mean in numbers.items():
            each = [result if name == "accuracy" else result["nearest"] for result in tested]
            over_scenes = ", ".join(f"{one['accuracy']:.3f} ({one['low']:.3f} to {one['high']:.3f})" for one in each)
            what = "within the regions" if name == "accuracy" else "everywhere, nearest class"
            rows.append([test, what, each[0]["pictures"], each[0]["scenes"], interval(mean), over_scenes])
    header = ("test", "pictures", "number", "scenes", "accuracy, over seeds", "each seed, over its scenes")
    return table(header, rows)


def _recall(results: Mapping[str, Any]) -> str:
    tests = [test for test in results["summary"] if "nearest" not in results["seeds"][0]["tests"][test]]
    classes = results["seeds"][0]["tests"][tests[0]]["classes"]
    rows = []
    for number, name in enumerate(classes):
        cells = []
        for test in tests:
            matrix = np.sum([seed["tests"][test]["confusion"] for seed in results["seeds"]], axis=0)[number]
            others = {classes[i]: int(matrix[i]) for i in np.argsort(-matrix, kind="stable") if i != number}
            taken = ", ".join(f"{other} {count}" for other, count in others.items() if count)
            cells.append(f"{matrix[number] / matrix.sum():.3f}" + (f" ({taken})" if taken else ""))
        rows.append([name, *cells])
    return table(("class", *(f"recall, {test} (taken for)" for test in tests)), rows)


def _seeds(results: Mapping[str, Any]) -> str:
    rows = [
        [seed["seed"], card["samples"], card["training"]["steps"], f"{card['metrics']['accuracy']:.3f}"]
        for seed in results["seeds"]
        for card in [seed["card"]]
    ]
    return table(("seed", "training pictures", "steps", "accuracy on validation"), rows)

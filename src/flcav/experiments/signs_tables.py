"""The tables on the page of the sign task's study."""

from collections.abc import Mapping
from typing import Any

from flcav.experiments.task_study import training_rows
from flcav.markdown import bullets, table
from flcav.verdicts import aim_sentence

WANTED = 0.75  # mAP50 on scenes that were not learned from


def tables(results: Mapping[str, Any]) -> dict[str, str]:
    """Return the page's tables by name, from what `run_study` returned."""
    return {
        "findings": bullets(_findings(results)),
        "classes": table(("class", *_heads(results)), _rows(results, "classes", "ap50")),
        "sizes": table(("root of the box's area", *_heads(results)), _rows(results, "sizes", "map50")),
        "training": table(
            ("seed", "pictures", "steps", "validation mAP50 after each epoch; the network of the best is kept"),
            training_rows(results),
        ),
    }


def name_of(part: Mapping[str, Any]) -> str:
    """Return what a row of `classes` or of `sizes` is about."""
    if "class" in part:
        return part["class"].replace("_", " ")
    return f"{part['from_px']:g} px on" if part["to_px"] is None else f"{part['from_px']:g} to {part['to_px']:g} px"


def _findings(results: Mapping[str, Any]) -> list[str]:
    seeds = len(results["seeds"])
    said = []
    for test, means in results["summary"].items():
        aim = aim_sentence(f"mAP50 of {WANTED} on {test}", WANTED, means["mAP50"], seeds)
        said.append(f"{aim}; mAP50-95 {means['mAP50-95']['mean']:.3f}.")
    return said


def _heads(results: Mapping[str, Any]) -> list[str]:
    return [head for test in results["summary"] for head in (f"{test}: to find", "AP50")]


def _rows(results: Mapping[str, Any], part: str, measure: str) -> list[list[str]]:
    rows = []
    for number, named in enumerate(_tested(results, next(iter(results["summary"])))[0][part]):
        row = [name_of(named)]
        for test in results["summary"]:
            of_seeds = [tested[part][number] for tested in _tested(results, test)]
            known = [one[measure] for one in of_seeds if one[measure] is not None]
            row += [str(of_seeds[0]["targets"]), f"{sum(known) / len(known):.3f}" if known else ""]
        rows.append(row)
    return rows


def _tested(results: Mapping[str, Any], test: str) -> list[Mapping[str, Any]]:
    return [seed["tests"][test] for seed in results["seeds"]]

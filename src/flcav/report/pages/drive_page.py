"""HTML page of closed-loop drives: measures with intervals, a table of the drives, and their films."""

import json
from collections.abc import Sequence
from typing import Any

import pyarrow as pa
from markupsafe import Markup

from flcav.driving.film import Film
from flcav.driving.measures import DriveResult, describe_drives, describe_standing
from flcav.driving.studies.importance import MEASURES, mean_measure
from flcav.interface.wording import plural
from flcav.report.pages import html

STOOD = "time it stood [s]"


def drive_page(perceives: str, drives: Sequence[DriveResult], films: Sequence[Film]) -> str:
    """Return the page as self-contained HTML; `perceives` describes the perception."""
    several = len({drive.scenario for drive in drives}) > 1
    counted = len({drive.scenario if several else drive.seed for drive in drives})
    means = [{"name": words, "value": mean_measure(drives, name).describe()} for name, words in MEASURES.items()]
    means.append({"name": STOOD, "value": mean_measure(drives, "stood_in_all_s").describe()})
    values = {
        "title": plural(len(drives), "closed-loop drive"),
        "perceives": perceives[:1].upper() + perceives[1:],
        "summary": describe_drives(drives),
        "over": plural(counted, "scenario" if several else "seed") + ("" if counted > 1 else ", which gives none"),
        "means": means,
        "drives": [_describe(drive) for drive in drives],
        "films": [{"name": f"{film.scenario}, seed {film.seed}"} for film in films],
        "data": Markup(json.dumps([film.as_json() for film in films], allow_nan=False).replace("</", "<\\/")),
    }
    return html.render(values, {}, "drive.html.j2")


def _describe(drive: DriveResult) -> dict[str, Any]:
    return {
        "scenario": drive.scenario,
        "seed": drive.seed,
        "progress": f"{drive.progress:.2f}",
        "speed": f"{drive.mean_speed:.1f}",
        "ttc": f"{drive.least_ttc_s:.2f}",
        "hard": drive.hard_brakes,
        "reds": drive.red_lights,
        "hits": ", ".join(f"{hit.other}{'' if hit.at_fault else ' (not at fault)'}" for hit in drive.hits) or "none",
        "score": drive.describe_score(),
        "stood": describe_standing(drive.stood_s, drive.time_s).removeprefix("; stood ") or "-",
    }


def tabulate_drives(drives: Sequence[DriveResult]) -> pa.Table:
    """Return a table with a row per drive: its measures, and the cause of its longest standstill."""
    rows = [
        {
            "scenario": drive.scenario,
            "seed": drive.seed,
            "time_s": drive.time_s,
            **{name: getattr(drive, name) for name in MEASURES},
            "mean_speed": drive.mean_speed,
            "other_collisions": len(drive.hits) - drive.faults,
            "stood_s": drive.stood_in_all_s,
            "stood_before": next(iter(drive.stood_s), ""),
        }
        for drive in drives
    ]
    return pa.Table.from_pylist(rows)

"""The HTML page about closed-loop drives: measures with intervals, a table of the drives, and their film."""

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
    """Return the page as self-contained HTML; `perceives` says what drove."""
    several = len({own.scenario for own in drives}) > 1
    counted = len({own.scenario if several else own.seed for own in drives})
    means = [{"name": words, "value": mean_measure(drives, name).describe()} for name, words in MEASURES.items()]
    means.append({"name": STOOD, "value": mean_measure(drives, "stood_in_all_s").describe()})
    values = {
        "title": plural(len(drives), "closed-loop drive"),
        "perceives": perceives[:1].upper() + perceives[1:],
        "summary": describe_drives(drives),
        "over": plural(counted, "scenario" if several else "seed") + ("" if counted > 1 else ", which gives none"),
        "means": means,
        "drives": [_tell(own) for own in drives],
        "films": [{"name": f"{film.scenario}, seed {film.seed}"} for film in films],
        "data": Markup(json.dumps([film.as_json() for film in films], allow_nan=False).replace("</", "<\\/")),
    }
    return html.render(values, {}, "drive.html.j2")


def _tell(own: DriveResult) -> dict[str, Any]:
    return {
        "scenario": own.scenario,
        "seed": own.seed,
        "progress": f"{own.progress:.2f}",
        "speed": f"{own.mean_speed:.1f}",
        "ttc": f"{own.least_ttc_s:.2f}",
        "hard": own.hard_brakes,
        "reds": own.red_lights,
        "hits": ", ".join(f"{each.other}{'' if each.at_fault else ' (not at fault)'}" for each in own.hits) or "none",
        "score": own.describe_score(),
        "stood": describe_standing(own.stood_s, own.time_s).removeprefix("; stood ") or "-",
    }


def tabulate_drives(drives: Sequence[DriveResult]) -> pa.Table:
    """Return a row for each drive, with a column for each measure and the longest standing."""
    rows = [
        {
            "scenario": own.scenario,
            "seed": own.seed,
            "time_s": own.time_s,
            **{name: getattr(own, name) for name in MEASURES},
            "mean_speed": own.mean_speed,
            "other_collisions": len(own.hits) - own.faults,
            "stood_s": own.stood_in_all_s,
            "stood_before": next(iter(own.stood_s), ""),
        }
        for own in drives
    ]
    return pa.Table.from_pylist(rows)

"""A placement as files of others: CSV, GeoJSON, a run recipe, and the command that finds it."""

import csv
import io
import json
from collections.abc import Sequence
from shlex import quote

from flcav.config import InputError, Json
from flcav.planner.placing import Question, Workspace, mount
from flcav.world.sites import locate_sites


def export_placement(space: Workspace, question: Question, pairs: Sequence[tuple[int, int]]) -> dict[str, Json]:
    """Return the texts of a placement by ending; `pairs` are of a site, own ones after the poles, and a kind.

    Raises `InputError` where a pair names a site or a kind that is not there.
    """
    own, poles = mount(space, question.own), len(space.sites.ids)
    for site, kind in pairs:
        if site >= poles + len(own) or kind >= len(question.kinds.names):
            raise InputError(f"pairs: there is no site {site} with a kind {kind}")
    places = [own[site - poles] if site >= poles else space.sites.xyz[site] for site, _ in pairs]
    names = [f"own {site - poles + 1}" if site >= poles else str(space.sites.ids[site]) for site, _ in pairs]
    located = locate_sites(space.town, places)  # pyright: ignore[reportArgumentType]
    rows = [
        {
            "id": name,
            "sensor": question.kinds.names[kind],
            "range_m": question.kinds.ranges_m[kind],
            "x": round(where.x, 3), "y": round(where.y, 3), "z": round(where.z, 3),
            "latitude": round(where.latitude, 7), "longitude": round(where.longitude, 7),
            "street": where.street or "",
        }
        for name, (_, kind), where in zip(names, pairs, located, strict=True)
    ]  # fmt: skip
    table = io.StringIO()
    if rows:
        writer = csv.DictWriter(table, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return {
        "csv": table.getvalue(),
        "geojson": json.dumps(_as_features(rows), indent=1),
        "yaml": _as_recipe(space, names),
        "command": write_command(space, question, len(pairs)),
    }


def _as_features(rows: Sequence[dict[str, str | float]]) -> dict[str, Json]:
    features: list[Json] = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [row["longitude"], row["latitude"]]},
            "properties": {name: row[name] for name in ("id", "sensor", "range_m", "street")},
        }
        for row in rows
    ]
    return {"type": "FeatureCollection", "features": features}


def _as_recipe(space: Workspace, names: Sequence[str]) -> str:
    """Return the section of a run recipe that stands these sensors; sites of one's own are in no recipe."""
    numbers = [name for name in names if not name.startswith("own ")]
    left = len(names) - len(numbers)
    note = f" # {left} at places of your own: no recipe can name them" if left else ""
    return f"# the sensors of {space.town.name}\nplacement: {{rule: fixed, poles: [{', '.join(numbers)}]}}{note}\n"


def write_command(space: Workspace, question: Question, count: int) -> str:
    """Return the `flcav place` that finds the best placement of as many sensors, after the files that it reads."""
    kinds, lines = question.kinds, []
    if len(kinds.names) == 1 and not any(kinds.costs):
        sensors = f"--range {kinds.ranges_m[0]:g}"
    else:
        rows = zip(kinds.names, kinds.ranges_m, kinds.costs, strict=True)
        body = "".join(f"{name},{range_m:g},{cost:g}\\n" for name, range_m, cost in rows)
        lines.append(f"printf {quote(f'name,range_m,cost{chr(92)}n{body}')} > sensors.csv")
        sensors = "--sensors sensors.csv"
    without = "".join(f" --class-weight {quote(f'{name}=0')}" for name in sorted(question.without))
    sight = " --line-of-sight" if question.line_of_sight else ""
    lines.append(f"flcav place {space.typed} {sensors} --count {max(count, 1)}{sight}{without}")
    return "\n".join(lines)

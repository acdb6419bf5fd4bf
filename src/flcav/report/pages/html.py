"""The report: one page that needs nothing but itself."""

import base64
from collections.abc import Mapping
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(results: Mapping[str, Any], pictures: Mapping[str, bytes], template: str = "report.html.j2") -> str:
    """Return the page about `results` as HTML, style and pictures inside.

    `pictures` are PNG files by name (of a run: town_map, before_after, ap_by_round, megabytes); those missing are left
    out. `template`: report.html.j2 about a run, plan.html.j2 about a plan. Raises `jinja2.UndefinedError` where
    `results` lack something the page tells.
    """
    environment = Environment(
        loader=PackageLoader("flcav", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"signed": "{:+.3f}".format, "ap": "{:.3f}".format, "mb": "{:.1f}".format}
    environment.filters |= {"error": "{:.4f}".format, "count": "{:,.0f}".format, "percent": "{:.0%}".format}
    return environment.get_template(template).render(
        results, pictures={name: _data_uri(png) for name, png in pictures.items()}
    )


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")

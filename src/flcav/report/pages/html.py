"""Rendering of self-contained HTML pages by Jinja templates, with embedded pictures."""

import base64
from collections.abc import Mapping
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from flcav.statistics.verdicts import signed


def render(
    results: Mapping[str, Any],
    pictures: Mapping[str, bytes],
    template: str = "report.html.j2",
    drawings: Mapping[str, str] | None = None,
) -> str:
    """Return the page about `results` as HTML, with style and pictures embedded.

    `pictures` are PNG files by name, as in `plan_page`, `drawings` SVG elements by name, as in `run_page`; missing ones
    are left out. `template` is report.html.j2 for a run, plan.html.j2 for a plan, release.html.j2 for a release. Raises
    `jinja2.UndefinedError` where `results` lack a value of the page.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader("flcav", "report"), PackageLoader("flcav", "runs/extras")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"signed": signed, "ap": "{:.3f}".format, "mb": "{:.1f}".format}
    environment.filters |= {"error": "{:.4f}".format, "count": "{:,.0f}".format, "percent": "{:.0%}".format}
    return environment.get_template(template).render(
        results,
        pictures={name: _data_uri(png) for name, png in pictures.items()},
        drawings={name: Markup(svg) for name, svg in (drawings or {}).items()},
    )


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")

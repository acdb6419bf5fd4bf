"""The planner as one page that needs no server: what it would ask for is computed before and written into it."""

import json

from flcav.config import InputError, Json
from flcav.planner.desk import Desk
from flcav.planner.exporting import write_command
from flcav.planner.placing import Question, describe_town, describe_workspace, look, trace_curve
from flcav.planner.server import ASSETS
from flcav.report.scene import SCENE

MOST_MB = 5.0  # of a page, to be sent by mail
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def save_page(desk: Desk) -> bytes:
    """Return the page of the desk's first workspace: visible areas from all poles, and the optimum of each step.

    Raises `InputError` where there is no town, or the page would be larger than `MOST_MB`.
    """
    if desk.first is None:
        raise InputError("--html: needs a town")
    space, kinds = desk.find(desk.first), desk.kinds
    question = Question(kinds)
    looks: dict[str, Json] = {}
    for pole, site in enumerate(space.sites.xyz.tolist()):
        for kind, range_m in enumerate(kinds.ranges_m):
            area, covered = look(space, (site[0], site[1], site[2]), range_m, True)
            looks[f"{pole} {kind}"] = {"area": area, "covered": covered, "z": site[2]}
    saved = {
        "start": desk.describe(),
        "workspace": {"key": desk.first, "map": describe_town(space.town), **describe_workspace(space)},
        "looks": looks,
        "curve": [] if space.given is None else [step.as_json() for step in trace_curve(space, question)],
        "command": "" if space.given is None else write_command(space, question, 1),
    }
    page = _join(json.dumps(saved, separators=(",", ":")).replace("<", "\\u003c"))
    if len(page) > MOST_MB * 1e6:
        told = f"{len(page) / 1e6:.1f} MB, more than {MOST_MB:g}"
        raise InputError(f"--html: the page would have {told}: give fewer poles, kinds or errors")
    return page


def _join(saved: str) -> bytes:
    """Return the page of the server with its style, its program and what is `saved` in it."""
    paths = (*(ASSETS / name for name in ("index.html", "planner.css", "planner.js")), SCENE)
    page, style, program, scene = (path.read_text("utf-8") for path in paths)
    policy = f'<meta charset="utf-8">\n<meta http-equiv="content-security-policy" content="{POLICY}">'
    program, scene = (text.replace("</script", "<\\/script") for text in (program, scene))
    data = f'<script type="application/json" id="saved">{saved}</script>'
    data += f'\n<script type="text/plain" id="scene">{scene}</script>'
    parts = {
        '<meta charset="utf-8">': policy,
        '<link rel="stylesheet" href="planner.css">': f"<style>\n{style}</style>",
        '<script src="planner.js"></script>': f"{data}\n<script>{program}</script>",
    }
    for mark, part in parts.items():
        page = page.replace(mark, part)
    return page.encode()

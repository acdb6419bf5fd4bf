"""The live status page of a fleet, on the loopback interface of the operator's host."""

import asyncio
import json
from collections.abc import Callable
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route

from flcav.fleet.status import read_fleet_status
from flcav.fleet.vehicle import check_port

POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'"
PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Fleet</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem; }
table { border-collapse: collapse; margin: .5rem 0 1.5rem; } th, td { padding: .2rem .8rem .2rem 0; text-align: left; }
th { border-bottom: 1px solid; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
.off { opacity: .55; } .bad { color: #b00020; }
</style>
<h1>Fleet</h1><p id="state">…</p>
<h2>Federation</h2><p id="federation"></p><table id="rounds"></table>
<h2>Vehicles</h2><table id="vehicles"></table>
<h2>FL requests</h2><ul id="asked"></ul>
<h2>Refused</h2><ul id="refused"></ul>
<script>
const at = id => document.getElementById(id);
const cell = (text, kind) => {
  const c = document.createElement("td"); c.textContent = text; c.className = kind || ""; return c;
};
const fill = (table, heads, rows) => {
  const head = document.createElement("tr");
  for (const each of heads) { const h = document.createElement("th"); h.textContent = each; head.append(h); }
  table.replaceChildren(head, ...rows.map(cells => {
    const r = document.createElement("tr"); r.append(...cells); return r;
  }));
};
const list = (where, lines) => where.replaceChildren(...lines.map(line => {
  const i = document.createElement("li"); i.textContent = line; return i;
}));
const number = value => value === null ? "" : value.toPrecision(4);
async function follow() {
  try {
    const s = await (await fetch("status.json")).json(), f = s.federation;
    at("state").textContent = s.proxy ? `up at ${s.proxy}` : "not up";
    at("federation").textContent = f ? s.told : "none yet";
    fill(at("rounds"), ["round", "clients", "loss", "epsilon", "failed"], (f ? f.rounds : []).map(r => [
      cell(r.round, "n"), cell(r.empty ? "empty" : r.clients, "n"), cell(number(r.loss), "n"),
      cell(number(r.epsilon), "n"),
      cell(Object.entries(r.failed).map(([who, why]) => `${who}: ${why}`).join("; "), "bad")]));
    fill(at("vehicles"), ["vehicle", "certificate", "node", "socket up", "socket down", "content up", "content down",
      "network"],
      s.vehicles.map(v => [cell(v.name), cell(v.state, v.state == "registered" ? "" : "bad"),
        cell(v.online ? "online" : "offline", v.online ? "" : "off"), cell(v.socket_up, "n"), cell(v.socket_down, "n"),
        cell(v.content_up, "n"), cell(v.content_down, "n"), cell(s.networks[v.name] || "")]));
    list(at("asked"), s.asked);
    list(at("refused"), s.refused);
  } catch (error) { at("state").textContent = `no answer: ${error}`; }
  setTimeout(follow, 1000);
}
follow();
</script>
</html>
"""


def make_page(folder: Path) -> Starlette:
    """Return the app of the page, which only answers requests to this host's names."""

    async def page(_: Request) -> HTMLResponse:
        return HTMLResponse(PAGE, headers={"content-security-policy": POLICY})

    async def status(_: Request) -> Response:
        found = await asyncio.to_thread(read_fleet_status, folder)
        progress = "" if found.federation is None else found.federation.describe()
        asked = [each.describe() for each in found.requests]
        networks = {
            vehicle.name: vehicle.release.describe() for vehicle in found.vehicles if vehicle.release is not None
        }
        values = {**found.as_json(), "told": progress, "asked": asked, "networks": networks}
        return Response(json.dumps(values), media_type="application/json")

    routes = [Route("/", page), Route("/status.json", status)]
    local = Middleware(TrustedHostMiddleware, allowed_hosts=["127.0.0.1", "localhost"])  # against DNS rebinding
    return Starlette(routes=routes, middleware=[local])


def serve_page(folder: Path, port: int, report: Callable[[str], None]) -> None:
    """Serve the page on the loopback until interrupted; raises `InputError` if there is no fleet or no free port."""
    read_fleet_status(folder)
    port = check_port("127.0.0.1", port)
    report(f"http://127.0.0.1:{port}/ follows {folder}")
    uvicorn.run(make_page(folder), host="127.0.0.1", port=port, log_level="warning", log_config=None)

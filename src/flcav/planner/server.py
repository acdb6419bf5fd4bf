"""The server of the planner: one page on the loopback interface, and the answers that it asks for.

Whoever knows the token of the address is answered: it is sent as a bearer token, which no other site's page can make a
browser send, so that there is nothing to forge. No request names a path: towns are those of flcav or were opened
here, files of the page are four by name, and what is uploaded is read from a temporary folder that is removed.
"""

import contextlib
import secrets
import socket
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uvicorn
from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flcav.config import InputError, Json
from flcav.optimization.problem import Problem
from flcav.planner.desk import Desk
from flcav.planner.exporting import export_placement
from flcav.planner.placing import (
    describe_town,
    describe_workspace,
    find_best,
    find_new_poles,
    look,
    mount,
    trace_curve,
)
from flcav.planner.planning import plan_budgets, plan_more, with_budgets
from flcav.planner.requests import (
    MOST_BYTES,
    AskedBest,
    AskedError,
    AskedExport,
    AskedFootage,
    AskedLook,
    AskedNew,
    AskedPlacement,
    AskedPlan,
    AskedTown,
    DroppedRun,
)
from flcav.planner.uploads import take_file, take_run
from flcav.report.scene import SCENE

if TYPE_CHECKING:
    from flcav.planner.footage import Footage  # loads torch, as runs do

ASSETS = Path(__file__).with_name("assets")
SHOWN = {
    "": (ASSETS / "index.html", "text/html"),
    "planner.js": (ASSETS / "planner.js", "text/javascript"),
    "planner.css": (ASSETS / "planner.css", "text/css"),
    "scene.js": (SCENE, "text/javascript"),
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}


class LimitBody:
    """ASGI middleware that refuses bodies of more than `MOST_BYTES`, before they are read as far as they are told."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, cut off where it is too long."""
        if scope["type"] != "http":
            return await self.app(scope, receive, send)
        length = dict(scope["headers"]).get(b"content-length", b"0")
        if not length.isdigit() or int(length) > MOST_BYTES:
            return await _refuse(413, f"more than {MOST_BYTES // 1_000_000} MB")(scope, receive, send)
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > MOST_BYTES:
                raise TooLong
            return message

        with contextlib.suppress(TooLong):
            return await self.app(scope, counted, send)
        return await _refuse(413, f"more than {MOST_BYTES // 1_000_000} MB")(scope, receive, send)


class TooLong(Exception):
    """Raised where a body goes on beyond its limit."""


def _refuse(status: int, sentence: str) -> JSONResponse:
    return JSONResponse({"error": sentence}, status, headers=HEADERS)


def make_app(desk: Desk, token: str) -> FastAPI:
    """Return the app of the planner over what is on the `desk`, for holders of the `token`."""
    busy = threading.Lock()  # Embree's scenes and the solver are used by one request at a time

    def admit(request: Request) -> None:
        given = request.headers.get("authorization", "")
        if not secrets.compare_digest(given.encode(), f"Bearer {token}".encode()):
            raise Refused(401, "the address lacks the planner's token: open the one that the command printed")
        origin = request.headers.get("origin")
        if origin is not None and origin != f"{request.url.scheme}://{request.headers.get('host')}":
            raise Refused(403, "a page of another site asked")

    app = FastAPI(
        title="flcav planner", docs_url=None, redoc_url=None, openapi_url=None,
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=["127.0.0.1", "localhost"]), Middleware(LimitBody)],
    )  # fmt: skip
    guarded: dict[str, Any] = {"dependencies": [Depends(admit)]}

    @app.exception_handler(Refused)
    async def refused(_: Request, error: Refused) -> JSONResponse:
        return _refuse(error.status, error.sentence)

    @app.exception_handler(InputError)
    async def bad(_: Request, error: InputError) -> JSONResponse:
        return _refuse(422, " ".join(str(error).split()))

    @app.exception_handler(RequestValidationError)
    async def malformed(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"] if part != "body")
        return _refuse(422, f"{where}: {first['msg']}" if where else str(first["msg"]))

    @app.post("/api/start", **guarded)
    def start() -> dict[str, Json]:
        return desk.describe()

    @app.post("/api/open", **guarded)
    def open_town(asked: AskedTown) -> dict[str, Json]:
        with busy:
            return _describe(desk, desk.open_town(asked.town))

    @app.post("/api/workspace", **guarded)
    def workspace(asked: AskedTown) -> dict[str, Json]:
        with busy:
            return _describe(desk, asked.town)

    @app.post("/api/drop", **guarded)
    async def drop(request: Request, name: str, workspace: str = "") -> dict[str, Json]:
        content = await request.body()
        return await _in_thread(lambda: _describe(desk, take_file(desk, workspace, name, content)), busy)

    @app.post("/api/drop-run", **guarded)
    def drop_run(asked: DroppedRun) -> dict[str, Json]:
        with busy:
            take_run(desk, asked)
            return desk.describe()

    @app.post("/api/look", **guarded)
    def look_from(asked: AskedLook) -> dict[str, Json]:
        space = desk.find(asked.workspace)
        with busy:
            at = mount(space, [(asked.x, asked.y)])[0]
            if asked.pole is not None:
                if asked.pole >= len(space.sites.ids):
                    raise InputError(f"there is no pole {asked.pole + 1} of {len(space.sites.ids)}")
                at = space.sites.xyz[asked.pole]
            area, covered = look(space, tuple(at.tolist()), asked.range_m, asked.line_of_sight)
        return {"area": area, "covered": covered, "z": float(at[2])}

    @app.post("/api/best", **guarded)
    def best(asked: AskedBest) -> dict[str, Json]:
        if (asked.count is None) == (asked.budget is None):
            raise InputError("count, budget: one of the two is wanted")
        with busy:
            found = find_best(desk.find(asked.workspace), asked.question(), count=asked.count, budget=asked.budget)
        return found.as_json()

    @app.post("/api/curve", **guarded)
    def curve(asked: AskedPlacement) -> dict[str, Json]:
        with busy:
            return {"steps": [step.as_json() for step in trace_curve(desk.find(asked.workspace), asked.question())]}

    @app.post("/api/new-poles", **guarded)
    def new_poles(asked: AskedNew) -> dict[str, Json]:
        space = desk.find(asked.workspace)
        if asked.kind >= len(asked.kinds) or any(row >= len(space.errors) for row in asked.uncovered):
            raise InputError("kind, uncovered: there are not as many")
        with busy:
            found = find_new_poles(space, asked.question(), asked.kind, asked.uncovered)
        return {"places": [asdict(place) for place in found]}

    @app.post("/api/export", **guarded)
    def export(asked: AskedExport) -> dict[str, Json]:
        with busy:
            return export_placement(desk.find(asked.workspace), asked.question(), asked.pairs)

    @app.post("/api/plan", **guarded)
    def plan(asked: AskedPlan) -> dict[str, Json]:
        return plan_budgets(_budgeted(desk, asked))

    @app.post("/api/plan-more", **guarded)
    def more(asked: AskedPlan) -> dict[str, Json]:
        return plan_more(_budgeted(desk, asked))

    @app.post("/api/drive", **guarded)
    def drive(asked: AskedFootage) -> dict[str, Json]:
        return _footage(desk).drive(asked.name)

    @app.post("/api/sweep", **guarded)
    def sweep() -> dict[str, Json]:
        return _footage(desk).sweep()

    @app.post("/api/error-sweep", **guarded)
    def error_sweep(asked: AskedError) -> dict[str, Json]:
        if asked.workspace not in desk.regions:
            raise InputError("there are no sweeps of these errors: flcav planner RUN")
        with busy:
            return _footage(desk).error_sweep(desk.regions[asked.workspace], asked.row)

    @app.post("/api/picture", **guarded)
    def picture(asked: AskedFootage) -> dict[str, Json]:
        with busy:
            return _footage(desk).picture(asked.name)

    @app.get("/")
    @app.get("/{name}")
    def file(name: str = "") -> Response:
        if name not in SHOWN:
            return _refuse(404, "there is no such page")
        path, kind = SHOWN[name]
        return Response(path.read_bytes(), media_type=kind, headers=HEADERS)

    return app


class Refused(Exception):
    """A request that is refused, with its status."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status, self.sentence = status, sentence


async def _in_thread(work: Callable[[], dict[str, Json]], busy: threading.Lock) -> dict[str, Json]:
    import asyncio

    def locked() -> dict[str, Json]:
        with busy:
            return work()

    return await asyncio.to_thread(locked)


def _budgeted(desk: Desk, asked: AskedPlan) -> Problem:
    if desk.problem is None:
        raise InputError("there is no problem to plan: flcav planner PROBLEM.yaml")
    return with_budgets(desk.problem, asked.wireless_mb, asked.wireline_mb, asked.horizon_s)


def _footage(desk: Desk) -> "Footage":
    if desk.footage is None:
        raise InputError("there is no run to replay: flcav planner RUN")
    return desk.footage


def _describe(desk: Desk, key: str) -> dict[str, Json]:
    space = desk.find(key)
    told = {"key": key, "map": describe_town(space.town), "sweeps": desk.footage is not None and key in desk.regions}
    return {**told, **describe_workspace(space)}


def serve_planner(desk: Desk, port: int | None, report: Callable[[str], None]) -> None:
    """Serve the planner on the loopback until interrupted; `report` is given its address.

    Raises `InputError` where the port is taken.
    """
    token = secrets.token_urlsafe(24)
    with socket.socket() as door:
        door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            door.bind(("127.0.0.1", port or 0))
        except OSError as error:
            raise InputError(f"port {port}: {error.strerror or error}") from None

        @contextlib.asynccontextmanager
        async def told(_: FastAPI) -> AsyncIterator[None]:
            report(f"http://127.0.0.1:{door.getsockname()[1]}/#token={token}")
            yield

        app = make_app(desk, token)
        app.router.lifespan_context = told
        config = uvicorn.Config(app, log_level="critical", log_config=None, timeout_graceful_shutdown=1)
        uvicorn.Server(config).run(sockets=[door])

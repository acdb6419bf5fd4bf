"""The proxy's answers about releases: files of the repositories on offer to a vehicle, and its reports back (ASGI)."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from starlette.types import Receive, Scope, Send

from flcav.fleet.relay import Refused, answer, read_body, send_file
from flcav.fleet.release_report import LARGEST, RELEASES, REPORT, parse_report
from flcav.fleet.releases.offer import KeptReport, find_offered


async def answer_release(
    fleet: Path, vehicle: str, scope: Scope, receive: Receive, send: Send, count: Callable[[], int]
) -> None:
    """Answer a registered vehicle's call; raises `Refused`.

    count: called for each piece that was sent; returns the bytes that this vehicle's releases took so far.
    """
    asked, method = scope["path"].removeprefix(RELEASES), scope["method"]
    if method == "POST" and asked == REPORT:
        await _take_report(fleet, vehicle, await read_body(scope, receive, LARGEST), count)
        await answer(send, 200, "the report is taken")
        return
    if method != "GET":
        raise Refused(403, f"{method} {scope['path'][:100]} is no call of a vehicle's")
    try:
        path = await asyncio.to_thread(find_offered, fleet, asked)
    except ValueError as error:
        raise Refused(403, f"{scope['path'][:100]} {error}") from None
    if path is None:
        await answer(send, 404, "no such file is on offer")
    else:
        await send_file(send, path, count)


async def _take_report(fleet: Path, vehicle: str, content: bytes, count: Callable[[], int]) -> None:
    try:
        report = parse_report(content)
    except ValueError as error:
        raise Refused(400, str(error)) from None
    if report.shadow is not None:  # the certificate says whose it is
        report = replace(report, shadow=replace(report.shadow, vehicle=vehicle))
    try:
        await asyncio.to_thread(KeptReport(vehicle, time.time(), count(), report).save, fleet)
    except OSError as error:
        raise Refused(503, f"the report cannot be kept: {error}") from None

"""A vehicle's forwarder: a local proxy that adds the client certificate, which Flower's SuperNode does not support.

It only listens on the vehicle's loopback, and passes calls on with the vehicle's certificate. FL requests are sent to
the proxy directly.
"""

import contextlib
import ssl
from pathlib import Path

import httpx
from starlette.types import Receive, Scope, Send

from flcav.config import InputError
from flcav.fleet import relay
from flcav.fleet.fl_request import PATH, FLRequest
from flcav.fleet.keys import AUTHORITY, CERTIFICATE, KEY, LOOPBACK, LOOPBACK_KEY
from flcav.fleet.mutual_tls import serve_https
from flcav.interface.wording import make_printable

POLL = "pull-messages"  # a SuperNode's call for a message
LIMITS = httpx.Limits(max_connections=8)  # to the proxy, which allows a vehicle twice as many


class Forwarder:
    """The forwarder's ASGI app, on the loopback interface of a vehicle."""

    def __init__(self, client: httpx.AsyncClient, polled: Path) -> None:
        """Forward calls by `client`; the file `polled` is touched when a message is asked for."""
        self._client, self._polled = client, polled

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a node's call to the proxy."""
        if scope["type"] == "lifespan":
            while not await relay.keep_alive(receive, send):
                pass
            return
        call = scope["path"].removeprefix(relay.FLEET)
        try:
            if scope["method"] != "POST" or scope["path"] != relay.FLEET + call or call not in relay.CALLS:
                raise relay.RelayRefused(403, "no call of a node")
            headers = relay.choose_headers(relay.check_headers(scope["headers"]), (relay.NODE_KEY, *relay.SENT))
            body = await relay.read_body(scope, receive, relay.largest_body(call))
        except relay.RelayRefused as refused:
            await relay.answer(send, refused.status, refused.why)
            return
        if call == POLL:
            with contextlib.suppress(OSError):  # a full disk must not end the calls
                self._polled.touch()
        await relay.relay(self._client, relay.FLEET + call, headers, body, send)


def vehicle_tls(folder: Path) -> ssl.SSLContext:
    """Return the TLS settings of a vehicle: its certificate, and the authority whose servers it trusts."""
    context = ssl.create_default_context(cafile=str(folder / AUTHORITY))
    context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    return context


def run_forwarder(folder: Path, port: int, server: str, polled: Path) -> None:
    """Run the forwarder of the vehicle in `folder` until the process is ended; `server` is host:port of the proxy.

    polled: file that is touched with each of the SuperNode's calls for a message.
    """
    client = httpx.AsyncClient(
        base_url=f"https://{server}", verify=vehicle_tls(folder), timeout=relay.TIMEOUT, trust_env=False, limits=LIMITS
    )
    serve_https(Forwarder(client, polled), "127.0.0.1", port, folder / LOOPBACK, folder / LOOPBACK_KEY).run()


def send_request(folder: Path, server: str, request: FLRequest) -> None:
    """Send a request of the vehicle in `folder` to the proxy at `server` (host:port).

    Raises `InputError` where it is refused, `OSError` where the proxy cannot be reached.
    """
    try:
        response = httpx.post(
            f"https://{server}{PATH}",
            content=request.as_bytes(),
            verify=vehicle_tls(folder),
            trust_env=False,
            timeout=30.0,
        )
    except httpx.HTTPError as error:
        raise OSError(f"{server}: the fleet cannot be reached: {error}") from None
    if response.status_code != httpx.codes.OK:
        raise InputError(f"{server}: the request is refused: {make_printable(response.text)}")

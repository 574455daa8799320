"""Serves a session's page on this machine alone: the page by HTTP, all else by a WebSocket.

The server listens on 127.0.0.1, and answers only requests to that address, of pages that it has
served: a page of another origin, or of a name that is made to lead here, is refused. Messages are
bounded, and so are connections. Only this file imports `websockets`.
"""

import asyncio
import json
import socket
from collections.abc import Callable
from html import escape
from http import HTTPStatus
from importlib.resources import files
from string import Template

from contactgraph.data import InvalidInputError
from contactgraph.play.session import Session
from contactgraph.play.wishes import read_wish
from contactgraph.viz.report import SCENE_SCRIPTS, asset, one_scope, script_hash

try:
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
    from websockets.typing import Origin
except ImportError as error:
    raise InvalidInputError(
        "play needs the package websockets: pip install 'contactgraph[play]'"
    ) from error

HOST = "127.0.0.1"
LARGEST_MESSAGE = 4096
"""Bytes of a message to the server, at most."""
CONNECTIONS = 4
"""Pages that may be open at a time."""
_PATH = "/session"
"""Of the WebSocket."""
_SCRIPTS = (*SCENE_SCRIPTS, "reliability_chart.js")
"""Of the report's page."""
_LIVE_SCRIPTS = ("live_scene.js", "live_hand.js", "live_panels.js", "live.js")


def page(origin: str) -> str:
    """The page as text; it connects to ``origin`` alone."""
    script = one_scope(*map(asset, _SCRIPTS), *map(_asset, _LIVE_SCRIPTS))
    return Template(_asset("live.html")).substitute(
        policy=escape(_policy(origin, script)),
        style=asset("page.css") + _asset("live.css"),
        script=script,
    )


def _policy(origin: str, script: str) -> str:
    here = origin.replace("http", "ws", 1)
    return (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
        f"script-src '{script_hash(script)}'; connect-src {here}{_PATH}"
    )


def _asset(name: str) -> str:
    return (files("contactgraph.play") / "assets" / name).read_text(encoding="utf-8")


def listening_socket(port: int) -> socket.socket:
    """A socket on 127.0.0.1; port 0 takes a free one.

    Raises `InvalidInputError` where the port cannot be had.
    """
    try:
        return socket.create_server((HOST, port))
    except (OSError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(f"--port {port}: cannot be listened on ({reason})") from error


def origin_of(listening: socket.socket) -> str:
    """``http://127.0.0.1:PORT``"""
    return f"http://{HOST}:{listening.getsockname()[1]}"


async def serve_session(
    session: Session, listening: socket.socket, ready: Callable[[], None] = lambda: None
) -> None:
    """Serves until the session is over; ``ready`` is called once the server answers."""
    origin = origin_of(listening)
    readers: set[asyncio.Event] = set()
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    body = page(origin).encode("utf-8")

    def wake() -> None:
        for reader in readers:
            reader.set()
        if session.over:
            over.set()

    def on_change() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(wake)

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        """The page, a refusal, or None, where a WebSocket is to be opened."""
        if request.headers.get("Host") != origin.removeprefix("http://"):
            return _refused(HTTPStatus.FORBIDDEN, "another host is served nothing")
        if request.path == _PATH:
            if len(readers) >= CONNECTIONS:
                return _refused(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are open")
            return None
        if request.path != "/":
            return _refused(HTTPStatus.NOT_FOUND, "there is one page, /")
        return _response(HTTPStatus.OK, "text/html; charset=utf-8", body)

    async def handle(connection: ServerConnection) -> None:
        if len(readers) >= CONNECTIONS:
            await connection.close(1013, "too many pages are open")
            return
        reader = asyncio.Event()
        reader.set()
        readers.add(reader)
        sending = asyncio.create_task(_send_newest(connection, session, reader))
        try:
            async for message in connection:
                try:
                    session.wish(read_wish(message))
                except InvalidInputError as error:
                    await connection.send(json.dumps({"type": "error", "text": str(error)}))
        except ConnectionClosed:
            pass
        finally:
            readers.discard(reader)
            sending.cancel()

    session.on_change = on_change
    async with serve(
        handle,
        sock=listening,
        origins=[Origin(origin)],
        process_request=answer,
        max_size=LARGEST_MESSAGE,
        max_queue=16,
        compression=None,
        close_timeout=1,
        server_header=None,
    ):
        ready()
        wake()
        await over.wait()


async def _send_newest(
    connection: ServerConnection, session: Session, reader: asyncio.Event
) -> None:
    """Sends what is new whenever the connection is free for more; what was missed is left out."""
    scene = frame = None
    try:
        while True:
            await reader.wait()
            reader.clear()
            newest = session.newest
            if newest[0] is not None and newest[0] is not scene:
                scene = newest[0]
                await connection.send(scene)
            if newest[1] is not None and newest[1] is not frame:
                frame = newest[1]
                await connection.send(frame)
    except ConnectionClosed:
        pass


def _refused(status: HTTPStatus, reason: str) -> Response:
    return _response(status, "text/plain; charset=utf-8", f"{reason}\n".encode())


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": "frame-ancestors 'none'",
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Connection": "close",
        }
    )
    return Response(status.value, status.phrase, headers, body)

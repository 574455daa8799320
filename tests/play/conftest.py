"""One compiled session, served on a free port, for all tests of a module."""

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from contactgraph.cli.play import stage_parts
from contactgraph.play import Session, StageChoice
from contactgraph.play.server import listening_socket, origin_of, serve_session

PATIENCE_S = 180.0


@dataclass
class Served:
    session: Session
    origin: str
    record: Path

    def connect(self) -> ClientConnection:
        address = self.origin.replace("http", "ws") + "/session"
        return connect(address, origin=self.origin, max_size=None, proxy=None)


class Page:
    """A page without a browser: it sends wishes and waits for frames."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.scene: dict[str, Any] = {}

    def wish(self, name: str, **values: Any) -> None:
        self.connection.send(json.dumps({"wish": name, **values}))

    def message(self) -> dict[str, Any]:
        found = json.loads(self.connection.recv(timeout=PATIENCE_S))
        if found["type"] == "scene":
            self.scene = found
        return found

    def until(self, met: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """The first message that meets a condition."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            found = self.message()
            if met(found):
                return found
        raise AssertionError("no such message came")

    def next_scene(self) -> dict[str, Any]:
        """Begins the next scene; its first frame of motion."""
        self.wish("reset")
        self.until(lambda found: found["type"] == "scene")
        number = self.scene["number"]
        return self.until(lambda found: found.get("scene") == number and "step" in found)


def serve(session: Session) -> tuple[threading.Thread, str]:
    """Serves a session in a thread of its own; returns it and the origin."""
    listening = listening_socket(0)
    answering = threading.Event()
    server = threading.Thread(
        target=lambda: asyncio.run(serve_session(session, listening, answering.set))
    )
    session.start()
    server.start()
    assert answering.wait(PATIENCE_S)
    return server, origin_of(listening)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    record = tmp_path_factory.mktemp("play") / "session.h5"
    choice = StageChoice("pickup", "pickup")
    session = Session(choice, stage_parts, ("pickup", "door"), ("pickup", "door"), record=record)
    server, origin = serve(session)
    yield Served(session, origin, record)
    session.stop()
    server.join()
    assert session.failure is None


@pytest.fixture
def page(served: Served) -> Iterator[Page]:
    with served.connect() as connection:
        found = Page(connection)
        found.until(lambda message: "step" in message)
        found.wish("speed", speed=4)
        found.wish("sensor", sensor="exact")
        yield found

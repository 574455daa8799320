"""The process of the simulated arm: ``python -m contactgraph_franka.sim.arm_server FOLDER``."""

import os
import sys
import time
from pathlib import Path

from contactgraph_franka.loop.undisturbed import undisturbed
from contactgraph_franka.sim.arm_scene import TICK, ArmScene
from contactgraph_franka.sim.observer import Observer
from contactgraph_franka.sim.orders import OrderTaker
from contactgraph_franka.sim.server_report import ServerCounters
from contactgraph_franka.sim.session import read_session
from contactgraph_franka.sim.truth import TruthWriter

_CATCH_UP = 10
"""Ticks behind time that are made up for at once; more are left out, as if time had stood still."""
_LOOK = 100
"""Ticks between looks whether the owner still lives."""


def main() -> None:
    """Serves until the owner ends."""
    folder = Path(sys.argv[1])
    session = read_session(folder)
    with ArmScene(session.blocks, session.mass) as scene:
        (folder / "scene.xml").write_text(scene.description)
        with scene.server(session.address) as ends:
            truth = TruthWriter(folder, session.blocks, scene.model.nq)
            counters = ServerCounters(folder, scene.model.nq, session.pace * TICK)
            # As an arm's own computer does, it goes first where cores are few.
            with undisturbed():
                _serve(scene, ends, truth, counters, OrderTaker(folder), session.pace)


def _serve(
    scene: ArmScene,
    ends: list,
    truth: TruthWriter,
    counters: ServerCounters,
    orders: OrderTaker,
    pace: float,
) -> None:
    """Ticks by absolute times: what one loses in sleeping too long, the next makes up for."""
    observer = Observer(scene, truth.row)
    period, owner = pace * TICK, os.getppid()
    tick, due = 0, time.monotonic()
    counters.start(due)
    while tick % _LOOK or os.getppid() == owner:
        due += period
        wait = due - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        begun = time.monotonic()
        if begun - due > _CATCH_UP * period:
            missed = int((begun - due) / period)
            counters.drop(missed)
            due += missed * period
        for end in ends:
            end.process_commands()
        orders.carry_out(scene.place_block)
        scene.step()
        for end in ends:
            end.send_state()
        observer.fill(tick, time.monotonic() / pace)
        truth.publish(tick)
        tick += 1
        done = time.monotonic()
        counters.count(tick, done, done - begun, begun - due)


if __name__ == "__main__":
    main()

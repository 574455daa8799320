"""``contactgraph robot rehearse``: an arm for whoever has none."""

import time
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg


@dataclass(frozen=True)
class Rehearse:
    """Simulate an arm behind the real one's protocol, with table and tagged block, until Ctrl-C.

    What is sent to its address is what a real arm would be sent.
    """

    pace: float = 4.0
    """Wall seconds to a simulated one; 1 is real time, and needs four cores."""
    camera: bool = False
    """With a camera that sees the block: --camera rendered uses it."""
    block_mass: Annotated[float, arg(metavar="KG")] = 0.83
    """The block's."""
    address: Annotated[str | None, arg(metavar="ADDR")] = None
    """A loopback address; the first free one from 127.0.0.1 on, if not given."""

    def run(self) -> None:
        """Start, say where, and wait."""
        from contactgraph.cli.output import say
        from contactgraph_franka.sim.camera import CameraSettings
        from contactgraph_franka.sim.simulated_robot import ADDRESSES, RobotSimulator

        rehearsal = RobotSimulator(
            pace=self.pace,
            camera=CameraSettings() if self.camera else None,
            mass=self.block_mass,
            addresses=ADDRESSES if self.address is None else (self.address,),
        )
        with rehearsal as running:
            say(f"an arm is simulated at {running.address}, {self.pace:g} times slower than real")
            how = "--camera rendered" if self.camera else "--block 0.5 -0.15 0.05"
            say("in another terminal:")
            say(f"  contactgraph robot check {running.address}")
            say(f"  contactgraph robot run franka {running.address} --goal 0.45 0.1 0.3 {how}")
            say("Ctrl-C ends it")
            try:
                while True:
                    rehearsal.check()
                    time.sleep(0.5)
            except KeyboardInterrupt:
                say("ended")

"""``contactgraph robot``: a real arm, a rehearsed one, or a fake one."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from contactgraph_franka.cli.robot_calibrate import Calibrate
from contactgraph_franka.cli.robot_check import Check
from contactgraph_franka.cli.robot_record import Record
from contactgraph_franka.cli.robot_rehearse import Rehearse
from contactgraph_franka.cli.robot_rehearse_control import RehearseControl
from contactgraph_franka.cli.robot_rehearse_record import RehearseRecord
from contactgraph_franka.cli.robot_run import Run

ACTIONS = ("check", "run", "record", "calibrate", "rehearse", "rehearse-record", "rehearse-control")


@dataclass(frozen=True)
class Robot:
    """Check, control, record or rehearse an arm."""

    action: (
        Annotated[Check, subcommand("check")]
        | Annotated[Run, subcommand("run")]
        | Annotated[Record, subcommand("record")]
        | Annotated[Calibrate, subcommand("calibrate")]
        | Annotated[Rehearse, subcommand("rehearse")]
        | Annotated[RehearseRecord, subcommand("rehearse-record")]
        | Annotated[RehearseControl, subcommand("rehearse-control")]
    )

    def run(self) -> None:
        """Do it."""
        self.action.run()

"""The command line: one command a file in `contactgraph.cli`; here is how they are called.

Exit codes: 0 done; 2 the user's mistake, one line on stderr; 1 a fault of ours; 130 Ctrl-C.
"""

import contextlib
import io
import os
import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import subcommand

from contactgraph.cli.collect import Collect
from contactgraph.cli.control import Control
from contactgraph.cli.evaluate import Evaluate
from contactgraph.cli.info import Info
from contactgraph.cli.learn_cost import LearnCost
from contactgraph.cli.report import Report
from contactgraph.cli.train import Train
from contactgraph.cli.usage import one_line
from contactgraph.data import InvalidInputError
from contactgraph_franka.cli.options import RobotFault
from contactgraph_franka.cli.robot import ACTIONS, Robot
from contactgraph_studies.cli.reproduce import Reproduce

Command = (
    Annotated[Collect, subcommand("collect")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Control, subcommand("control")]
    | Annotated[LearnCost, subcommand("learn-cost")]
    | Annotated[Reproduce, subcommand("reproduce")]
    | Annotated[Robot, subcommand("robot")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Info, subcommand("info")]
)

_COMMANDS = (
    "collect",
    "train",
    "evaluate",
    "control",
    "learn-cost",
    "reproduce",
    *(f"robot {action}" for action in ACTIONS),
    "report",
    "info",
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # long commands print into logs as they go
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run one command; the exit code."""
    try:
        command = _parse(arguments)
        if isinstance(command, int):
            return command
        _keep_compiled_programs()
        command.run()
    except InvalidInputError as error:
        print(f"contactgraph: {error}", file=sys.stderr)
        return 2
    except RobotFault as error:
        print(f"contactgraph: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("contactgraph: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Whoever read our output has gone (`| head`): nothing more to say, and nobody to say it to.
        # What is still buffered would fail again when Python exits, so it goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    return 0


def _parse(arguments: list[str]) -> Command | int:
    """The command, or the exit code where there is none to run."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                Command,
                prog="contactgraph",
                description="Learn which objects touch when, and control through contact.",
                args=arguments or ["--help"],
                config=(
                    tyro.conf.OmitSubcommandPrefixes,
                    tyro.conf.OmitArgPrefixes,
                    tyro.conf.FlagCreatePairsOff,
                ),
            )
    except SystemExit as exit:
        if exit.code in (0, None):
            sys.stdout.flush()
            return 0
        words = 2 if arguments[0] == "robot" else 1
        mistake = one_line(said.getvalue(), " ".join(arguments[:words]), _COMMANDS)
        print(f"contactgraph: {mistake}", file=sys.stderr)
        return 2


def _keep_compiled_programs() -> None:
    """Let JAX keep compiled programs between calls, in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "contactgraph"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")

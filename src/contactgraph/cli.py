"""The command line: one command a file in `contactgraph.commands`; here is how they are called.

Exit codes: 0 done; 2 the user's mistake, one line on stderr; 1 a fault of ours; 130 Ctrl-C.
"""

import contextlib
import io
import os
import re
import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import subcommand

from contactgraph.commands.collect import Collect
from contactgraph.commands.control import Control
from contactgraph.commands.evaluate import Evaluate
from contactgraph.commands.info import Info
from contactgraph.commands.report import Report
from contactgraph.commands.reproduce import Reproduce
from contactgraph.commands.train import Train
from contactgraph.data import InvalidInputError

Command = (
    Annotated[Collect, subcommand("collect")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Control, subcommand("control")]
    | Annotated[Reproduce, subcommand("reproduce")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Info, subcommand("info")]
)

_BOX = re.compile(r"[╭╮╰╯│─┄┈╌]+")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run one command; the exit code."""
    command = _parse(arguments)
    if isinstance(command, int):
        return command
    _keep_compiled_programs()
    try:
        command.run()
    except InvalidInputError as error:
        print(f"contactgraph: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("contactgraph: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Whoever read our output has gone (`| head`): nothing more to say, and nobody to say it to.
        sys.stdout = None
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
                config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
            )
    except SystemExit as exit:
        if exit.code in (0, None):
            return 0
        print(f"contactgraph: {_one_line(said.getvalue())}", file=sys.stderr)
        return 2


def _one_line(text: str) -> str:
    words = _BOX.sub(" ", re.sub(r"\x1b\[[0-9;]*m", "", text)).split()
    return " ".join(words)


def _keep_compiled_programs() -> None:
    """Let JAX keep compiled programs between calls, in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "contactgraph"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")

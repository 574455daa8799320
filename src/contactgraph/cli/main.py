"""The program ``contactgraph``: its commands, exit codes and one-line errors.

Exit codes: 0 success; 1 a fault that is not the user's mistake; 2 the user's mistake, with one line
on stderr; 130 Ctrl-C. Other packages add commands by entry points of the group
``contactgraph.commands``, which are imported when they are called or listed in the help.
"""

import contextlib
import difflib
import io
import os
import re
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Protocol

import tyro

from contactgraph.cli import CommandError
from contactgraph.cli.collect import Collect
from contactgraph.cli.control import Control
from contactgraph.cli.evaluate import Evaluate
from contactgraph.cli.info import Info
from contactgraph.cli.interchange import Export, Import
from contactgraph.cli.learn_cost import LearnCost
from contactgraph.cli.options import use_device
from contactgraph.cli.play import Play
from contactgraph.cli.report import Report
from contactgraph.cli.train import Train
from contactgraph.data import InvalidInputError
from contactgraph.data.lookup import load_entry_point


class Command(Protocol):
    """A dataclass: its fields are the options, its docstring is the help text."""

    def run(self) -> object:
        """Does what the command promises; raises `InvalidInputError` or `CommandError`."""


_CONFIG = (
    tyro.conf.OmitSubcommandPrefixes,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
)
_OVERVIEW = """\
usage: contactgraph COMMAND ...

Learn which objects touch when, and control through contact.

commands:
{commands}

contactgraph COMMAND --help describes the options of a command;
contactgraph info lists the shipped models and the tasks;
contactgraph --version prints the version."""
_GROUP = "contactgraph.commands"
_COMMANDS: dict[str, type[Command]] = {
    "collect": Collect,
    "import": Import,
    "export": Export,
    "train": Train,
    "evaluate": Evaluate,
    "control": Control,
    "play": Play,
    "learn-cost": LearnCost,
    "report": Report,
    "info": Info,
}


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its code."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # log files show a long command's progress
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run one command; the exit code."""
    try:
        command = parse(arguments)
        if isinstance(command, int):
            return command
        _keep_compiled_programs()
        device = getattr(command, "device", None)
        if device is not None:
            use_device(device)
        command.run()
    except (InvalidInputError, CommandError) as error:
        print(f"contactgraph: {error}", file=sys.stderr)
        return 1 if isinstance(error, CommandError) else 2
    except KeyboardInterrupt:
        print("contactgraph: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has ended (`| head`). Buffered output would fail again when
        # Python exits, so it is discarded.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    return 0


def parse(arguments: Sequence[str]) -> Command | int:
    """The command with its options, or the exit code if there is none to run."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview(), flush=True)
        return 0
    if arguments[0] == "--version":
        print(f"contactgraph {version('contactgraph')}", flush=True)
        return 0
    name, *rest = arguments
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(_command(name), prog=f"contactgraph {name}", args=rest, config=_CONFIG)
    except SystemExit as exit:
        if exit.code in (0, None):
            sys.stdout.flush()
            return 0
        print(f"contactgraph: {_one_line(messages.getvalue(), name)}", file=sys.stderr)
        return 2


def _names() -> list[str]:
    return [*_COMMANDS, *sorted({entry.name for entry in entry_points(group=_GROUP)})]


def _command(name: str) -> type[Command]:
    command = _COMMANDS.get(name) or load_entry_point(_GROUP, name)
    if command is None:
        near = difflib.get_close_matches(name, _names(), n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InvalidInputError(
            f"no command {name!r}; the commands are {', '.join(_names())}{hint}"
        )
    return command


def _overview() -> str:
    lines = []
    for name in _names():
        try:
            summary = (_command(name).__doc__ or "").strip().split("\n\n")[0]
        except InvalidInputError as error:
            summary = f"(not available: {error})"
        lines.append(f"  {name:<12}{' '.join(summary.split())}")
    return _OVERVIEW.format(commands="\n".join(lines))


def _keep_compiled_programs() -> None:
    """Let JAX keep compiled programs between calls, in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "contactgraph"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


_STYLE = re.compile(r"\x1b\[[0-9;]*m")
# The parser draws boxes from other characters if standard output is not Unicode.
_BOX = re.compile(r"[╭╮╰╯│─┄┈╌]+|-{4,}|^[|+]-?(?=\s)|[|+]$", re.MULTILINE)
_POINTER = re.compile(r" ?For full helptext, (?:run|see):? contactgraph (.+?) --help.*")
_MISTAKES = {
    r"options: ([^-\s][^,\s]*).* Available subcommands: (.*)": r"takes no \1, but \2",
    r"Unrecognized options: (.*?) Perhaps you meant: (--\S+).*": r"takes no \1; did you mean \2?",
    r"Unrecognized options: (.*)": r"takes no \1",
    r"Error parsing (\S+): .*int\(\).*: ('.*') Argument help": r"\1 must be an integer, found \2",
    r"Error parsing (\S+): .* float: ('.*') Argument help": r"\1 must be a number, found \2",
    r"Error parsing (\S+): .*arguments: \[(.*)\] Argument": r"\1 must be numbers, found \2",
    r"Error parsing (\S+): (.*?) Argument helptext: ": r"\1: \2",
}
"""Patterns of the messages of the parser, and what is printed for each."""


def _one_line(message: str, name: str) -> str:
    """The parser's message, drawn as a box under a title, as one line with the valid values."""
    _, *lines = _BOX.sub(" ", _STYLE.sub("", message)).strip().splitlines()
    text = " ".join(" ".join(lines).split())
    pointer = _POINTER.search(text)
    command = pointer[1] if pointer else name
    text = _POINTER.sub("", text)
    if "(required)" in text and "Unrecognized" not in text:
        # "Missing from ...: DATA The dataset file. (required) --out FOLDER The folder. (required)"
        pieces = text.partition(": ")[2].split("(required)")
        text = "needs " + " and ".join(each.split()[0] for each in pieces if each)
    for pattern, printed in _MISTAKES.items():
        if match := re.search(pattern, text):
            text = match.expand(printed)
            break
    return f"{command}: {text} (see contactgraph {command} --help)"

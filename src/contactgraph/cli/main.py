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
            return tyro.cli(
                _command(name),
                prog=f"contactgraph {name}",
                args=rest,
                config=_CONFIG,
            )
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
        raise InvalidInputError(_unknown(name, _names()))
    return command


def _unknown(name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"no command {name!r}; the commands are {', '.join(names)}{hint}"


def _overview() -> str:
    lines = []
    for name in _names():
        try:
            summary = (_command(name).__doc__ or "").strip().split("\n\n")[0]
        except InvalidInputError as error:
            summary = f"(not available: {error})"
        lines.append(f"  {name:<12}{' '.join(summary.split())}")
    return "\n".join(
        [
            "usage: contactgraph COMMAND ...",
            "",
            "Learn which objects touch when, and control through contact.",
            "",
            "commands:",
            *lines,
            "",
            "contactgraph COMMAND --help describes the options of a command;",
            "contactgraph info lists the shipped models and the tasks;",
            "contactgraph --version prints the version.",
        ]
    )


def _keep_compiled_programs() -> None:
    """Let JAX keep compiled programs between calls, in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "contactgraph"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


_STYLE = re.compile(r"\x1b\[[0-9;]*m")
# The parser draws boxes from other characters if standard output is not Unicode.
_BOX = re.compile(r"[╭╮╰╯│─┄┈╌]+|-{4,}|^[|+]-?(?=\s)|[|+]$", re.MULTILINE)
_POINTER = re.compile(r" ?For full helptext, (?:run|see):? contactgraph (?P<command>.+?) --help.*")
_SUBCOMMAND = re.compile(
    r"Unrecognized options: (?P<found>[^-\s][^,\s]*).* Available subcommands: (?P<valid>.*)"
)
_UNKNOWN = re.compile(r"Unrecognized options: (?P<found>.*?)(?: Perhaps you meant: (?P<near>.*))?$")
_MISSING = re.compile(r"Missing from [^:]*: (?P<pieces>.*)")
_BAD_VALUE = re.compile(r"Error parsing (?P<option>\S+?): (?P<reason>.*?) Argument helptext: ")
_BAD_NUMBER = re.compile(r".*(?P<type>int\(\)|float).*: (?P<found>'.*')")
_BAD_NUMBERS = re.compile(r".*tuple\[float, \.\.\.\].* arguments: \[(?P<found>.*)\]")
_TYPES = {"int()": "an integer", "float": "a number"}


def _one_line(message: str, name: str) -> str:
    """The parser's message, drawn as a box under a title, as one line with the valid values."""
    _, *lines = _BOX.sub(" ", _STYLE.sub("", message)).strip().splitlines()
    text = " ".join(" ".join(lines).split())
    pointer = _POINTER.search(text)
    command = pointer["command"] if pointer else name
    text = _POINTER.sub("", text)
    if match := _SUBCOMMAND.search(text):
        valid = [f"{command} {each.strip()}" for each in match["valid"].split(",")]
        return _unknown(f"{command} {match['found']}", valid)
    return f"{_mistake(text, command)} (see contactgraph {command} --help)"


def _mistake(text: str, command: str) -> str:
    if match := _UNKNOWN.search(text):
        # "--stps, 3 Perhaps you meant: --steps INT Optimiser steps."
        near = re.search(r"--\S+", match["near"] or "")
        hint = f"; did you mean {near[0]}?" if near else ""
        return f"{command} does not take {match['found'].replace(',', '')}{hint}"
    if match := _MISSING.search(text):
        # "DATA The dataset file. (required) --out FOLDER The folder. (required)"
        pieces = [piece.split() for piece in match["pieces"].split("(required)")]
        return f"{command} needs {' and '.join(piece[0] for piece in pieces if piece)}"
    if match := _BAD_VALUE.search(text):
        if number := _BAD_NUMBER.fullmatch(match["reason"]):
            return f"{match['option']} must be {_TYPES[number['type']]}, found {number['found']}"
        if numbers := _BAD_NUMBERS.fullmatch(match["reason"]):
            return f"{match['option']} must be numbers, found {numbers['found']}"
        return f"{match['option']}: {match['reason']}"
    return f"{command}: {text}"

"""One readable line from what the argument parser says about a command that it cannot read.

The parser draws a box for people with time; a script's log, and most people, want one line.
"""

import re

_STYLE = re.compile(r"\x1b\[[0-9;]*m")
# Renderable with other signs where standard output is not Unicode.
_BOX = re.compile(r"[╭╮╰╯│─┄┈╌]+|-{4,}|^[|+]-?(?=\s)|[|+]$", re.MULTILINE)
_POINTER = re.compile(r" ?For full helptext, (run|see).*")
_UNKNOWN = re.compile(r"Unrecognized options: (?P<found>.*?)(?: Perhaps you meant: (?P<near>.*))?$")
_MISSING = re.compile(r"Missing from [^:]*: (?P<pieces>.*)")
_NO_VALUE = re.compile(r"Missing value for argument '(?P<option>[^']+)'")
_BAD_VALUE = re.compile(r"Error parsing (?P<option>\S+?): (?P<reason>.*?) Argument helptext: ")
_BAD_NUMBER = re.compile(r".*(?P<kind>int\(\)|float).*: (?P<found>'.*')")
_BAD_NUMBERS = re.compile(r".*tuple\[float, \.\.\.\].* arguments: \[(?P<found>.*)\]")
_KINDS = {"int()": "an integer", "float": "a number"}


def one_line(said: str, command: str, commands: tuple[str, ...]) -> str:
    """What is wrong, what would be valid, and where to read more.

    `said` is the parser's own text, `command` the word in a command's place, `commands` those
    there are.
    """
    if command not in commands:
        return f"no command {command!r}; the commands are {', '.join(commands)}"
    text = " ".join(_BOX.sub(" ", _STYLE.sub("", said)).split())
    return f"{_mistake(_POINTER.sub('', text), command)} (see contactgraph {command} --help)"


def _mistake(text: str, command: str) -> str:
    if match := _UNKNOWN.search(text):
        # "--stps, 3 Perhaps you meant: --steps INT Optimiser steps. in contactgraph train --help"
        near = re.search(
            rf"(--\S+) (?:(?!in contactgraph).)*in contactgraph {command} ", match["near"] or ""
        )
        hint = f"; did you mean {near[1]}?" if near else ""
        return f"{command} does not take {match['found'].replace(',', '')}{hint}"
    if match := _MISSING.search(text):
        # "DATA The dataset file. (required) --out FOLDER The folder. (required)"
        pieces = [piece.split() for piece in match["pieces"].split("(required)")]
        return f"{command} needs {' and '.join(piece[0] for piece in pieces if piece)}"
    if match := _NO_VALUE.search(text):
        return f"{match['option']} needs a value"
    if match := _BAD_VALUE.search(text):
        if number := _BAD_NUMBER.fullmatch(match["reason"]):
            return f"{match['option']} must be {_KINDS[number['kind']]}, found {number['found']}"
        if numbers := _BAD_NUMBERS.fullmatch(match["reason"]):
            return f"{match['option']} must be numbers, found {numbers['found']}"
        return f"{match['option']}: {match['reason']}"
    return text

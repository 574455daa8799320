"""Completion by the shell: a real bash completes commands, options and files."""

import ast
import re
import shutil
import subprocess
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from contactgraph.cli.main import _names, run

ASK = """
source completion.bash
ask() {
  COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); _tyro_contactgraph
  echo "${COMPREPLY[*]}"
}
ask contactgraph co
ask contactgraph train --win
ask contactgraph control pickup pickup --distr
ask contactgraph robot che
ask contactgraph train data
complete -p contactgraph
ask contactgraph train --
"""


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the script of each shell."""
    folder = tmp_path_factory.mktemp("completion")
    for shell in ("bash", "zsh", "fish"):
        with (folder / f"completion.{shell}").open("w") as file, redirect_stdout(file):
            assert run(["--completion", shell]) == 0
    return folder


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes(scripts: Path) -> None:
    done = subprocess.run(
        ["bash", "-c", ASK], cwd=scripts, capture_output=True, text=True, check=True
    )
    *answers, command, options = done.stdout.splitlines()
    assert answers == ["collect control", "--window-length", "--distractors", "check", ""]
    assert "-o default" in command  # files, since nothing else fits data
    assert all(each.startswith("--") for each in options.split()), "texts must not be options"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_knows_every_command(shell: str, scripts: Path) -> None:
    text = (scripts / f"completion.{shell}").read_text()
    found = re.search(r"^COMPLETION_SPEC = (.*)$", text, re.MULTILINE)
    assert found is not None
    # The script of fish quotes the table once more.
    spec = re.sub(r"\\([\"$\\])", r"\1", found[1]) if shell == "fish" else found[1]
    assert sorted(ast.literal_eval(spec)["subcommands"]) == sorted(_names())


def test_another_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--completion"], ["--completion", "ksh"]):
        assert run(words) == 2
        assert "--completion must be one of bash, zsh, fish" in capsys.readouterr().err

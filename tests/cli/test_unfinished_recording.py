"""An interrupted recording continues and ends in the file of an uninterrupted one."""

from pathlib import Path

import h5py
import pytest

from contactgraph import parallel
from contactgraph.cli import collect as collect_command
from contactgraph.cli import main as cli
from contactgraph.data import read_trajectories
from contactgraph.envs import episodes as collecting

COMMAND = ["collect", "pickup", "--episodes", "7", "--seed", "3", "--exploration", "0.3", "--out"]


class Interrupter:
    """Records as ever, until Ctrl-C is pressed in the run of a number."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.made, self.at = 0, -1
        self._run_episode = collecting.run_episode
        patch.setattr(collecting, "run_episode", self)

    def __call__(self, *arguments):
        if self.made == self.at:
            self.at = -1
            raise KeyboardInterrupt
        self.made += 1
        return self._run_episode(*arguments)


@pytest.fixture
def interrupter(monkeypatch: pytest.MonkeyPatch) -> Interrupter:
    # On a slow machine, other processes would record, where no one is interrupted.
    monkeypatch.setattr(parallel, "_ALONE_S", float("inf"))
    return Interrupter(monkeypatch)


def unfinished(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.unfinished-*"))


def contents(path: Path) -> dict[str, object]:
    """All arrays and attributes of a dataset file, by path."""
    found: dict[str, object] = {}

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        value = item[()].tolist() if isinstance(item, h5py.Dataset) else None
        found[name] = value, dict(item.attrs)

    with h5py.File(path) as file:
        file.visititems(look)
    return found


@pytest.mark.parametrize("every_s", [0.0, 1e9], ids=["file a run", "all in one file"])
def test_twice_interrupted_it_is_the_same_file_and_no_episode_is_recorded_twice(
    tmp_path: Path,
    interrupter: Interrupter,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    every_s: float,
) -> None:
    monkeypatch.setattr(collect_command, "_SAVE_INTERVAL_S", every_s)
    whole, parts = tmp_path / "whole.h5", tmp_path / "parts.h5"
    assert cli.run([*COMMAND, str(whole)]) == 0
    interrupter.made = 0
    for at in (2, 5):
        interrupter.at = at
        assert cli.run([*COMMAND, str(parts)]) == 130
        (folder,) = unfinished(tmp_path)
        said = capsys.readouterr().err.splitlines()
        assert said[-2] == f"{folder}: {at} episodes are kept; the same command continues"
        assert not parts.exists()
    assert cli.run([*COMMAND, str(parts)]) == 0
    assert interrupter.made == 7
    assert capsys.readouterr().out.startswith(f"{parts}: goes on after 5 of 7 episodes\n")
    assert unfinished(tmp_path) == []
    assert contents(parts) == contents(whole)


def test_other_episodes_start_over_and_keep_the_old_ones(
    tmp_path: Path, interrupter: Interrupter
) -> None:
    out = tmp_path / "x.h5"
    interrupter.at = 3
    assert cli.run([*COMMAND, str(out)]) == 130
    (folder,) = unfinished(tmp_path)
    interrupter.made = 0
    assert cli.run([*COMMAND, str(out), "--seed", "4"]) == 0
    assert interrupter.made == 7 and unfinished(tmp_path) == [folder]


def test_unreadable_episodes_are_recorded_again(
    tmp_path: Path, interrupter: Interrupter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collect_command, "_SAVE_INTERVAL_S", 0.0)
    out = tmp_path / "x.h5"
    interrupter.at = 4
    assert cli.run([*COMMAND, str(out)]) == 130
    (folder,) = unfinished(tmp_path)
    (folder / "000002.h5").write_bytes(b"half")
    interrupter.made = 0
    assert cli.run([*COMMAND, str(out)]) == 0
    assert interrupter.made == 5 and len(read_trajectories(out)) == 7

"""Atomic writes: the order of disk operations, and files after a failure."""

import os
from pathlib import Path

import pytest

from contactgraph.data import InvalidInputError, atomic_write


def test_the_file_is_on_disk_before_it_is_renamed_and_the_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    fsync, replace = os.fsync, Path.replace

    def recorded_fsync(descriptor: int) -> None:
        calls.append(("fsync", Path(f"/proc/self/fd/{descriptor}").readlink()))
        fsync(descriptor)

    def recorded_replace(path: Path, target: Path) -> Path:
        calls.append(("replace", path, path.read_text(), target))
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", recorded_fsync)
    monkeypatch.setattr(Path, "replace", recorded_replace)
    path = tmp_path / "a.json"
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert calls == []
    assert calls == [
        ("fsync", temporary),
        ("replace", temporary, "new", path),
        ("fsync", tmp_path),
    ]
    assert temporary.parent == tmp_path and path.read_text() == "new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file_and_no_other(tmp_path: Path, error: type) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(error), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_folders_that_do_not_exist_and_paths_that_are_folders(tmp_path: Path) -> None:
    for path, message in (
        (tmp_path / "no" / "a.json", r"folder \S+ does not exist"),
        (tmp_path, "must be a file, found a folder"),
    ):
        with pytest.raises(InvalidInputError, match=message), atomic_write(path):
            pass

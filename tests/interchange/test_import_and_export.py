"""The commands import and export: their outputs, and their mistakes in one line."""

import sys
from pathlib import Path

import pytest
from recordings import lerobot_folder, mcap_file

from contactgraph.cli.main import run

MAP = """
dimension = 2
[time]
dt = 0.1
[[body]]
name = "ball"
position = ["x", "y"]
velocity = ["vx", "vy"]
"""


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert run(arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_inspect_map_and_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out, draft = tmp_path / "a.csv", tmp_path / "a.h5", tmp_path / "map.toml"
    rows = "".join(f"{t},{t / 2},1,7,0\n" for t in range(20))
    source.write_text(f"ball.x,ball.y,skip,vx,vy\n{rows}")
    assert run(["import", "csv", str(source), "--inspect"]) == 0
    printed = capsys.readouterr().out
    assert "#   ball.x[1]  0 to 19, 20 rows" in printed
    draft.write_text(printed)
    assert run(["import", "csv", str(source), "--map", str(draft), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "a.h5: 1 trajectories of ball" in said.out
    assert said.err == ""
    draft.write_text(MAP.replace('"x", "y"', '"ball.x", "ball.y"'))
    assert run(["import", "csv", str(source), "--map", str(draft), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "velocities contradict positions in 1 of 1 trajectories, by 52 %" in said.err
    assert "leave velocity out of the map" in said.err


def test_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "a.csv", str(tmp_path / "a.h5")
    source.write_text("x,y\n1,2\n2,3\n")
    line = ["import", "csv", str(source)]
    assert "import needs --map and --out, or --inspect; maps" in refused(line, capsys)
    said = refused([*line, "--map", "fetch", "--out", out], capsys)
    assert "fetch: no such map; maps that ship are fetch-pick-and-place, fetch-push" in said
    said = refused([*line, "--map", "pusht", "--out", out], capsys)
    assert "body[0]: position: no column 'observation.state[0:2]'; there are x[1], y[1]" in said
    said = refused(["import", "bag", str(source), "--inspect"], capsys)
    assert "FORMAT must be one of minari, lerobot, csv, rosbag, robomimic; found 'bag'" in said
    said = refused(["import", "csv", str(tmp_path / "b"), "--inspect"], capsys)
    assert "b: does not exist" in said
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.csv"]


@pytest.mark.parametrize(
    ("kind", "make", "library", "extra"),
    [("lerobot", lerobot_folder, "duckdb", "lerobot"), ("rosbag", mcap_file, "rosbags", "rosbag")],
)
def test_a_missing_extra_is_named(
    kind: str, make, library: str, extra: str, tmp_path: Path, capsys, monkeypatch
) -> None:
    source = make(tmp_path / "source.mcap")
    for name in [each for each in sys.modules if each.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    said = refused(["import", kind, str(source), "--inspect"], capsys)
    assert f"pip install 'contactgraph[{extra}]'" in said

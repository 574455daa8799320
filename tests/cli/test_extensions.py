"""Entry points that cannot be loaded, and models with parts of one's own."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import pytest

from contactgraph.cli import main as cli
from contactgraph.model import ModelConfig
from contactgraph.model.io import save_model

ENTRY_POINTS = """\
[contactgraph.commands]
stale = no_such_module:Stale
nameless = contactgraph.data:NoSuchName
number = math:pi
[contactgraph.tasks]
stale-task = no_such_module:TASK
"""
OWN_MODEL = """\
import dataclasses
from contactgraph.model import NoCutoff, PRESETS

class OwnCutoff(NoCutoff):
    pass

def build(config, *, key):
    return dataclasses.replace(PRESETS["ours-recurrent"](config, key=key), cutoff=OwnCutoff())
"""


@pytest.fixture
def other_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed metadata whose entry points cannot be loaded."""
    metadata = tmp_path / "other-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("stale", "stale: entry point no_such_module:Stale cannot be loaded: No module named"),
        ("stale --help", "stale: entry point no_such_module:Stale cannot be loaded: No module"),
        ("nameless", "nameless: entry point contactgraph.data:NoSuchName cannot be loaded: mod"),
        ("number", "number: entry point math:pi cannot be loaded: it must be a class, found 3.1"),
        ("collect stale-task --out a.h5", "stale-task: entry point no_such_module:TASK cannot be"),
    ],
)
def test_an_entry_point_that_cannot_be_loaded_is_named(
    arguments: str, said: str, other_package: None, mistake: Callable
) -> None:
    line = mistake(*arguments.split())
    assert line.startswith(said) and line.endswith("; reinstall other")


def test_other_commands_and_tasks_remain(
    other_package: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run([]) == cli.run(["info"]) == cli.run(["train", "--help"]) == 0
    output, error = capsys.readouterr()
    assert error == ""
    for line in (
        "  stale       (not available: stale: entry point no_such_module:Stale cannot be loaded",
        "  stale-task            not available: stale-task: entry point no_such_module:TASK",
        "  evaluate    ",
        "  pickup                A gripper ",
    ):
        assert f"\n{line}" in output


@pytest.fixture
def own_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A model with a part of its own, in the run folder ``run`` of the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "another_model.py").write_text(OWN_MODEL)
    monkeypatch.syspath_prepend(tmp_path)
    import another_model

    config = ModelConfig(2, 2, 0.05, 0.1)
    model = another_model.build(config, key=jax.random.key(0))
    (tmp_path / "run").mkdir()
    save_model(tmp_path / "run/model.safetensors", model, "another_model:build", config)
    yield "another_model:build@run"
    sys.modules.pop("another_model", None)


def test_commands_take_a_model_with_custom_parts(
    own_model: str,
    fresh: Path,
    recorded: Path,
    interrupted: Callable,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To train, it is named by its function; a report gives its argument to other commands."""
    learnings = interrupted("contactgraph.control.learn_cost")
    assert cli.run(["learn-cost", own_model, str(fresh), "--out", "cost.json"]) == 130
    trainings, preset = interrupted("contactgraph.train.fit"), own_model.partition("@")[0]
    assert cli.run(["train", str(recorded), "--out", "new", "--model", preset]) == 130
    for model in (learnings[0].arguments[0], trainings[0].arguments[0].model):
        assert type(model.cutoff).__name__ == "OwnCutoff"
    monkeypatch.setattr("contactgraph.cli.collect.Collect.run", lambda command: None)
    evaluations = interrupted("contactgraph.cli.evaluate.Evaluate.run")
    assert cli.run(["report", own_model]) == 130
    assert evaluations[0].arguments[0].model == own_model
    assert Path("run/report/cells").is_dir(), "the page belongs to the run folder"


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ("run", "has parts of your own; give their preset, another_model:build"),
        ("another_model:build@gone", "gone: no such run folder or model file; models that ship"),
        ("another_model:gone@run", "--model another_model:gone: module 'another_model' has no at"),
    ],
)
def test_a_wrong_name_of_such_a_model_is_refused(
    model: str, said: str, own_model: str, fresh: Path, mistake: Callable
) -> None:
    assert said in mistake("learn-cost", model, fresh, "--out", "cost.json")

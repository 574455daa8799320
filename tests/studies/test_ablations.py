"""The ablations of `benchmarks/ablations.py` take out what the library has today."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from ablations import ABLATIONS, PACKAGE, Ablation


@pytest.mark.parametrize("ablation", ABLATIONS, ids=lambda each: each.name)
def test_it_replaces_one_expression_and_leaves_python(ablation: Ablation, tmp_path: Path) -> None:
    copy = tmp_path / ablation.file
    copy.parent.mkdir(parents=True)
    before = (PACKAGE / ablation.file).read_text(encoding="utf-8")
    copy.write_text(before, encoding="utf-8")
    ablation.apply(tmp_path)
    after = copy.read_text(encoding="utf-8")
    assert after != before
    compile(after, ablation.file, "exec")


def test_an_expression_that_is_gone_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "law.py").write_text("_LEAST = 1\n")
    with pytest.raises(ValueError, match=r"no damper: law\.py has 0 of"):
        Ablation("no damper", "law.py", "_LEAST = 2", "_LEAST = 3").apply(tmp_path)

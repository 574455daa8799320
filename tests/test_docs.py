"""The documents are true: code runs, links lead somewhere, commands parse, files exist."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import pytest

from contactgraph.cli.main import parse
from docs_script import script

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *ROOT.glob("docs/*.md")]
)
TOP = {"src", "tests", "examples", "benchmarks", "docs", "results", ".ci"}
"""Folders at the root: a path in `code` that begins with one must exist."""

FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
IMAGE = re.compile(r'<img[^>]*\ssrc="([^"]+)"')
CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
SHELL = {"bash", "sh", "shell", "console", ""}


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path, languages: set[str]) -> list[str]:
    fences = FENCE.findall(page.read_text(encoding="utf-8"))
    return [content for language, content in fences if language in languages]


def prose(page: Path) -> str:
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def commands(page: Path) -> Iterator[list[str]]:
    """Arguments of every `contactgraph` command line in a page's blocks."""
    for block in blocks(page, SHELL):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.removeprefix("$ "), comments=True)
            # Lines with alternatives or omissions are grammar, not commands.
            if words[:1] == ["contactgraph"] and not re.search(r"[\[\]|…<>]|\.\.\.", line):
                yield words[1:]


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    heads = re.findall(r"^#+ +(.+)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", head.lower()) for head in heads)
    return {head.strip().replace(" ", "-") for head in plain}


@pytest.mark.slow
@pytest.mark.parametrize("page", [each for each in PAGES if blocks(each, {"python"})], ids=name)
def test_python_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page run in order in one namespace, so a block may use an earlier one."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    namespace: dict[str, object] = {"__name__": "__main__"}
    for number, block in enumerate(blocks(page, {"python"}), start=1):
        exec(compile(block, f"{name(page)}, python block {number}", "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_relative_links_lead_somewhere(page: Path) -> None:
    text = prose(page)
    for target in LINK.findall(text) + IMAGE.findall(text):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        leads_to = (page.parent / file) if file else page
        assert leads_to.exists(), f"{name(page)} links to {target}"
        if anchor and leads_to.suffix == ".md":
            assert anchor in anchors(leads_to), f"{name(page)} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_command_lines_parse(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in commands(page):
        parsed = parse(words)
        said = capsys.readouterr().err
        assert not isinstance(parsed, int) or words[-1] == "--help", f"{words}: {said}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_make_targets_and_files_exist(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    text = "\n".join(blocks(page, SHELL)) + "\n" + "\n".join(CODE.findall(prose(page)))
    for target in re.findall(r"^make ([a-z-]+)", text, re.MULTILINE):
        assert target in targets, f"{name(page)}: make {target}"
    for code in CODE.findall(prose(page)):
        path = code.split("::")[0].rstrip("/")
        if path.split("/")[0] in TOP and re.fullmatch(r"[\w./*-]+", path):
            assert list(ROOT.glob(path)), f"{name(page)} names {code}"


def test_the_documents_use_every_command() -> None:
    """Without a match of the pattern, no command line would be tested."""
    used = {words[0] for page in PAGES for words in commands(page)}
    others = {"reproduce", "report", "robot", "info", "import", "export", "play"}
    assert used == {"collect", "train", "evaluate", "control", "learn-cost", *others}


@pytest.mark.parametrize("words", [["train"], ["collect", "pickup"], ["control", "--seed", "x"]])
def test_a_wrong_command_line_does_not_parse(words: list[str]) -> None:
    assert parse(words) == 2


MEASURED = [ROOT / "README.md", ROOT / "docs" / "results.md"]


@pytest.mark.parametrize("page", MEASURED, ids=name)
def test_every_figure_of_a_table_is_a_cell_of_a_measured_table(page: Path) -> None:
    tables, text = script("tables"), page.read_text(encoding="utf-8")
    assert tables.with_tables(text) == text, "python docs/tables.py writes the tables"
    others = [line for line in tables.TABLE.sub("", text).splitlines() if line.startswith("|")]
    assert not [line for line in others if re.search(r"\d", line)]


def test_a_figure_that_no_measured_table_holds_is_noticed() -> None:
    tables, text = script("tables"), MEASURED[1].read_text(encoding="utf-8")
    changed = re.sub(r"(\| `pickup` \| \**)[\d.]+", r"\g<1>0.0099", text, count=1)
    assert changed != text and tables.with_tables(changed) == text
    with pytest.raises(SystemExit, match=r"results\.csv has no row juggling"):
        tables.with_tables(text.replace("rows: pickup;", "rows: juggling;", 1))


def test_a_newcomer_reads_the_first_page_and_the_changes_in_minutes() -> None:
    visible = re.sub(r"<!--.*?-->", "", MEASURED[0].read_text(encoding="utf-8"), flags=re.DOTALL)
    assert 450 <= len(visible.split()) <= 600
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(changes.splitlines()) <= 60 and len(changes.split()) <= 700

"""Every public name is listed in docs/terms.md with the source of the term."""

import ast
import re
from pathlib import Path

import contactgraph

ROOT = Path(__file__).parent.parent
SOURCE = ROOT / "src"
LIBRARY = (
    *("data", "bodies", "model", "large_scenes", "identify", "train", "control", "envs"),
    *("interchange", "policies", "evaluate", "viz", "play"),
)
ARM = ("safety", "loop", "perception", "sim")
PACKAGES = [
    *(f"contactgraph/{each}" for each in LIBRARY),
    *(f"contactgraph_franka/{each}" for each in ARM),
]
CODE = re.compile(r"`([^`]+)`")


def exported(package: str) -> set[str]:
    """Names that a package's `__init__` exports by `from module import Name as Name`."""
    tree = ast.parse((SOURCE / package / "__init__.py").read_text("utf-8"))
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    return {each.asname for node in imports for each in node.names if each.asname}


def defined() -> set[str]:
    """Names of all modules, classes, functions, fields and arguments below `src`."""
    names: set[str] = set()
    for path in SOURCE.rglob("*.py"):
        names.add(path.stem)
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                names.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add(node.id)
            elif isinstance(node, ast.arg):
                names.add(node.arg)
    return names


def rows() -> list[list[str]]:
    """Cells of every row of the tables: term, code, meaning, source."""
    lines = (ROOT / "docs" / "terms.md").read_text("utf-8").splitlines()
    tables = [line for line in lines if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in tables]
    return [row for row in cells if row[0] != "term"]


def test_every_public_name_has_a_term() -> None:
    listed = {name for row in rows() for name in CODE.findall(row[1])}
    missing = {package: sorted(exported(package) - listed) for package in PACKAGES}
    assert not any(missing.values()), f"docs/terms.md lacks {missing}"


def test_every_name_of_the_package_itself_has_a_term() -> None:
    plots = ast.parse((SOURCE / "contactgraph" / "plot.py").read_text("utf-8")).body
    functions = {each.name for each in plots if isinstance(each, ast.FunctionDef)}
    public = {f"plot.{name}" for name in functions if not name.startswith("_")}
    listed = {name for row in rows() for name in CODE.findall(row[1])}
    assert not {*contactgraph.__all__, *public} - listed


def test_every_row_is_complete() -> None:
    for row in rows():
        assert len(row) == 4, f"docs/terms.md: a row needs 4 cells: {row}"
        assert all(row), f"docs/terms.md: a row has an empty cell: {row}"


def test_every_listed_name_is_in_the_code() -> None:
    known = defined() | set(contactgraph.__all__)
    for row in rows():
        for name in CODE.findall(row[1]):
            unknown = [part for part in name.split(".") if part not in known]
            assert not unknown, f"docs/terms.md: {name} is not in the code"


def test_terms_are_unique() -> None:
    terms = [row[0] for row in rows()]
    assert len(terms) == len(set(terms))

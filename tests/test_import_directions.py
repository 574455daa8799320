"""Imports go one way: between the packages, between modules, and out to heavy libraries."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import contactgraph

ROOT = Path(contactgraph.__file__).parent

LIBRARY = {"data", "model", "train", "control", "cluster", "tasks", "robot"}
ALLOWED = {
    "data": set(),
    "model": {"data"},
    "train": {"data", "model"},
    "control": {"data", "model"},
    "cluster": {"data"},
    "tasks": {"data", "cluster"},
    "robot": {"data"},
    "rehearsal": {"data", "tasks", "robot"},
    "evaluate": LIBRARY,
    "reproduce": LIBRARY | {"evaluate", "view", "rehearsal"},
    "view": LIBRARY | {"evaluate"},
    "commands": LIBRARY | {"evaluate", "reproduce", "view", "rehearsal"},
    "cli": LIBRARY | {"evaluate", "reproduce", "view", "rehearsal", "commands"},
    "worker": {"cli", "reproduce"},
    "__main__": {"cli"},
}
"""What each package may import besides itself."""

HEAVY = {
    "Box2D",
    "franky",
    "franky_sim",
    "imageio_ffmpeg",
    "lerobot",
    "libusb_package",
    "minari",
    "mujoco",
    "pyapriltags",
    "pyarrow",
    "pyrealsense2",
    "ray",
    "rerun",
    "viser",
}
"""Libraries that are slow to import or optional: each has one module that knows it."""

Imports = dict[str, set[str]]


def module_name(path: Path, root: Path) -> str:
    parts = (root.name, *path.relative_to(root).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def read_imports(root: Path) -> Imports:
    """For every module below `root`, the modules that it imports, wherever in its text."""
    files = {module_name(path, root): path for path in sorted(root.rglob("*.py"))}
    return {
        name: {
            target
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            for target in targets(node, name, path.name == "__init__.py", set(files))
        }
        for name, path in files.items()
    }


def targets(node: ast.AST, name: str, is_package: bool, modules: set[str]) -> set[str]:
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    if not isinstance(node, ast.ImportFrom):
        return set()
    source = node.module or ""
    if node.level:
        above = name.split(".")
        above = above[: len(above) - node.level + is_package]
        source = ".".join([*above, *([source] if source else [])])
    # `from package import module` is an import of that module, not of the package.
    inner = {f"{source}.{alias.name}" for alias in node.names}
    return {full if full in modules else source for full in inner}


def wrong_directions(imports: Imports) -> list[str]:
    wrong = []
    for name, found in imports.items():
        package = name.split(".")[1] if "." in name else None
        for target in sorted(found):
            if target.split(".")[0] != "contactgraph":
                continue
            other = target.split(".")[1] if "." in target else None
            # The root package holds only the version, and imports nobody (tested below).
            if package is None or other is None or package == other:
                continue
            if other in ALLOWED.get(package, set()):
                continue
            wrong.append(f"{name} imports {target}")
    return wrong


def cycle(imports: Imports) -> list[str]:
    """The modules of one cycle, or none."""
    graph = {name: found & set(imports) for name, found in imports.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def heavy_importers(imports: Imports) -> dict[str, list[str]]:
    return {
        library: [
            name
            for name, found in imports.items()
            if any(target.split(".")[0] == library for target in found)
        ]
        for library in sorted(HEAVY)
    }


def test_every_package_is_known() -> None:
    found = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    found |= {path.stem for path in ROOT.glob("*.py")} - {"__init__"}
    assert found <= set(ALLOWED), "a new package needs its place in ALLOWED"


def test_packages_import_only_what_they_may() -> None:
    assert wrong_directions(read_imports(ROOT)) == []


def test_the_root_package_imports_none_of_its_parts() -> None:
    assert not any(t.startswith("contactgraph.") for t in read_imports(ROOT)["contactgraph"])


def test_no_two_modules_import_each_other() -> None:
    assert cycle(read_imports(ROOT)) == []


def test_a_heavy_library_is_imported_in_one_module() -> None:
    importers = heavy_importers(read_imports(ROOT))
    assert {library: names for library, names in importers.items() if len(names) > 1} == {}
    assert importers["Box2D"], "the check has lost sight of Box2D"


@pytest.mark.parametrize(
    ("files", "wrong"),
    [
        ({"data/a.py": "import contactgraph.model"}, "contactgraph.data.a imports contactgraph.m"),
        (
            {"tasks/a.py": "def f():\n    from contactgraph.control import mpc"},
            "contactgraph.envs.a imports contactgraph.control",
        ),
        (
            {"control/a.py": "from contactgraph import train", "train/__init__.py": ""},
            "contactgraph.control.a imports contactgraph.train",
        ),
        ({"model/a.py": "from ..train import fit"}, "contactgraph.model.a imports contactgraph.tr"),
    ],
)
def test_wrong_directions_are_found(files: dict[str, str], wrong: str, tmp_path: Path) -> None:
    found = wrong_directions(read_imports(written(tmp_path, files)))
    assert len(found) == 1 and found[0].startswith(wrong)


def test_cycles_and_second_importers_are_found(tmp_path: Path) -> None:
    files = {
        "data/__init__.py": "from contactgraph.data.a import f as f",
        "data/a.py": "from contactgraph.data import b",
        "data/b.py": "def g():\n    from .a import f\n    import Box2D.b2",
        "tasks/a.py": "from Box2D import b2World",
    }
    imports = read_imports(written(tmp_path, files))
    assert set(cycle(imports)) == {"contactgraph.data.a", "contactgraph.data.b"}
    assert heavy_importers(imports)["Box2D"] == ["contactgraph.data.b", "contactgraph.envs.a"]


def written(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = folder / "contactgraph" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder / "contactgraph"

"""Budgets of the code: size, direction of imports, modules and frames behind a step, wording."""

import ast
import re
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SRC = ROOT / "src"

_STEP = {
    "contactgraph.data",
    "contactgraph.bodies",
    "contactgraph.inference",
    "contactgraph.dynamics",
}
"""The paper's two modules, which know nothing of each other, and what stands beneath them."""
MAY_IMPORT = {
    "contactgraph.data": set(),
    "contactgraph.feedback": set(),
    "contactgraph.parallel": {"contactgraph.data", "contactgraph.ray_cluster"},
    "contactgraph.ray_cluster": {"contactgraph.data", "contactgraph.parallel"},
    "contactgraph.bodies": {"contactgraph.data"},
    "contactgraph.inference": {"contactgraph.data", "contactgraph.bodies"},
    "contactgraph.dynamics": {"contactgraph.data", "contactgraph.bodies"},
    "contactgraph.model": _STEP,
    "contactgraph.large_scenes": {*_STEP, "contactgraph.model"},
    "contactgraph.identify": {*_STEP, "contactgraph.model"},
    "contactgraph.train": {*_STEP, "contactgraph.model"},
    "contactgraph.relations": {*_STEP, "contactgraph.model", "contactgraph.train"},
    "contactgraph.control": {*_STEP, "contactgraph.feedback", "contactgraph.model"},
    "contactgraph.envs": {
        "contactgraph.data",
        "contactgraph.interchange",
        "contactgraph.parallel",
    },
    "contactgraph.interchange": {"contactgraph.data"},
}
"""Packages that stand below others, and the packages that each of them may import."""

WINGS = {
    "contactgraph.relations": set[str](),
    "contactgraph.large_scenes": {"contactgraph.evaluate", "contactgraph.cli"},
}
"""Packages that a preset's name or an argument leads to, so that nobody reads them who does not use
them, and those that may import them: none of the core."""

LIBRARY_TOP = [
    *("contactgraph.policies", "contactgraph.evaluate", "contactgraph.viz", "contactgraph.plot"),
    *("contactgraph.play", "contactgraph.cli", "contactgraph.gym", "contactgraph"),
]
"""These may import each other only in this order, and everything that stands below."""

HEAVY = {
    "Box2D",
    "duckdb",
    "franky",
    "franky_sim",
    "gym_pusht",
    "gymnasium_robotics",
    "imageio_ffmpeg",
    "libusb_package",
    "mujoco",
    "pyapriltags",
    "pymunk",
    "pyrealsense2",
    "ray",
    "rosbags",
    "websockets",
}
"""Libraries that are slow to import or optional: one module knows each of them."""

FILES = {"contactgraph": 209, "contactgraph_franka": 60, "contactgraph_studies": 27}
LINES = {"contactgraph": 38_445, "contactgraph_franka": 8_932, "contactgraph_studies": 4_600}
ROOMS = {
    "contactgraph/control": 5_818,
    "contactgraph/policies": 869,
    "contactgraph/envs": 5_577,
    "contactgraph/cli": 2_935,
    "contactgraph/evaluate": 2_713,
}
"""Lines of folders. All budgets only fall: who needs lines takes them from the same room."""
LONGEST_FILE = 400
"""100 to 250 lines are usual."""
MODULES_BEHIND = {
    "contactgraph.model.contact_dynamics": 19,  # a prediction step
    "contactgraph.train.fit": 41,  # a training step, its held-out error and signs of a dead network
    "contactgraph.control.active_set": 42,  # a control step
}
FRAMES = 16
"""Calls from the command `contactgraph control` to the first one in the model, in a plan."""

QUESTION = re.compile(r"(What|How|Where|Which|Who)\b")

Imports = dict[str, set[str]]


def module_name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules(root: Path) -> dict[str, Path]:
    return {module_name(path, root): path for path in sorted(root.rglob("*.py"))}


def imported_names(path: Path, module: str) -> Iterator[tuple[str, str | None]]:
    """Module and name of every import, wherever it stands in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                package = (
                    module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
                )
                above = package[: len(package) - node.level + 1]
                source = ".".join([*above, *([source] if source else [])])
            yield from ((source, alias.name) for alias in node.names)


def read_imports(root: Path) -> Imports:
    """For every module below `root`, the modules that it imports."""
    files = modules(root)
    return {
        module: {
            full if name and (full := f"{source}.{name}") in files else source
            for source, name in imported_names(path, module)
        }
        for module, path in files.items()
    }


def package_of(module: str) -> str:
    """`contactgraph.model` of `contactgraph.model.graph`; the other packages count as one each."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "contactgraph" else parts[0]


def wrong_directions(imports: Imports) -> list[str]:
    wrong = []
    for module, found in imports.items():
        package = package_of(module)
        for target in sorted(found):
            other = package_of(target)
            if not other.startswith("contactgraph") or other in (package, "contactgraph"):
                continue
            if package in MAY_IMPORT:
                allowed = other in MAY_IMPORT[package]
            elif package in LIBRARY_TOP:
                below = LIBRARY_TOP[: LIBRARY_TOP.index(package)]
                allowed = other in MAY_IMPORT or other in below
            elif package == "contactgraph_franka":
                allowed = other != "contactgraph_studies"
            else:
                allowed = package in ("contactgraph_studies", "contactgraph.__main__")
            if not allowed:
                wrong.append(f"{module} imports {target}")
    return wrong


def cycle(imports: Imports) -> list[str]:
    """The modules of one cycle of imports, or none."""
    graph = {name: found & set(imports) for name, found in imports.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def importers(imports: Imports, library: str) -> list[str]:
    return [
        module
        for module, found in imports.items()
        if any(target.split(".")[0] == library for target in found)
    ]


def behind(start: str, root: Path = SRC) -> set[str]:
    """Modules of ours that `start` needs; a re-exported name counts as its defining module."""
    files = modules(root)

    def defining(source: str, name: str | None) -> str:
        if name is None or source not in files:
            return source
        if f"{source}.{name}" in files:
            return f"{source}.{name}"
        if files[source].name == "__init__.py":
            for inner, exported in imported_names(files[source], source):
                if exported == name:
                    return defining(inner, name)
        return source

    needed: set[str] = set()
    left = [start]
    while left:
        module = left.pop()
        if module not in needed and module in files:
            needed.add(module)
            left += [defining(*each) for each in imported_names(files[module], module)]
    return needed


def line_count(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def test_imports_go_one_way() -> None:
    assert wrong_directions(read_imports(SRC)) == []


@pytest.mark.parametrize("wing", sorted(WINGS))
def test_the_core_imports_no_wing(wing: str) -> None:
    imports = read_imports(SRC)
    assert wing in imports
    inside = {module for module in imports if package_of(module) == wing}
    outside = {package_of(module) for module, found in imports.items() if found & inside} - {wing}
    assert outside <= WINGS[wing]


def test_no_module_is_part_of_a_cycle() -> None:
    assert cycle(read_imports(SRC)) == []


def test_one_module_imports_a_heavy_library() -> None:
    imports = read_imports(SRC)
    several = {library: found for library in HEAVY if len(found := importers(imports, library)) > 1}
    assert several == {}
    assert importers(imports, "Box2D"), "the check must find the module that imports Box2D"


@pytest.mark.parametrize("package", sorted(FILES))
def test_a_package_keeps_its_size(package: str) -> None:
    files = list((SRC / package).rglob("*.py"))
    assert len(files) <= FILES[package]
    assert sum(map(line_count, files)) <= LINES[package]


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_room_keeps_its_size(room: str) -> None:
    assert sum(map(line_count, (SRC / room).rglob("*.py"))) <= ROOMS[room]


def test_no_file_is_long() -> None:
    long = {str(path): line_count(path) for path in SRC.rglob("*.py")}
    assert {path: lines for path, lines in long.items() if lines > LONGEST_FILE} == {}


@pytest.mark.parametrize("module", sorted(MODULES_BEHIND))
def test_few_modules_stand_behind_a_step(module: str) -> None:
    assert module in modules(SRC)
    assert len(behind(module)) <= MODULES_BEHIND[module], sorted(behind(module))


def test_no_module_docstring_begins_with_a_question_word() -> None:
    docs = {
        module: ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        for module, path in modules(SRC).items()
    }
    assert [module for module, doc in docs.items() if QUESTION.match(doc)] == []
    assert [module for module, doc in docs.items() if not doc] == []


class _StackRead(Exception):
    """Ends the command once the stack has been read."""


def test_the_command_is_near_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    from contactgraph.cli.main import run
    from contactgraph.control import rollout

    stack: list[str] = []

    def watched(*arguments: object) -> None:
        frame = sys._getframe(1)
        while frame is not None:
            module = frame.f_globals.get("__name__", "")
            if module.startswith("contactgraph."):
                stack.append(f"{module}:{frame.f_code.co_qualname}")
            frame = frame.f_back
        raise _StackRead

    monkeypatch.setattr(rollout, "take_step", watched)
    # No other test has this horizon: a program compiled before would not be traced again.
    with pytest.raises(_StackRead):
        run(["control", "pickup", "pickup", "--episodes", "1", "--horizon", "7"])
    assert len(stack) <= FRAMES, "\n".join(reversed(stack))


@pytest.mark.parametrize(
    ("files", "wrong"),
    [
        (
            {"contactgraph/data/a.py": "import contactgraph.model"},
            "contactgraph.data.a imports contactgraph.model",
        ),
        (
            {"contactgraph/envs/a.py": "def f():\n    from contactgraph.control import mpc"},
            "contactgraph.envs.a imports contactgraph.control",
        ),
        (
            {"contactgraph/viz/a.py": "from ..cli import b", "contactgraph/cli/b.py": ""},
            "contactgraph.viz.a imports contactgraph.cli.b",
        ),
        (
            {"contactgraph/cli/a.py": "import contactgraph_studies.runner"},
            "contactgraph.cli.a imports contactgraph_studies.runner",
        ),
        (
            {"contactgraph_franka/a.py": "from contactgraph_studies import b"},
            "contactgraph_franka.a imports contactgraph_studies",
        ),
    ],
)
def test_a_wrong_direction_is_reported(files: dict[str, str], wrong: str, tmp_path: Path) -> None:
    assert wrong_directions(read_imports(written(tmp_path, files))) == [wrong]


def test_cycles_importers_and_re_exports_are_reported(tmp_path: Path) -> None:
    root = written(
        tmp_path,
        {
            "contactgraph/data/__init__.py": "from contactgraph.data.a import f as f",
            "contactgraph/data/a.py": "from contactgraph.data import b",
            "contactgraph/data/b.py": "def g():\n    from .a import f\n    import Box2D.b2",
            "contactgraph/envs/a.py": "from Box2D import b2World\nfrom contactgraph.data import f",
        },
    )
    imports = read_imports(root)
    assert set(cycle(imports)) == {"contactgraph.data.a", "contactgraph.data.b"}
    assert importers(imports, "Box2D") == ["contactgraph.data.b", "contactgraph.envs.a"]
    assert behind("contactgraph.envs.a", root) == {
        "contactgraph.envs.a",
        "contactgraph.data.a",
        "contactgraph.data.b",
    }


def written(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root

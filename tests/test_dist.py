"""The wheel and the source archive hold the whole package, and the wheel runs where it is alone."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("contactgraph", "contactgraph_franka", "contactgraph_studies")
USE = """
from importlib.metadata import distribution

import contactgraph
from contactgraph.viz import ReportData
from contactgraph.viz.report import page

print(contactgraph.__file__)
print(sorted(each.name for each in distribution("contactgraph").entry_points))
print(contactgraph.load("pickup"))
print("report-data" in page(ReportData("title", "summary")))
"""


def files(folder: Path) -> set[str]:
    """Files of the packages, relative to their parent folder."""
    found = (path for package in PACKAGES for path in (folder / package).rglob("*"))
    kept = (path for path in found if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(folder).as_posix() for path in kept}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of ``make dist``, from a copy of the sources, beside which a build writes."""
    copy = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    shutil.copytree(
        ROOT / "src", copy / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__")
    )
    done = subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation"],
        cwd=copy,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return copy / "dist"


def test_the_wheel_has_every_file_of_the_packages(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    names = {each for each in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in each}
    assert names == files(ROOT / "src")
    assert any(each.startswith("contactgraph/pretrained/") for each in names)


def test_the_source_archive_has_them_and_the_licence(built: Path) -> None:
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {each.partition("/")[2] for each in opened.getnames()}
    assert {f"src/{each}" for each in files(ROOT / "src")} <= names
    assert {"LICENSE", "README.md", "pyproject.toml"} <= names


def test_the_wheel_installs_from_a_folder_and_runs(built: Path, tmp_path: Path) -> None:
    target = tmp_path / "installed"
    from_folder = ["--no-index", "--find-links", str(built), "--no-deps", "--target", str(target)]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", *from_folder, "contactgraph"],
        check=True,
        capture_output=True,
    )
    done = subprocess.run(
        [sys.executable, "-c", USE],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(target), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    where, *lines = done.stdout.splitlines()
    assert str(target) in where
    assert lines == [
        "['contactgraph', 'franka', 'reproduce', 'robot']",
        "ContactDynamics(DurationEdges, D=2, U=2, dt=0.05 s)",
        "True",
    ]

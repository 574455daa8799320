"""Checks that the core's dependencies resolve to wheels on every supported Python and processor.

Usage: python .ci/check_wheels.py [--all]

Linux on x86-64 and on ARM, Python 3.11 to 3.14, are checked; with --all also 3.15, macOS and
Windows, where a gap is told and no failure. pip evaluates markers, and the Pythons that a package
asks for, for the Python that runs it; so this evaluates the project's own markers, and goes by the
tags of wheels.
"""

import subprocess
import sys
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PLATFORMS = {
    "Linux x86_64": [f"manylinux_2_{minor}_x86_64" for minor in (5, 12, 17, 27, 28)],
    "Linux aarch64": [f"manylinux_2_{minor}_aarch64" for minor in (17, 27, 28)],
    "Darwin arm64": [f"macosx_{major}_0_arm64" for major in (11, 12, 13, 14)],
    "Windows AMD64": ["win_amd64"],
}
REQUIRED = [(f"3.{minor}", name) for minor in (11, 12, 13, 14) for name in list(PLATFORMS)[:2]]
OTHERS = [(f"3.{minor}", name) for minor in (11, 14, 15) for name in PLATFORMS]


def missing(python: str, name: str) -> list[str]:
    """The requirements that no wheels fulfil."""
    system, machine = name.split()
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "platform_system": system,
        "platform_machine": machine,
        "sys_platform": {"Linux": "linux", "Darwin": "darwin", "Windows": "win32"}[system],
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = [Requirement(each) for each in project["dependencies"]]
    wanted = [
        f"{each.name}{each.specifier}"
        for each in found
        if each.marker is None or each.marker.evaluate(environment)
    ]
    if resolves(wanted, python, name):
        return []
    return [each for each in wanted if not resolves([each], python, name)] or ["all together"]


def resolves(requirements: list[str], python: str, name: str) -> bool:
    """Whether pip finds wheels for them and for what they need; it downloads none."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed"]
        command += ["--quiet", "--disable-pip-version-check", "--only-binary=:all:"]
        command += ["--ignore-requires-python"]
        command += ["--target", folder, "--python-version", python, "--implementation", "cp"]
        command += [f"--platform={platform}" for platform in PLATFORMS[name]]
        return subprocess.run([*command, *requirements], capture_output=True).returncode == 0


def main() -> int:
    """Prints a line for each combination; 1 where a required one has a gap."""
    asked = [*REQUIRED, *(each for each in OTHERS if each not in REQUIRED)]
    asked = asked if "--all" in sys.argv[1:] else REQUIRED
    failed = False
    with ThreadPoolExecutor(4) as pool:
        for each, gap in zip(asked, pool.map(missing, *zip(*asked, strict=True)), strict=True):
            found = f"no wheels for {', '.join(gap)}" if gap else "wheels"
            print(f"Python {each[0]}, {each[1]}: {found}", flush=True)
            failed = failed or (bool(gap) and each in REQUIRED)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

"""Compile `pendulum_action.cpp` into the environment that runs this, which holds crocoddyl."""

import subprocess
import sysconfig
from pathlib import Path

SOURCE = Path(__file__).with_name("pendulum_action.cpp")


def main() -> None:
    """Build the module; `subprocess.CalledProcessError` or `OSError` where that fails."""
    paths = sysconfig.get_paths()
    packages = Path(paths["purelib"])
    prefix = packages / "cmeel.prefix"
    python = f"boost_python{sysconfig.get_config_var('py_version_nodot')}"
    command = ["g++", "-O3", "-DNDEBUG", "-std=c++17", "-shared", "-fPIC", "-w", str(SOURCE)]
    command += ["-o", str(packages / "pendulum_action.so")]
    command += [f"-I{each}" for each in (paths["include"], prefix / "include")]
    command += [f"-I{prefix / 'include' / 'eigen3'}", f"-L{prefix / 'lib'}"]
    command += ["-lcrocoddyl", f"-l{python}", "-Wl,-rpath,$ORIGIN/cmeel.prefix/lib"]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main()

"""Where a result comes from: versions, and the fingerprint of a file."""

import contextlib
import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("contactgraph", "jax", "equinox", "optax", "numpy", "box2d", "mujoco")


def provenance() -> dict[str, dict[str, str]]:
    """Versions of Python and of the packages that shape a result; of MuJoCo where it is there."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return {"versions": found}


def sha256(path: Path) -> str:
    """The file's fingerprint."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

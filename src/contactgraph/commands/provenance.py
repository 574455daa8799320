"""Where a result comes from: versions, and the fingerprint of a file."""

import hashlib
import platform
from importlib.metadata import version
from pathlib import Path

_PACKAGES = ("contactgraph", "jax", "equinox", "optax", "numpy", "box2d")


def provenance() -> dict[str, dict[str, str]]:
    """Versions of Python and of the packages that shape a result."""
    found = {"python": platform.python_version()}
    return {"versions": {**found, **{name: version(name) for name in _PACKAGES}}}


def sha256(path: Path) -> str:
    """The file's fingerprint."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

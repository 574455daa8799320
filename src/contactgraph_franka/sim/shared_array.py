"""Arrays in files that several processes map."""

from pathlib import Path

import numpy as np


def create_shared(path: Path, kind: np.dtype, count: int) -> np.ndarray:
    """[count] zeros that whoever opens ``path`` sees change."""
    return np.asarray(np.memmap(path, kind, mode="w+", shape=(count,)))


def open_shared(path: Path, kind: np.dtype, write: bool = False) -> np.ndarray:
    """What `create_shared` made, without copying."""
    return np.asarray(np.memmap(path, kind, mode="r+" if write else "r"))

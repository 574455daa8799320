"""An object that carries tags: which, how large, and where on it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError

CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""[4, 3] of a tag of size 1 in its own frame, in the order in which detectors tell them."""
_ROUNDING = 1e-4
"""How far from a rotation a stored matrix may be."""


@dataclass(frozen=True, eq=False)
class Tag:
    """One tag36h11 on an object."""

    id: int
    size: float
    """m: the side of the black square."""
    pose: np.ndarray
    """[4, 4], in the object's frame. In the tag's own, x points right and y up as one reads it,
    and z out of it, towards the reader."""

    def __post_init__(self) -> None:
        if not (isinstance(self.id, int) and 0 <= self.id < 587):
            raise InvalidInputError(f"id of a tag36h11 must be 0 to 586, found {self.id!r}")
        if not (np.isfinite(self.size) and 0.001 <= self.size <= 10.0):
            raise InvalidInputError(f"size of tag {self.id} must be 0.001 to 10 m: {self.size}")
        object.__setattr__(self, "pose", np.array(self.pose, dtype=np.float64))
        check_pose(f"pose of tag {self.id}", self.pose)

    @property
    def corners(self) -> np.ndarray:
        """[4, 3] m in the object's frame: lower left, lower right, upper right, upper left."""
        return CORNERS * self.size @ self.pose[:3, :3].T + self.pose[:3, 3]


@dataclass(frozen=True, eq=False)
class TaggedObject:
    """A rigid object with tags on it. Raises `InvalidInputError` for none, or one id twice."""

    tags: tuple[Tag, ...]

    def __post_init__(self) -> None:
        ids = [tag.id for tag in self.tags]
        if not ids or len(set(ids)) != len(ids):
            raise InvalidInputError(f"tags must be at least one, with different ids, found {ids}")

    @property
    def by_id(self) -> Mapping[int, Tag]:
        """The tags by their ids."""
        return {tag.id: tag for tag in self.tags}


def single_tag(tag: int, size: float) -> TaggedObject:
    """An object whose frame is that of its one tag, ``size`` m."""
    return TaggedObject((Tag(tag, size, np.eye(4)),))


def check_pose(name: str, pose: np.ndarray) -> None:
    """Raises `InvalidInputError` where ``pose`` is not a rigid motion [4, 4]."""
    if np.shape(pose) != (4, 4) or not np.isfinite(pose).all():
        raise InvalidInputError(f"{name} must be [4, 4] finite numbers, found {np.shape(pose)}")
    turn = pose[:3, :3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() < _ROUNDING and np.linalg.det(turn) > 0.0
    if not rigid or not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise InvalidInputError(f"{name} must be a rotation and a position over (0, 0, 0, 1)")

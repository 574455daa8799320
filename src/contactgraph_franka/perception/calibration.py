"""An object that carries tags: which, how large, and where on it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, atomic_write
from contactgraph.data.json_fields import JsonFields, check_version, parse_json
from contactgraph_franka.perception.camera import Intrinsics

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


FORMAT = "contactgraph-camera"
VERSION = 1
_SIZE_LIMIT = 1_000_000
"""Bytes."""
_WORDS = {
    "camera_pose": "4 x 4, camera to the robot's base [m]; the camera's x right, y down, z forward",
    "intrinsics": "px; pixel centres at whole numbers; distortion k1, k2, p1, p2, k3, or null",
    "objects": "tags of the family tag36h11: side of the black square [m], pose 4 x 4 in the "
    "object's frame; a tag's x right, y up, z out of it",
    "residuals": "of the calibration; null where the camera's pose is known otherwise",
}


@dataclass(frozen=True)
class CalibrationResiduals:
    """How well a calibration explains what it was made from."""

    poses: int
    """Of the hand."""
    pixel: float
    """px: root of the mean square distance of the corners from where they should be."""
    position: float
    """m: the same of the tag's position, told by the camera and by the hand."""
    left_out: float
    """m: the same for each pose by a calibration from all others: what to expect elsewhere."""
    left_out_worst: float
    """m"""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A camera that stands still, and the objects it looks for.

    Raises `InvalidInputError` where the pose is no rigid motion, a name is empty, or one tag is on
    two objects.
    """

    intrinsics: Intrinsics
    camera_pose: np.ndarray
    """[4, 4]: camera to the robot's base."""
    objects: Mapping[str, TaggedObject]
    """By the names of the nodes that they are."""
    made: str
    """When, as ISO 8601 says it."""
    residuals: CalibrationResiduals | None = None
    """None where the camera's pose was not found by `calibrate`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera_pose", np.array(self.camera_pose, dtype=np.float64))
        check_pose("camera_pose", self.camera_pose)
        owner: dict[int, str] = {}
        for name, tagged in self.objects.items():
            if not name:
                raise InvalidInputError("the name of an object must not be empty")
            for tag in tagged.by_id:
                if owner.setdefault(tag, name) != name:
                    raise InvalidInputError(f"tag {tag} is on {owner[tag]!r} and on {name!r}")
        try:
            datetime.fromisoformat(self.made)
        except ValueError as error:
            raise InvalidInputError(
                f"made must be a time such as 2026-01-31T12:00:00+00:00, found {self.made!r}"
            ) from error


def write_calibration(path: str | Path, calibration: CameraCalibration) -> None:
    """Writes to ``path``; whoever looks sees the old file or the whole new one, never half.

    Raises `InvalidInputError` where the folder cannot be written to.
    """
    content = {
        "format": FORMAT,
        "format_version": VERSION,
        "in_words": _WORDS,
        "made": calibration.made,
        "intrinsics": asdict(calibration.intrinsics),
        "camera_pose": calibration.camera_pose.tolist(),
        "residuals": None if calibration.residuals is None else asdict(calibration.residuals),
        "objects": [
            {
                "name": name,
                "tags": [
                    {"id": tag.id, "size": tag.size, "pose": tag.pose.tolist()}
                    for tag in tagged.tags
                ],
            }
            for name, tagged in calibration.objects.items()
        ],
    }
    with atomic_write(Path(path)) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_calibration(path: str | Path) -> CameraCalibration:
    """Reads what `write_calibration` wrote; nothing in the file is executed.

    Raises `InvalidInputError` naming file and field for whatever is wrong with it.
    """
    path = Path(path)
    if not path.exists():
        raise InvalidInputError(f"{path}: does not exist")
    if not path.is_file() or path.stat().st_size > _SIZE_LIMIT:
        raise InvalidInputError(f"{path}: must be a file of at most {_SIZE_LIMIT} bytes")
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InvalidInputError(
            f"{path}: must be a camera's calibration (JSON), found something else or a damaged "
            f"file ({reason})"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InvalidInputError(
            f"{path}: must be a camera's calibration, whose 'format' is {FORMAT!r}"
        )
    check_version(f"{path}: field", content, VERSION)
    fields = JsonFields(str(path), content)
    try:
        return _calibration(fields)
    except InvalidInputError as error:
        said = str(error)
        raise InvalidInputError(
            said if said.startswith(f"{path}") else f"{path}: {said}"
        ) from error


def _calibration(fields: JsonFields) -> CameraCalibration:
    objects: dict[str, TaggedObject] = {}
    for each in fields.each("objects"):
        name = each.text("name")
        if name in objects:
            raise InvalidInputError(f"{each.where}: there is another object called {name!r}")
        objects[name] = TaggedObject(tuple(_tag(tag) for tag in each.each("tags")))
    known = fields.content.get("residuals") is not None
    return CameraCalibration(
        intrinsics=_intrinsics(fields.inner("intrinsics")),
        camera_pose=fields.numbers("camera_pose", (4, 4)),
        objects=objects,
        made=fields.text("made"),
        residuals=_residuals(fields.inner("residuals")) if known else None,
    )


def _intrinsics(fields: JsonFields) -> Intrinsics:
    bent = fields.content.get("distortion") is not None
    return Intrinsics(
        fx=float(fields.numbers("fx", ())),
        fy=float(fields.numbers("fy", ())),
        cx=float(fields.numbers("cx", ())),
        cy=float(fields.numbers("cy", ())),
        width=fields.count("width", 1),
        height=fields.count("height", 1),
        distortion=tuple(fields.numbers("distortion", (5,)).tolist()) if bent else None,
    )


def _residuals(fields: JsonFields) -> CalibrationResiduals:
    numbers: dict[str, Any] = {
        name: float(fields.numbers(name, ()))
        for name in ("pixel", "position", "left_out", "left_out_worst")
    }
    return CalibrationResiduals(poses=fields.count("poses", 1), **numbers)


def _tag(fields: JsonFields) -> Tag:
    return Tag(
        fields.count("id", 0), float(fields.numbers("size", ())), fields.numbers("pose", (4, 4))
    )

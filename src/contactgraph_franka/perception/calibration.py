"""Tagged objects, the calibration of a fixed camera, and the file that stores it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError, atomic_write
from contactgraph.data.files import JsonFields, read_json_fields
from contactgraph_franka.perception.camera import Intrinsics, check_pose, transform

CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""[4, 3] of a tag of size 1 in its own frame, in the order of the detector."""
FORMAT = "contactgraph-camera"
VERSION = 1
_SIZE_LIMIT = 1_000_000  # Bytes
_WORDS = {
    "camera_pose": "4 x 4, camera to the robot's base [m]; the camera's x right, y down, z forward",
    "intrinsics": "px; pixel centres at whole numbers; distortion k1, k2, p1, p2, k3, or null",
    "objects": "tags of the family tag36h11: side of the black square [m], pose 4 x 4 in the "
    "object's frame; a tag's x right, y up, z out of it",
    "residuals": "of the calibration; null where the camera's pose is known otherwise",
}


@dataclass(frozen=True, eq=False)
class Tag:
    """One tag36h11 on an object. Raises `InvalidInputError` for impossible values."""

    id: int
    size: float
    """m: the side of the black square."""
    pose: np.ndarray
    """[4, 4], in the object's frame. The tag's x points right and y up as printed, z towards the
    reader."""

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
        return transform(self.pose, CORNERS * self.size)


@dataclass(frozen=True, eq=False)
class TaggedObject:
    """A rigid object with tags. Raises `InvalidInputError` for no tags or a repeated id."""

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


@dataclass(frozen=True)
class CalibrationResiduals:
    """Errors of a calibration on its own data."""

    poses: int
    """Number of hand poses."""
    pixel: float
    """px: root mean square error of the tag's corners."""
    position: float
    """m: root mean square distance between the tag's positions by camera and by hand."""
    left_out: float
    """m: the same by leave-one-out cross-validation, the error to expect at other poses."""
    left_out_worst: float
    """m: its largest value."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A fixed camera and the objects to detect.

    Raises `InvalidInputError` if the pose is no rigid motion, a name is empty, or one tag is on
    two objects.
    """

    intrinsics: Intrinsics
    camera_pose: np.ndarray
    """[4, 4]: camera to the robot's base."""
    objects: Mapping[str, TaggedObject]
    """By node name."""
    made: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    """ISO 8601 time."""
    residuals: CalibrationResiduals | None = None
    """None if the pose is not from `calibrate`."""

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
    """Writes to ``path`` atomically; raises `InvalidInputError` if the folder is not writable."""
    objects = [
        {
            "name": name,
            "tags": [
                {"id": tag.id, "size": tag.size, "pose": tag.pose.tolist()} for tag in tagged.tags
            ],
        }
        for name, tagged in calibration.objects.items()
    ]
    content = {
        "format": FORMAT,
        "format_version": VERSION,
        "in_words": _WORDS,
        "made": calibration.made,
        "intrinsics": asdict(calibration.intrinsics),
        "camera_pose": calibration.camera_pose.tolist(),
        "residuals": None if calibration.residuals is None else asdict(calibration.residuals),
        "objects": objects,
    }
    with atomic_write(Path(path)) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_calibration(path: str | Path) -> CameraCalibration:
    """Reads a file of `write_calibration`; executes nothing in it.

    Raises `InvalidInputError` that names file and field for any invalid content.
    """
    what = "a camera's calibration"
    fields = read_json_fields(Path(path), what, FORMAT, VERSION, _SIZE_LIMIT)
    try:
        return _calibration(fields)
    except InvalidInputError as error:
        where = "" if str(error).startswith(f"{path}") else f"{path}: "
        raise InvalidInputError(f"{where}{error}") from error


def _calibration(fields: JsonFields) -> CameraCalibration:
    objects: dict[str, TaggedObject] = {}
    for each in fields.each("objects"):
        name = each.text("name")
        if name in objects:
            raise InvalidInputError(f"{each.where}: there is another object called {name!r}")
        tags = [
            Tag(tag.count("id", 0), tag.number("size"), tag.numbers("pose", (4, 4)))
            for tag in each.each("tags")
        ]
        objects[name] = TaggedObject(tuple(tags))
    residuals = None
    if fields.content.get("residuals") is not None:
        inner = fields.inner("residuals")
        names = ("pixel", "position", "left_out", "left_out_worst")
        residuals = CalibrationResiduals(inner.count("poses", 1), *map(inner.number, names))
    lens = fields.inner("intrinsics")
    distorted = lens.content.get("distortion") is not None
    fx, fy, cx, cy = map(lens.number, ("fx", "fy", "cx", "cy"))
    width, height = (lens.count(name, 1) for name in ("width", "height"))
    distortion = tuple(lens.numbers("distortion", (5,)).tolist()) if distorted else None
    intrinsics = Intrinsics(fx, fy, cx, cy, width, height, distortion)
    camera_pose = fields.numbers("camera_pose", (4, 4))
    return CameraCalibration(intrinsics, camera_pose, objects, fields.text("made"), residuals)

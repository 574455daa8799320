"""Import maps: TOML files that say which columns of a recording are bodies, control and goal."""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from importlib.resources import files
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.files import JsonFields
from contactgraph.interchange.map_entries import (
    Entries,
    array_at,
    check_keys,
    entries_at,
    entries_of,
    optional,
    positive_at,
)
from contactgraph.interchange.recording import check_file

MAX_GAP = 0.5
"""s: a longer gap of the measurements ends a trajectory."""
_LARGEST_MAP = 2**20
_SHIPPED = files("contactgraph.interchange") / "maps"
_CONSTANTS = ("gravity", "planes", "pins", "pin_points", "candidate_edges")
_OF_BODY = ("mass", "radius", "size", "anchor", "reach")


@dataclass(frozen=True, eq=False)
class Turn:
    """The orientation of a body: an angle, a quaternion in this order, or Euler angles."""

    entries: Entries
    order: str = ""
    """Of a quaternion; empty: that which the recording tells."""
    euler: str = ""
    """SciPy's notation."""
    axis: str = ""
    """About which a quaternion turns a body of the plane; empty: ``z``."""
    turned_by: np.ndarray | None = None
    """[4] quaternion (w, x, y, z) by which what is tracked, such as a tag, is turned in the body's
    frame."""


@dataclass(frozen=True, eq=False)
class BodyMap:
    """One body."""

    name: str
    type: str
    position: Entries
    """D numbers; the keypoints' coordinates where there are ``keypoints``."""
    keypoints: np.ndarray | None = None
    """[V, D] m: points of the body in its own frame, whose places are recorded."""
    orientation: Turn | None = None
    velocity: Entries | None = None
    """None: backward differences of the positions."""
    angular_velocity: Entries | None = None
    relative_to: str | None = None
    """The body to whose position this one's is added."""
    in_frame_of: str | None = None
    """The body in whose frame, which turns with it, this one's pose is recorded."""
    missing: float | None = None
    """All recorded numbers of a position that was not measured."""
    max_speed: float | None = None
    """m/s that the body cannot have."""
    reference: np.ndarray | None = None
    """[D] m: the point of the body's frame that becomes the node's position."""
    actuated: bool = False
    static: bool | None = None
    """None: not known."""
    bounds: np.ndarray | None = None
    """[2, D] m: lower and upper corner of the space at whose end a trajectory ends."""
    tracked: Entries | None = None
    measured_at: Entries | None = None
    polygons: tuple[np.ndarray, ...] = ()
    constants: dict[str, np.ndarray] = field(default_factory=dict)
    """``mass``, ``radius``, ``size``, ``anchor`` and ``reach`` of `contactgraph.data.Scene`."""

    @property
    def base(self) -> str | None:
        """The body from which this one's position counts."""
        return self.relative_to if self.in_frame_of is None else self.in_frame_of


@dataclass(frozen=True, eq=False)
class ControlMap:
    """Components of the control."""

    entries: Entries
    kind: str
    bodies: tuple[str, ...]
    """On which they act; none: they move nothing by themselves."""


@dataclass(frozen=True, eq=False)
class PairMap:
    """Two bodies, and whether they touch."""

    bodies: tuple[str, ...]
    entries: Entries


@dataclass(frozen=True, eq=False)
class SceneMap:
    """The meaning of a recording's columns."""

    where: str
    dimension: int
    bodies: tuple[BodyMap, ...]
    controls: tuple[ControlMap, ...]
    goal: Entries | None
    contact: tuple[PairMap, ...]
    holding: tuple[PairMap, ...]
    dt: float | None
    time: Entries | None
    max_gap: float
    scene: dict[str, np.ndarray]
    """Constants of `contactgraph.data.Scene` by name."""
    environment: str = ""
    """Environments whose name begins so are described by this map."""


def shipped_maps() -> tuple[str, ...]:
    """Names of the maps that ship with the package."""
    names = (each.name for each in _SHIPPED.iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml")))


def shipped_map_text(name: str) -> str:
    """The TOML of a shipped map."""
    return (_SHIPPED / f"{name}.toml").read_text(encoding="utf-8")


def read_map(name: str) -> SceneMap:
    """The map in a TOML file, or the shipped one of this name.

    Raises `InvalidInputError`, which names the key, where it is missing, unknown or wrong.
    """
    path = Path(name)
    if not path.is_file() and name in shipped_maps():
        return parse_map(name, shipped_map_text(name))
    if not path.exists() and not path.suffix:
        raise InvalidInputError(
            f"{name}: no such map; maps that ship are {', '.join(shipped_maps())}"
        )
    check_file(path, _LARGEST_MAP)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path}: must be a text in UTF-8 ({error})") from error
    return parse_map(name, text)


def parse_map(where: str, text: str) -> SceneMap:
    """The map in a TOML text; ``where`` names it in errors."""
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InvalidInputError(f"{where}: must be TOML ({reason})") from error
    root = JsonFields(where, content)
    keys = ("dimension", "goal", "time", "body", "control", "contact", "holding", "environment")
    check_keys(root, *keys, *_CONSTANTS)
    time = root.inner("time") if "time" in content else JsonFields(where, {})
    check_keys(time, "dt", "columns", "scale", "offset", "max_gap")
    if "columns" not in time.content and {"scale", "offset"} & set(time.content):
        raise InvalidInputError(f"{where}: time: offset and scale need columns")
    found = SceneMap(
        where=where,
        dimension=root.count("dimension", 2),
        bodies=tuple(map(_body, root.each("body"))),
        controls=tuple(map(_control, optional(root, "control", JsonFields.each) or ())),
        goal=entries_at(root, "goal"),
        contact=tuple(map(_pair, optional(root, "contact", JsonFields.each) or ())),
        holding=tuple(map(_pair, optional(root, "holding", JsonFields.each) or ())),
        dt=optional(time, "dt", positive_at),
        time=entries_of(time, "dt", "max_gap") if "columns" in time.content else None,
        max_gap=optional(time, "max_gap", positive_at) or MAX_GAP,
        scene={name: array_at(root, name) for name in _CONSTANTS if name in content},
        environment=optional(root, "environment", JsonFields.text) or "",
    )
    for reason in _contradictions(found):
        raise InvalidInputError(reason)
    return found


def _contradictions(found: SceneMap) -> Iterator[str]:
    bodies = {body.name: body for body in found.bodies}
    if found.dimension not in (2, 3) or not bodies:
        yield f"{found.where}: dimension must be 2 or 3 and at least one [[body]] must be there"
    for body in found.bodies:
        where = f"{found.where}: {body.name}"
        bounds, shape = body.bounds, (2, found.dimension)
        if bounds is not None and bounds.shape != shape:
            yield f"{where}: bounds must have shape {shape}, found {bounds.shape}"
        if bounds is not None and not np.all(bounds[0] < bounds[1]):
            yield f"{where}: bounds must be the lower corner, then the upper one"
        if body.orientation is not None and body.orientation.axis and found.dimension == 3:
            yield f"{where}: axis is for bodies of the plane"
        if body.position.constant and body.missing is not None:
            yield f"{where}: missing is for recorded numbers"
        base = body.base
        if base is not None and (base not in bodies or bodies[base].base is not None):
            key = "relative_to" if body.in_frame_of is None else "in_frame_of"
            yield f"{where}: {key} must name a body in world coordinates, found {base!r}"
        for key in ("relative_to", "velocity", "angular_velocity"):
            if body.in_frame_of is not None and getattr(body, key) is not None:
                yield f"{where}: in_frame_of excludes {key}"
    for each in found.controls:
        for name in each.bodies:
            if name not in bodies or not bodies[name].actuated:
                where = each.entries.where
                yield f"{where}: body must name a body with actuated = true, found {name!r}"
    for name, body in bodies.items():
        if body.actuated and not any(name in each.bodies for each in found.controls):
            yield f"{found.where}: {name}: actuated = true needs a [[control]] with body = {name!r}"
    for pair in (*found.contact, *found.holding):
        if len(pair.bodies) != 2 or not set(pair.bodies) <= set(bodies):
            yield f"{pair.entries.where}: bodies must name two of {', '.join(bodies)}"


def _body(table: JsonFields) -> BodyMap:
    there = table.content
    own = [each.name for each in fields(BodyMap) if each.name != "constants"]
    check_keys(table, *own, *_OF_BODY)
    key = "keypoints" if "keypoints" in there else "position"
    entries = entries_at(table, key, ("points",))
    if entries is None or {"keypoints", "position"} <= set(there):
        raise InvalidInputError(f"{table.where}: must have either position or keypoints")
    if {"keypoints", "orientation"} <= set(there):
        raise InvalidInputError(f"{table.where}: keypoints tell the orientation as well")
    return BodyMap(
        name=table.text("name"),
        type=optional(table, "type", JsonFields.text) or "object",
        position=entries,
        keypoints=array_at(table.inner(key), "points") if key == "keypoints" else None,
        orientation=_turn(table),
        velocity=entries_at(table, "velocity"),
        angular_velocity=entries_at(table, "angular_velocity"),
        relative_to=optional(table, "relative_to", JsonFields.text),
        in_frame_of=optional(table, "in_frame_of", JsonFields.text),
        missing=optional(table, "missing", JsonFields.number),
        max_speed=optional(table, "max_speed", positive_at),
        reference=table.numbers("reference", (None,)) if "reference" in there else None,
        actuated=optional(table, "actuated", JsonFields.truth) or False,
        static=optional(table, "static", JsonFields.truth),
        bounds=table.numbers("bounds", (2, None)) if "bounds" in there else None,
        tracked=entries_at(table, "tracked"),
        measured_at=entries_at(table, "measured_at"),
        polygons=optional(table, "polygons", _polygons) or (),
        constants={name: array_at(table, name) for name in _OF_BODY if name in there},
    )


def _turn(table: JsonFields) -> Turn | None:
    entries = entries_at(table, "orientation", ("order", "euler", "axis", "turned_by"))
    if entries is None:
        return None
    value = table.content["orientation"]
    if not isinstance(value, dict):
        return Turn(entries)
    valid = {
        "order": ("wxyz", "xyzw"),
        "axis": ("x", "y", "z"),
        "euler": tuple(f"{a}{b}{c}" for s in ("xyz", "XYZ") for a in s for b in s for c in s),
    }
    given = {key: value[key] for key in valid if key in value}
    for key, text in given.items():
        if text not in valid[key]:
            raise InvalidInputError(
                f"{entries.where}: {key} must be {' or '.join(valid[key][:3])}, found {text!r}"
            )
    if "order" in given and "euler" in given:
        raise InvalidInputError(f"{entries.where}: order is for quaternions, euler for angles")
    mount = table.inner("orientation").numbers("turned_by", (4,)) if "turned_by" in value else None
    if mount is not None and not mount.any():
        raise InvalidInputError(f"{entries.where}: turned_by must not be zero")
    return Turn(entries, **given, turned_by=mount)


def _control(table: JsonFields) -> ControlMap:
    bodies = table.content.get("body", [])
    if bodies != []:
        bodies = table.names("body") if isinstance(bodies, list) else (table.text("body"),)
    return ControlMap(entries_of(table, "kind", "body"), table.text("kind"), tuple(bodies))


def _pair(table: JsonFields) -> PairMap:
    return PairMap(entries=entries_of(table, "bodies"), bodies=table.names("bodies"))


def _polygons(table: JsonFields, name: str) -> tuple[np.ndarray, ...]:
    outlines = table.content[name]
    if not isinstance(outlines, list):
        raise InvalidInputError(f"{table.where}: {name} must be a list of lists of points")
    inner = JsonFields(table.where, {f"{name}[{n}]": each for n, each in enumerate(outlines)})
    return tuple(inner.numbers(each, (None, None)) for each in inner.content)

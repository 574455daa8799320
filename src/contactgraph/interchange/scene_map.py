"""Import maps: TOML files that say which columns of a recording are bodies, control and goal."""

import tomllib
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.json_fields import JsonFields
from contactgraph.interchange.map_entries import (
    Entries,
    array_at,
    check_keys,
    entries_at,
    entries_of,
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
    """Of a quaternion; empty: that which the recording tells, else ``wxyz``."""
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
        text = shipped_map_text(name)
    elif not path.exists() and not path.suffix:
        raise InvalidInputError(
            f"{name}: no such map; maps that ship are {', '.join(shipped_maps())}"
        )
    else:
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
        controls=tuple(map(_control, _tables(root, "control"))),
        goal=entries_at(root, "goal"),
        contact=tuple(map(_pair, _tables(root, "contact"))),
        holding=tuple(map(_pair, _tables(root, "holding"))),
        dt=positive_at(time, "dt") if "dt" in time.content else None,
        time=entries_of(time, f"{where}: time") if "columns" in time.content else None,
        max_gap=positive_at(time, "max_gap") if "max_gap" in time.content else MAX_GAP,
        scene={name: array_at(root, name) for name in _CONSTANTS if name in content},
        environment=root.text("environment") if "environment" in content else "",
    )
    _check(found)
    return found


def _check(found: SceneMap) -> None:
    names = [body.name for body in found.bodies]
    if found.dimension not in (2, 3) or not names:
        raise InvalidInputError(
            f"{found.where}: dimension must be 2 or 3 and at least one [[body]] must be there"
        )
    bodies = {body.name: body for body in found.bodies}
    for body in found.bodies:
        if body.bounds is not None and body.bounds.shape != (2, found.dimension):
            raise InvalidInputError(
                f"{found.where}: {body.name}: bounds must have shape (2, {found.dimension}), "
                f"found {body.bounds.shape}"
            )
        if body.bounds is not None and not np.all(body.bounds[0] < body.bounds[1]):
            raise InvalidInputError(
                f"{found.where}: {body.name}: bounds must be the lower corner, then the upper one"
            )
        if body.orientation is not None and body.orientation.axis and found.dimension == 3:
            raise InvalidInputError(f"{found.where}: {body.name}: axis is for bodies of the plane")
        if body.position.constant is not None and body.missing is not None:
            raise InvalidInputError(f"{found.where}: {body.name}: missing is for recorded numbers")
        base = body.base
        if base is not None and (base not in bodies or bodies[base].base is not None):
            key = "relative_to" if body.in_frame_of is None else "in_frame_of"
            raise InvalidInputError(
                f"{found.where}: {body.name}: {key} must name a body in world coordinates, "
                f"found {base!r}"
            )
        recorded = {"relative_to": body.relative_to, "velocity": body.velocity}
        recorded["angular_velocity"] = body.angular_velocity
        for key, value in recorded.items():
            if body.in_frame_of is not None and value is not None:
                raise InvalidInputError(f"{found.where}: {body.name}: in_frame_of excludes {key}")
    for each in found.controls:
        for name in each.bodies:
            if name not in bodies or not bodies[name].actuated:
                raise InvalidInputError(
                    f"{each.entries.where}: body must name a body with actuated = true, "
                    f"found {name!r}"
                )
    for pair in (*found.contact, *found.holding):
        if len(pair.bodies) != 2 or not set(pair.bodies) <= set(names):
            raise InvalidInputError(
                f"{pair.entries.where}: bodies must name two of {', '.join(names)}"
            )


def _body(table: JsonFields) -> BodyMap:
    own = ("name", "type", "position", "keypoints", "orientation", "velocity", "angular_velocity")
    further = ("relative_to", "in_frame_of", "reference", "actuated", "static", "tracked")
    limits = ("measured_at", "missing", "max_speed", "bounds", "polygons")
    check_keys(table, *own, *further, *limits, *_OF_BODY)
    there = table.content
    keypoints = table.inner("keypoints") if "keypoints" in there else None
    if (keypoints is None) == ("position" not in there):
        raise InvalidInputError(f"{table.where}: must have either position or keypoints")
    if keypoints is not None:
        if "orientation" in there:
            raise InvalidInputError(f"{table.where}: keypoints tell the orientation as well")
        check_keys(keypoints, "columns", "scale", "offset", "points")
    entries = entries_at(table, "position" if keypoints is None else "keypoints", ("points",))
    assert entries is not None
    return BodyMap(
        name=table.text("name"),
        type=table.text("type") if "type" in there else "object",
        position=entries,
        keypoints=None if keypoints is None else array_at(keypoints, "points"),
        orientation=_turn(table),
        velocity=entries_at(table, "velocity"),
        angular_velocity=entries_at(table, "angular_velocity"),
        relative_to=table.text("relative_to") if "relative_to" in there else None,
        in_frame_of=table.text("in_frame_of") if "in_frame_of" in there else None,
        missing=table.number("missing") if "missing" in there else None,
        max_speed=positive_at(table, "max_speed") if "max_speed" in there else None,
        reference=table.numbers("reference", (None,)) if "reference" in there else None,
        actuated="actuated" in there and table.truth("actuated"),
        static=table.truth("static") if "static" in there else None,
        bounds=table.numbers("bounds", (2, None)) if "bounds" in there else None,
        tracked=entries_at(table, "tracked"),
        measured_at=entries_at(table, "measured_at"),
        polygons=_polygons(table) if "polygons" in there else (),
        constants={name: array_at(table, name) for name in _OF_BODY if name in there},
    )


def _turn(table: JsonFields) -> Turn | None:
    entries = entries_at(table, "orientation", ("order", "euler", "axis", "turned_by"))
    if entries is None:
        return None
    value = table.content["orientation"]
    if not isinstance(value, dict):
        return Turn(entries)
    given = {key: value[key] for key in ("order", "euler", "axis") if key in value}
    valid = {
        "order": ("wxyz", "xyzw"),
        "axis": ("x", "y", "z"),
        "euler": tuple(f"{a}{b}{c}" for s in ("xyz", "XYZ") for a in s for b in s for c in s),
    }
    for key, text in given.items():
        if text not in valid[key]:
            raise InvalidInputError(
                f"{entries.where}: {key} must be {' or '.join(valid[key][:3])}, found {text!r}"
            )
    if "order" in given and "euler" in given:
        raise InvalidInputError(f"{entries.where}: order is for quaternions, euler for angles")
    inner = table.inner("orientation")
    mount = inner.numbers("turned_by", (4,)) if "turned_by" in value else None
    if mount is not None and not mount.any():
        raise InvalidInputError(f"{entries.where}: turned_by must not be zero")
    return Turn(entries, **given, turned_by=mount)


def _control(table: JsonFields) -> ControlMap:
    check_keys(table, "columns", "scale", "offset", "kind", "body")
    body = table.content.get("body", [])
    several = table.names("body") if body and isinstance(body, list) else ()
    bodies = several if isinstance(body, list) else (table.text("body"),)
    return ControlMap(entries_of(table, table.where), table.text("kind"), bodies)


def _pair(table: JsonFields) -> PairMap:
    check_keys(table, "bodies", "columns", "scale", "offset")
    return PairMap(table.names("bodies"), entries_of(table, table.where))


def _tables(root: JsonFields, name: str) -> list[JsonFields]:
    return root.each(name) if name in root.content else []


def _polygons(table: JsonFields) -> tuple[np.ndarray, ...]:
    outlines = table.content["polygons"]
    if not isinstance(outlines, list):
        raise InvalidInputError(f"{table.where}: polygons must be a list of lists of points")
    named = {f"polygons[{index}]": each for index, each in enumerate(outlines)}
    inner = JsonFields(table.where, named)
    return tuple(inner.numbers(name, (None, None)) for name in named)

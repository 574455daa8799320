"""Measurements of bodies and controls, and the scene, read from an episode by its map."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.data.turns import quaternions_of, rotations
from contactgraph.interchange.map_entries import Entries, same_times
from contactgraph.interchange.recording import Column, Episode
from contactgraph.interchange.scene_map import BodyMap, SceneMap, Turn

_TINY = 1e-6
_ANGLES = {"roll": "x", "pitch": "y", "yaw": "z"}
STATE = ("position", "velocity", "orientation", "angular_velocity")
_MISFIT = 0.2
"""Of points that are not where they should be, root mean squares, relative to their distances from
the middle."""
_DEFINED = 0.067
"""Squared cosine of half a tilt, 150 degrees, above which a turn about an axis is too noisy."""


@dataclass(frozen=True, eq=False)
class MappedEpisode:
    """An episode with the map of its columns."""

    episode: Episode
    map: SceneMap
    dt: float
    row_dt: float | None = None
    """s from row to row, where the format has it and the rows have no times."""

    def times(self, column: Column) -> np.ndarray:
        """[S] s of a column's rows: those of the map, else of the recording, else its steps."""
        count, clock = len(column.values), self.map.time
        if clock is not None:
            found = clock.read(self.episode, 1)
            stamped = found.stamps is not None or column.stamps is not None
            if len(found.values) not in (count, count + 1) or (
                stamped and not same_times(found, column)
            ):
                raise InvalidInputError(
                    f"{clock.where}: must have a row for each of the others, {count}, at the same "
                    f"times, found {len(found.values)}"
                )
            return found.values[:count, 0]
        if column.stamps is not None:
            return column.stamps
        if self.episode.no_times:
            raise InvalidInputError(self.episode.no_times)
        steps = np.arange(count) if self.episode.steps is None else self.episode.steps[:count]
        return np.asarray((self.row_dt or self.dt) * steps)


@dataclass(frozen=True, eq=False)
class Track:
    """The measurements of a body."""

    times: np.ndarray
    """[S] s."""
    values: dict[str, np.ndarray]
    """By the names of `STATE`, [S, W] each, or [1, W] constant ones."""
    frame: str
    """Of the positions, where the recording has it."""

    @property
    def fixed(self) -> bool:
        """Whether the position is a constant of the map."""
        return len(self.times) == 0


def finite_rows(mapped: MappedEpisode, entries: Entries) -> tuple[np.ndarray, np.ndarray]:
    """Times [S] s and values [S, W] of the rows that have numbers."""
    column = entries.read(mapped.episode)
    known = _known(column, entries)
    return _times(mapped, column, known, entries.where), column.values[known]


def _known(column: Column, entries: Entries) -> np.ndarray:
    """[S] bool: the rows that have numbers, at least one."""
    known = np.isfinite(column.values).all(axis=1)
    if not known.any():
        raise InvalidInputError(f"{entries.where}: {entries.names} must have numbers, found none")
    return np.asarray(known)


def _times(mapped: MappedEpisode, column: Column, known: np.ndarray, where: str) -> np.ndarray:
    """[S] s of these rows of a column."""
    times = mapped.times(column)[known]
    wrong = ~(np.diff(times) > 0.0) if np.isfinite(times).all() else ~np.isfinite(times)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InvalidInputError(
            f"{where}: times must be finite and increase, found {times[row : row + 2].tolist()} s "
            f"from row {np.flatnonzero(known)[row] + 1} on"
        )
    return times


def read_track(mapped: MappedEpisode, body: BodyMap) -> Track:
    """What the recording says of a body, in the map's units, where its position is known."""
    episode, dimension = mapped.episode, mapped.map.dimension
    size = dimension if body.keypoints is None else body.keypoints.size
    position = body.position.read(episode, size, missing=body.missing)
    known = _known(position, body.position)
    values = {"position": position.values[known]}
    if body.keypoints is not None:
        places, turns, fits = _fitted(body, values["position"], dimension)
        known[np.flatnonzero(known)[~fits]] = False
        values = {"position": places[fits], "orientation": turns[fits]}

    def rows(entries: Entries, *widths: int) -> Column:
        """Those at which the position is known; constant ones have one row."""
        column = entries.read(episode, *widths)
        where, count = entries.where, len(column.values)
        if count not in (1, len(known)):
            raise InvalidInputError(
                f"{where}: must have a row for each position, {len(known)}, found {count}"
            )
        if count > 1 and not same_times(column, position):
            raise InvalidInputError(f"{where}: must have the times of the position, found others")
        return replace(column, values=column.values[known]) if count == len(known) else column

    turning = 1 if dimension == 2 else 3
    widths = {"velocity": dimension, "angular_velocity": turning, "tracked": 1, "measured_at": 1}
    for name, width in widths.items():
        entries = getattr(body, name)
        if entries is not None:
            values[name] = rows(entries, width).values
            values[name] = values[name] > 0.5 if name == "tracked" else values[name]
    if body.orientation is not None:
        sizes = (3,) if body.orientation.euler else (1, 4) if dimension == 2 else (4,)
        found = rows(body.orientation.entries, *sizes)
        values["orientation"] = _orientation(body.orientation, found, dimension)
        turned = _changes_axes(body.orientation.entries, body.orientation.order)
        if dimension == 3 and {turned, _changes_axes(body.position)} == {True, False}:
            raise InvalidInputError(
                f"{body.name}: position and orientation must be about the same axes, but one of "
                "them changes their order or sign"
            )
    if body.position.constant or (body.static and known.sum() == 1):
        return Track(np.zeros(0), values, "")
    return Track(_times(mapped, position, known, body.position.where), values, position.frame)


def _fitted(body: BodyMap, points: np.ndarray, dimension: int) -> tuple[np.ndarray, ...]:
    """Positions [S, D] and orientations of the frame whose points lie at ``points`` [S, V * D], and
    whether they do lie so [S].

    The rotation is that of Kabsch (1976), by singular values. Raises `InvalidInputError` where most
    points are farther from where they should be than a fifth of their distances from the middle.
    """
    keypoints = body.keypoints
    if keypoints is None or keypoints.shape != (len(keypoints), dimension) or len(keypoints) < 2:
        raise InvalidInputError(f"{body.position.where}: points must be a list of 2 or more points")
    seen = points.reshape(len(points), *keypoints.shape)
    centre, own = seen.mean(axis=1), keypoints - keypoints.mean(axis=0)
    left, _, right = np.linalg.svd(own.T @ (seen - centre[:, None]))
    mirror = np.ones((len(points), 1, dimension))
    mirror[:, 0, -1] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    turn = np.swapaxes(left * mirror @ right, 1, 2)
    position = centre - turn @ keypoints.mean(axis=0)
    apart = np.linalg.norm(seen - centre[:, None] - own @ np.swapaxes(turn, 1, 2), axis=(1, 2))
    fits = apart <= _MISFIT * np.linalg.norm(own)
    if np.median(fits) < 0.5:
        raise InvalidInputError(
            f"{body.position.where}: points must fit the columns, but are off by "
            f"{np.median(apart) / np.sqrt(len(own)):.3g} m: other axes, order, or scale?"
        )
    if dimension == 2:
        return position, np.arctan2(turn[:, 1, :1], turn[:, 0, :1]), fits
    from scipy.spatial.transform import Rotation  # slow to import

    return position, quaternions_of(Rotation.from_matrix(turn)), fits


def _orientation(turn: Turn, column: Column, dimension: int) -> np.ndarray:
    """[S, 1] rad or [S, 4] unit quaternions; NaN throughout where some of it is not known."""
    read, axes, where = column.values, column.axes, turn.entries.where
    known = np.isfinite(read).all(axis=1)
    euler = turn.euler if turn.euler.isupper() else turn.euler[::-1].upper()  # the same turns
    recorded = axes if sorted(axes) == list("wxyz") or axes.isupper() else ""
    given = euler or turn.order
    whole = len(turn.entries.columns) == 1  # single columns may exchange axes
    agrees = recorded == given if whole else recorded.find("w") == given.find("w")
    if given and recorded and not agrees:
        raise InvalidInputError(
            f"{where}: must be in the recording's order, {recorded}, found {given}"
        )
    if (recorded.isupper() or _in_degrees(turn, read[known])) and np.all(turn.entries.scale == 1.0):
        raise InvalidInputError(f"{where}: angles are recorded in degrees: scale = 0.0174533")
    if not (given or recorded or turn.entries.constant or read.shape[1] == 1):
        raise InvalidInputError(f"{where}: order must be given, wxyz or xyzw; nothing tells it")
    if not turn.euler and read.shape[1] == 1:
        if turn.order or turn.axis or turn.turned_by is not None:
            raise InvalidInputError(
                f"{where}: order, axis and turned_by are for quaternions, found an angle"
            )
        return np.where(known[:, None], read, np.nan)
    ends = [str(each).rsplit("_")[-1].lower() for each in turn.entries.columns]
    named = "".join(_ANGLES.get(each, "") for each in ends)
    if turn.euler and len(named) == 3 and named != turn.euler.lower():
        names = turn.entries.names
        raise InvalidInputError(f"{where}: {names} must be in the order of euler, {turn.euler}")
    if turn.euler:
        from scipy.spatial.transform import Rotation  # slow to import

        found = quaternions_of(Rotation.from_euler(turn.euler, read[known]))
    else:
        found = read[known][:, [(turn.order or recorded or "wxyz").index(each) for each in "wxyz"]]
        length = np.linalg.norm(found, axis=1, keepdims=True)
        off = np.abs(length[:, 0] - 1.0) > 0.1
        wrong = np.flatnonzero(
            off if len(found) > 1 else length[:, 0] < _TINY
        )  # one may be a sample
        if len(wrong):
            row, size = np.flatnonzero(known)[wrong[0]], float(length[wrong[0], 0])
            raise InvalidInputError(
                f"{where}: quaternions must have length 1, found {size:.3g} in row {row}"
            )
        found = found / length
    if turn.turned_by is not None and len(found):
        mount = rotations(turn.turned_by / np.linalg.norm(turn.turned_by))
        found = quaternions_of(rotations(found) * mount.inv())
    if dimension == 2:
        found = _turn_about(turn, found)
    every = np.full((len(read), found.shape[1]), np.nan)
    every[known] = found
    return every


def _ends(entries: Entries) -> list[str]:
    """The last letter or digit of each column's name."""
    return [str(each).rstrip("]")[-1].lower() for each in entries.columns]


def is_mirrored(body: BodyMap) -> bool:
    """Whether names and scales tell that a planar position and a quaternion are of other hands."""
    turn, ends = body.orientation, _ends(body.position)
    axes = ["xyz".find(each) if each in "xyz" else "012".find(each) for each in ends]
    if turn is None or not turn.order or len(set(axes)) != 2 or -1 in axes:
        return False
    axis, scale = turn.axis or "z", np.broadcast_to(np.sign(turn.entries.scale), 4)
    by_turn = scale[turn.order.index(axis)] * scale[turn.order.index("w")]
    hand = 1.0 if (axes[1] - axes[0]) % 3 == 1 else -1.0
    hand *= np.prod(np.broadcast_to(np.sign(body.position.scale), 2))
    return sum(axes) + "xyz".index(axis) == 3 and bool(hand != by_turn)


def _changes_axes(entries: Entries, order: str = "") -> bool | None:
    """Whether columns of x, y and z, or of 0, 1 and 2, are in another order or negated; None: their
    names do not tell. ``order`` is that of a quaternion."""
    ends = _ends(entries)
    if len(ends) == 4:
        ends = [end for end, axis in zip(ends, order, strict=False) if axis != "w"]
    known = len(ends) == 1 or set(ends) <= set("xyz") or all(map(str.isdigit, ends))
    if entries.constant or not (known or np.any(entries.scale < 0.0)):
        return None
    return bool(np.any(entries.scale < 0.0) or ends != sorted(ends))


def _in_degrees(turn: Turn, angles: np.ndarray) -> bool:
    """Whether Euler angles [S, W] are too large for rad, or one jumps by 340 to 380."""
    large = len(angles) > 1 and np.abs(angles).max() > 2.1 * np.pi  # one row may be a sample
    wraps = np.abs(np.abs(np.diff(angles, axis=0)) - 360.0) < 20.0
    return bool(wraps.any() or (turn.euler and large))


def _turn_about(turn: Turn, quaternion: np.ndarray) -> np.ndarray:
    """[S, 1] rad: the turns about an axis of the world; from the first pose on, where the body
    lies so that its own turn about that axis is undefined."""
    axis = 1 + "xyz".index(turn.axis or "z")

    def about(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sine, cosine = found[:, axis], found[:, 0]
        return 2.0 * np.arctan2(sine, cosine), sine**2 + cosine**2

    angle, defined = about(quaternion)
    if len(quaternion) and defined.min() < _DEFINED:
        first = rotations(quaternion[0])
        angle, defined = about(quaternions_of(rotations(quaternion) * first.inv()))
        if defined.min() < _DEFINED:
            raise InvalidInputError(
                f"{turn.entries.where}: the turn about {turn.axis or 'z'} is undefined in row "
                f"{int(defined.argmin())}, where the body is turned over; is axis the world's "
                "vertical?"
            )
        ahead = np.roll(first.as_matrix()[:, axis % 3], -axis)  # of the body's next axis
        angle = angle + np.arctan2(ahead[1], ahead[0])
    return angle[:, None]


def map_scene(mapped: MappedEpisode, widths: list[int]) -> Scene:
    """The scene of the map, with the goal of the episode.

    ``widths`` are the numbers of components of the map's controls.
    """
    found, bodies = mapped.map, mapped.map.bodies
    given: dict[str, Any] = {
        name: value.astype(np.int64) if name == "pins" else value
        for name, value in found.scene.items()
    }
    for name in ("mass", "radius", "size", "anchor", "reach"):
        if any(name in body.constants for body in bodies):
            given[name] = _constant(name, found)
    if found.goal is not None:
        goal = found.goal.read(mapped.episode, found.dimension)
        given["goal"] = goal.values[_known(goal, found.goal)][0]
    if any(body.static is not None for body in bodies):
        given["static"] = np.array([bool(body.static) for body in bodies])
    outlines = [(index, each) for index, body in enumerate(bodies) for each in body.polygons]
    if outlines:
        given["polygon_of"], given["polygons"] = zip(*outlines, strict=True)
    components = [
        each for each, width in zip(found.controls, widths, strict=True) for _ in range(width)
    ]
    acting = [[body.name in each.bodies for each in components] for body in bodies]
    return Scene(
        node_name=tuple(body.name for body in bodies),
        node_type=tuple(body.type for body in bodies),
        actuated=np.array([body.actuated for body in bodies]),
        dt=mapped.dt,
        dimension=found.dimension,
        control_kind=tuple(each.kind for each in components),
        control_of=np.array(acting).reshape(len(bodies), len(components)),
        **given,
    )


def _constant(name: str, found: SceneMap) -> np.ndarray:
    """[N, …] of a constant that some bodies have; NaN for the others."""
    shapes: dict[str, tuple[int, ...]] = {"mass": (), "radius": (), "reach": (2, found.dimension)}
    shape = shapes.get(name, (found.dimension,))
    rows = []
    for body in found.bodies:
        value, where = body.constants.get(name), f"{found.where}: {body.name}: {name}"
        if value is None and not shape:
            raise InvalidInputError(f"{where} must be given, as another body's is")
        value = np.full(shape, np.nan) if value is None else value
        if value.shape != shape:
            raise InvalidInputError(f"{where} must have shape {shape}, found {value.shape}")
        rows.append(value)
    return np.stack(rows)

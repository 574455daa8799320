"""Measurements of bodies and controls, and the scene, read from an episode by its map."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.data.turns import quaternions_of, rotations
from contactgraph.interchange.map_entries import Entries, same_times
from contactgraph.interchange.recording import Column, Episode
from contactgraph.interchange.scene_map import BodyMap, SceneMap, Turn

STATE = ("position", "velocity", "orientation", "angular_velocity")
_TINY = 1e-6
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
    known = np.isfinite(column.values).all(axis=1)
    if not known.any():
        raise InvalidInputError(f"{entries.where}: must have numbers, found none")
    return _times(mapped, column, known, entries.where), column.values[known]


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
    turning = 1 if dimension == 2 else 3
    size = dimension if body.keypoints is None else body.keypoints.size
    position = body.position.read(episode, size, missing=body.missing)
    known = np.isfinite(position.values).all(axis=1)
    if not known.any():
        raise InvalidInputError(f"{body.position.where}: must have numbers, found none")
    values = {"position": position.values[known]}
    if body.keypoints is not None:
        fitted = _fitted(body, values["position"], dimension)
        known[np.flatnonzero(known)[~fitted[2]]] = False
        values = {"position": fitted[0][fitted[2]], "orientation": fitted[1][fitted[2]]}
    others = {"velocity": body.velocity, "angular_velocity": body.angular_velocity}
    for name, entries in others.items():
        if entries is not None:
            width = dimension if name == "velocity" else turning
            values[name] = _rows(entries.read(episode, width), position, known, entries.where)
    if body.orientation is not None:
        entries = body.orientation.entries
        widths = (3,) if body.orientation.euler else (1, 4) if dimension == 2 else (4,)
        read = entries.read(episode, *widths)
        found = _rows(read, position, known, entries.where)
        values["orientation"] = _orientation(body.orientation, found, read.axes, dimension)
    for name in ("tracked", "measured_at"):
        entries = getattr(body, name)
        if entries is not None:
            values[name] = _rows(entries.read(episode, 1), position, known, entries.where)
    if body.position.constant is not None or (body.static and known.sum() == 1):
        return Track(np.zeros(0), values, "")
    times = _times(mapped, position, known, body.position.where)
    return Track(times, values, position.frame)


def _rows(column: Column, position: Column, known: np.ndarray, where: str) -> np.ndarray:
    """The rows of a column at which the position is known; constant ones have one row."""
    if len(column.values) not in (1, len(known)):
        raise InvalidInputError(
            f"{where}: must have a row for each position, {len(known)}, found {len(column.values)}"
        )
    if len(column.values) > 1 and not same_times(column, position):
        raise InvalidInputError(f"{where}: must have the times of the position, found others")
    return column.values[known] if len(column.values) == len(known) else column.values


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


def _orientation(turn: Turn, read: np.ndarray, axes: str, dimension: int) -> np.ndarray:
    """[S, 1] rad or [S, 4] unit quaternions; NaN throughout where some of it is not known.

    ``axes``: what the recording tells of the numbers, if anything.
    """
    known = np.isfinite(read).all(axis=1)
    euler = turn.euler if turn.euler.isupper() else turn.euler[::-1].upper()  # the same turns
    told = axes if sorted(axes) == list("wxyz") or axes.isupper() else ""
    if (euler or turn.order) and told not in ("", euler or turn.order):
        raise InvalidInputError(
            f"{turn.entries.where}: must be in the recording's order, {told}, "
            f"found {euler or turn.order}"
        )
    if not turn.euler and read.shape[1] == 1:
        if turn.order or turn.axis or turn.turned_by is not None:
            raise InvalidInputError(
                f"{turn.entries.where}: order, axis and turned_by are for quaternions, "
                "found an angle"
            )
        return np.where(known[:, None], read, np.nan)
    if turn.euler:
        from scipy.spatial.transform import Rotation  # slow to import

        found = quaternions_of(Rotation.from_euler(turn.euler, read[known]))
    else:
        found = read[known][:, [(turn.order or told or "wxyz").index(each) for each in "wxyz"]]
        length = np.linalg.norm(found, axis=1, keepdims=True)
        wrong = np.flatnonzero(~(length[:, 0] > _TINY))
        if len(wrong):
            row = np.flatnonzero(known)[wrong[0]]
            raise InvalidInputError(
                f"{turn.entries.where}: quaternions must not be zero, found one in row {row}"
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


def _turn_about(turn: Turn, quaternion: np.ndarray) -> np.ndarray:
    """[S, 1] rad: the turns about an axis of the world; from the first pose on, where the body
    lies so that its own turn about that axis is undefined."""
    axis = 1 + "xyz".index(turn.axis or "z")

    def about(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = 2.0 * np.arctan2(found[:, axis], found[:, 0])
        return angle, found[:, axis] ** 2 + found[:, 0] ** 2

    angle, defined = about(quaternion)
    if len(quaternion) and defined.min() < _DEFINED:
        first = rotations(quaternion[0])
        since = quaternions_of(rotations(quaternion) * first.inv())
        angle, defined = about(since)
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
    found = mapped.map
    bodies = found.bodies
    outlines = [(index, each) for index, body in enumerate(bodies) for each in body.polygons]
    constants: dict[str, Any] = {
        name: _constant(name, found)
        for name in ("mass", "radius", "size", "anchor", "reach")
        if any(name in body.constants for body in bodies)
    }
    goal = None if found.goal is None else found.goal.read(mapped.episode, found.dimension).values
    if goal is not None:
        goal = goal[np.isfinite(goal).all(axis=1)]
        if not len(goal):
            raise InvalidInputError(f"{found.where}: goal: must have numbers, found none")
    scene: dict[str, Any] = {
        name: value.astype(np.int64) if name in ("pins", "candidate_edges") else value
        for name, value in found.scene.items()
    }
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
        goal=None if goal is None else goal[0],
        static=None
        if all(body.static is None for body in bodies)
        else np.array([bool(body.static) for body in bodies]),
        control_kind=tuple(each.kind for each in components),
        control_of=np.array(acting).reshape(len(bodies), sum(widths)),
        polygons=tuple(each for _, each in outlines) or None,
        polygon_of=np.array([index for index, _ in outlines]) if outlines else None,
        **constants,
        **scene,
    )


def _constant(name: str, found: SceneMap) -> np.ndarray:
    """[N, …] of a constant that some bodies have; NaN for the others."""
    shape = {
        "mass": (),
        "radius": (),
        "size": (found.dimension,),
        "anchor": (found.dimension,),
        "reach": (2, found.dimension),
    }[name]
    rows = []
    for body in found.bodies:
        value = body.constants.get(name, np.full(shape, np.nan))
        if not shape and name not in body.constants:
            raise InvalidInputError(
                f"{found.where}: {body.name}: {name} must be given, as another body's is"
            )
        if value.shape != shape:
            raise InvalidInputError(
                f"{found.where}: {body.name}: {name} must have shape {shape}, found {value.shape}"
            )
        rows.append(value)
    return np.stack(rows)

"""Recordings to trajectories, by an import map."""

from dataclasses import replace
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.data.turns import angular_velocity, quaternions_of, rotations
from contactgraph.interchange import resampling
from contactgraph.interchange.measurements import (
    STATE,
    MappedEpisode,
    Track,
    finite_rows,
    map_scene,
    read_track,
)
from contactgraph.interchange.recording import Recording
from contactgraph.interchange.scene_map import BodyMap, PairMap, SceneMap

_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "days": 86400.0}
_SAME_STEP = 0.1
"""Largest relative difference of times from steps in another unit."""
_SHOWN = 12
"""Columns without a use that are named."""
State = dict[str, np.ndarray]
"""Of all bodies at one step, [N, W] each, by the names of `STATE`."""


@np.errstate(over="ignore", invalid="ignore")  # what becomes infinite is refused
def to_trajectories(
    recording: Recording, scene_map: SceneMap
) -> tuple[tuple[Trajectory, ...], list[str]]:
    """The trajectories of a recording, whose columns the map describes; and for people, a line for
    each thing that was left out or resampled.

    Raises `InvalidInputError`, which names the episode and the key of the map, where they do not
    fit.
    """
    dt = scene_map.dt or recording.dt
    found: list[Trajectory] = []
    lost: list[str] = []
    resampled: list[float] = []
    left = 0
    for episode in recording.episodes:
        try:
            if dt is None:
                raise InvalidInputError(
                    f"{scene_map.where}: the time of a step must be given, [time] dt = s; "
                    f"--inspect suggests one"
                )
            parts, seconds = _converted(MappedEpisode(episode, scene_map, dt, recording.dt))
            for each in parts:
                _check_speeds(each, scene_map)
            kept = [_within_bounds(each, scene_map) for each in parts]
        except InvalidInputError as error:
            raise InvalidInputError(f"{recording.where}: {episode.name}: {error}") from error
        found += [each for each in kept if each is not None]
        resampled += [] if seconds is None else [seconds]
        lost += [] if parts else [episode.name]
        left += sum(each is not part for each, part in zip(kept, parts, strict=True))
    if not found:
        raise InvalidInputError(
            f"{recording.where}: no step in which all bodies are known and in their bounds"
        )
    there = dict.fromkeys(
        name for each in recording.episodes for name in (*each.columns, *each.others)
    )
    used = set.union(*(each.used for each in recording.episodes))
    unused = [name for name in there if name not in used]
    more = f", … ({len(unused)} in all)" if len(unused) > _SHOWN else ""
    notes = {
        f"not used: {', '.join(unused[:_SHOWN])}{more}": unused,
        f"left out, without a step in which all is known: {', '.join(lost)}": lost,
        f"{left} end, or are left out, where a body leaves its bounds": left,
        f"{len(resampled)} episodes with gaps or uneven stamps were resampled, and cut at gaps of "
        f"more than {scene_map.max_gap:g} s; {sum(resampled):.3g} s are left out, in which not all "
        "bodies and controls are known": resampled,
    }
    return tuple(found), [note for note, those in notes.items() if those]


def _converted(mapped: MappedEpisode) -> tuple[list[Trajectory], float | None]:
    """The trajectories of an episode, and the s of it that are left out; None: it had even stamps
    and no gaps."""
    tracks = [read_track(mapped, body) for body in mapped.map.bodies]
    controls = [finite_rows(mapped, each.entries) for each in mapped.map.controls]
    pairs = {
        name: [finite_rows(mapped, each.entries) for each in getattr(mapped.map, name)]
        for name in ("contact", "holding")
    }
    _check_frames(mapped.map, tracks)
    moving = [each.times for each in tracks if not each.fixed]
    if not moving:
        raise InvalidInputError("the position of at least one body must be recorded")
    states = max(map(len, moving))
    times = next(each for each in moving if len(each) == states)
    _check_counts(mapped)
    apart = float(np.median(np.diff(times))) if states > 1 else 0.0
    for unit, scale in _UNITS.items():
        if abs(apart * scale / mapped.dt - 1.0) < _SAME_STEP:
            raise InvalidInputError(
                f"times must be in s, found some {apart:g} apart, which are steps of {mapped.dt:g} "
                f"s in {unit}: [time] columns with scale = {scale:g}"
            )
    even = (
        states > 1
        and all(np.array_equal(each, times) for each in moving)
        and all(
            len(each) in (states, states - 1) and np.array_equal(each, times[: len(each)])
            for each, _ in controls
        )
        and all(len(each) == states for flags in pairs.values() for each, _ in flags)
        and resampling.is_even(times, mapped.dt)
    )
    if even:
        return [_trajectory(mapped, tracks, controls, pairs, None)], None
    if apart > mapped.map.max_gap:
        raise InvalidInputError(
            f"rows are {apart:g} s apart, but max_gap is {mapped.map.max_gap:g} s; times in ms or "
            "another unit need [time] columns with a scale"
        )
    for body, track in zip(mapped.map.bodies, tracks, strict=True):
        if len(track.times) == 1 < states:
            raise InvalidInputError(
                f"{body.name}: must be measured more than once, or stand: static = true"
            )
    parts = resampling.even_times(
        moving, [each for each, _ in controls], mapped.dt, mapped.map.max_gap
    )
    every = np.concatenate(moving + [each for each, _ in controls])
    left = np.ptp(every) - sum(np.ptp(at) for at in parts)
    return [_trajectory(mapped, tracks, controls, pairs, at) for at in parts], float(left)


def _check_counts(mapped: MappedEpisode) -> None:
    """Refuses columns without times whose rows cannot belong together."""
    columns = mapped.episode.columns
    counts = {
        name: len(columns[name].values)
        for name in sorted(mapped.episode.used & set(columns))
        if columns[name].stamps is None
    }
    if counts and max(counts.values()) > min(counts.values()) + 1:
        shown = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InvalidInputError(
            f"columns without times must have a row for each state, or one less, found {shown}"
        )


def _check_frames(scene_map: SceneMap, tracks: list[Track]) -> None:
    """Refuses positions that the recording says are in different frames, unless the map does."""
    frames = {
        body.name: track.frame
        for body, track in zip(scene_map.bodies, tracks, strict=True)
        if track.frame
    }
    for body in scene_map.bodies:
        if body.base is not None and frames.get(body.name, "") == frames.get(body.base):
            raise InvalidInputError(
                f"{scene_map.where}: {body.name}: must be recorded in the frame of {body.base}, "
                f"found both in {frames[body.name]!r}"
            )
        if body.in_frame_of is not None:
            frames.pop(body.name, None)
    if len(set(frames.values())) > 1:
        found = ", ".join(f"{name} in {frame!r}" for name, frame in frames.items())
        raise InvalidInputError(
            f"{scene_map.where}: positions must be in one frame, found {found}; "
            'in_frame_of = "BODY" is for a pose in the frame of another body'
        )


def _check_speeds(trajectory: Trajectory, scene_map: SceneMap) -> None:
    """Refuses a body that is faster than it can be."""
    for node, body in enumerate(scene_map.bodies):
        steps = np.linalg.norm(np.diff(trajectory.position[:, node], axis=0), axis=1)
        speed = float(steps.max()) / trajectory.scene.dt
        if body.max_speed is not None and speed > body.max_speed:
            raise InvalidInputError(
                f"{body.name}: max_speed is {body.max_speed:g} m/s, found {speed:.3g} m/s at "
                f"{trajectory.scene.dt * (int(steps.argmax()) + 1):.3g} s"
            )


def _within_bounds(trajectory: Trajectory, scene_map: SceneMap) -> Trajectory | None:
    """The steps before a body leaves its bounds; None where there is none."""
    inside = np.ones(len(trajectory.position), dtype=bool)
    for node, body in enumerate(scene_map.bodies):
        if body.bounds is None:
            continue
        low, high = body.bounds
        position = trajectory.position[:, node]
        inside &= np.all((low <= position) & (position <= high), axis=1)
    states = len(inside) if inside.all() else int(np.argmin(inside))
    if states == len(inside):
        return trajectory
    if states < 2:
        return None
    names = (*STATE, "contact", "holding", "tracked", "measured_at")
    arrays = {name: getattr(trajectory, name) for name in names}
    cut: dict[str, Any] = {
        name: value if value is None else value[:states] for name, value in arrays.items()
    }
    return replace(trajectory, control=trajectory.control[: states - 1], **cut)


def _trajectory(
    mapped: MappedEpisode,
    tracks: list[Track],
    controls: list[tuple[np.ndarray, np.ndarray]],
    pairs: dict[str, list[tuple[np.ndarray, np.ndarray]]],
    at: np.ndarray | None,
) -> Trajectory:
    """The trajectory at these times; None: at all of the recording's, which are even."""
    states = max(len(each.times) for each in tracks) if at is None else len(at)
    given = [_at_times(track, at, states) for track in tracks]
    state = _state(mapped, given)
    measured: dict[str, Any] = {"tracked": None, "measured_at": None}
    if at is not None:
        moving = [at if each.fixed else each.times for each in tracks]
        stamps = [resampling.measured_at(at, times) - at[0] for times in moving]
        measured["measured_at"] = np.stack(stamps, axis=1)
        tracked = [resampling.is_tracked(at, times) for times in moving]
        measured["tracked"] = np.stack(tracked, axis=1)
        for node, each in enumerate(given):
            measured["tracked"][:, node] &= each.get("tracked", np.ones((1, 1)))[:, 0] > 0.5
    else:
        now = mapped.dt * np.arange(states)[:, None]
        for name, default in (("tracked", np.ones_like(now)), ("measured_at", now)):
            if any(name in each for each in given):
                measured[name] = np.concatenate([each.get(name, default) for each in given], axis=1)
    control = [
        values[: states - 1] if at is None else resampling.held_means(at, times, values)
        for times, values in controls
    ]
    control = [np.broadcast_to(each, (states - 1, each.shape[1])) for each in control]
    flags = {name: _flags(mapped, name, pairs[name], at, states) for name in pairs}
    return Trajectory(
        map_scene(mapped, [each.shape[1] for each in control]),
        control=np.concatenate([np.zeros((states - 1, 0)), *control], axis=1),
        **{**state, **measured, **flags},
    )


def _at_times(track: Track, at: np.ndarray | None, states: int) -> dict[str, np.ndarray]:
    """The values of a body at these times, [T+1, W] each."""
    found = {}
    for name, values in track.values.items():
        if at is None or len(values) == 1:
            found[name] = np.broadcast_to(values, (states, values.shape[1])).copy()
        elif name == "orientation":
            found[name] = resampling.interpolated_turns(at, track.times, values)
        elif name == "tracked":
            found[name] = values[resampling.newest(at, track.times)]
        elif name in STATE:
            found[name] = resampling.interpolated(at, track.times, values)
    return found


def state_after(mapped: MappedEpisode, previous: State | None) -> State:
    """[N, W] by the names of `STATE`: the state that an episode of one row tells.

    Angles and signs of quaternions go on from ``previous``, the state before, and velocities that
    are not given are differences to it; at the start it is None, and these are 0. Without any
    orientation there are no turns.
    """
    bodies = mapped.map.bodies
    given = [_at_times(read_track(mapped, body), None, 1) for body in bodies]
    _to_world(mapped.map, given)
    if previous is not None:
        for node, each in enumerate(given):
            for name, now in each.items():
                each[name] = np.concatenate([previous[name][node][None], now])
            if "orientation" in each:
                each["orientation"] = resampling.continued(each["orientation"])
    found = _with_rates(mapped, given)
    return {name: np.stack([each[name][-1] for each in given]) for name in found}


def _state(mapped: MappedEpisode, given: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    """Positions, velocities and turns [T+1, N, W] in the world, derived where not recorded."""
    _to_world(mapped.map, given)
    names = _with_rates(mapped, given)
    return {name: np.stack([each[name] for each in given], axis=1) for name in names}


def _to_world(scene_map: SceneMap, given: list[dict[str, np.ndarray]]) -> None:
    """Poses [S, W] of each body in the world, in the place of those that the map describes."""
    dimension = scene_map.dimension
    if any("orientation" in each for each in given):
        for each in given:
            unknown = np.full((len(each["position"]), 1 if dimension == 2 else 4), np.nan)
            each["orientation"] = resampling.continued(each.get("orientation", unknown))
    by_name = _by_name(scene_map, given)
    for body, each in zip(scene_map.bodies, given, strict=True):
        if body.base is None:
            continue
        offset, base = each["position"], by_name[body.base]
        if body.in_frame_of is not None:
            offset = _turned(body, "in_frame_of", base, offset)
            each["orientation"] = _composed(base["orientation"], each["orientation"])
        each["position"] = base["position"] + offset
    for body, each in zip(scene_map.bodies, given, strict=True):
        if body.reference is not None:
            if body.reference.shape != (dimension,):
                raise InvalidInputError(f"{body.name}: reference must have {dimension} numbers")
            each["position"] = each["position"] + _turned(body, "reference", each, body.reference)


def _with_rates(mapped: MappedEpisode, given: list[dict[str, np.ndarray]]) -> tuple[str, ...]:
    """Adds the velocities [S, W] that are not given or known; the names of what there is then."""
    bodies, dt = mapped.map.bodies, mapped.dt
    turns = "orientation" in given[0]
    by_name = _by_name(mapped.map, given)
    for body in sorted(bodies, key=lambda body: body.base is not None):
        each, recorded = by_name[body.name], by_name[body.name].get("velocity")
        each["velocity"] = _difference(each["position"], dt)
        if recorded is not None:
            recorded = recorded + (0.0 if body.base is None else by_name[body.base]["velocity"])
            known = np.isfinite(recorded).all(axis=1, keepdims=True)
            each["velocity"] = np.where(known, recorded, each["velocity"])
        if turns and body.angular_velocity is None:
            turn = each["orientation"]
            each["angular_velocity"] = np.full((len(turn), 1 if turn.shape[1] == 1 else 3), np.nan)
            known = np.isfinite(turn).all(axis=1)
            rate = each["angular_velocity"]
            both = 1 + np.flatnonzero(known[1:] & known[:-1])
            if len(both):
                rate[both] = angular_velocity(turn[both - 1], turn[both], dt)
            first = np.flatnonzero(known & np.isnan(rate[:, 0]))
            later = np.minimum(first + 1, len(rate) - 1)
            rate[first] = np.nan_to_num(rate[later])  # one that is known alone has none
    return STATE if turns else STATE[:2]


def _by_name(scene_map: SceneMap, given: list[dict[str, np.ndarray]]) -> dict[str, Any]:
    return dict(zip((body.name for body in scene_map.bodies), given, strict=True))


def _difference(position: np.ndarray, dt: float) -> np.ndarray:
    """Backward differences; the first is the next one's, and 0 where there is none."""
    rate = np.diff(position, axis=0, prepend=position[:1]) / dt
    rate[:1] = rate[1:2] if len(rate) > 1 else 0.0
    return rate


def _turned(
    body: BodyMap, key: str, given: dict[str, np.ndarray], vector: np.ndarray
) -> np.ndarray:
    """[S, D]: vectors of a frame, whose orientation is given, in world axes."""
    turn = given.get("orientation")
    if turn is None or not np.isfinite(turn).all():
        raise InvalidInputError(f"{body.name}: {key} needs an orientation at every step")
    if turn.shape[1] == 4:
        return np.asarray(rotations(turn).apply(vector))
    cosine, sine = np.cos(turn), np.sin(turn)
    across = np.stack([-vector[..., 1], vector[..., 0]], axis=-1)
    return np.asarray(cosine * vector + sine * across)


def _composed(base: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Orientations [S, 1 or 4] in the world of those in a frame; NaN stays."""
    if turn.shape[1] == 1:
        return base + turn
    known = np.isfinite(turn).all(axis=1)
    found = turn.copy()
    found[known] = quaternions_of(rotations(base[known]) * rotations(turn[known]))
    return resampling.continued(found)


def _flags(
    mapped: MappedEpisode,
    name: str,
    pairs: list[tuple[np.ndarray, np.ndarray]],
    at: np.ndarray | None,
    states: int,
) -> np.ndarray | None:
    """[T+1, N, N] bool: contact or holding of the map's pairs; None where it has none."""
    maps: tuple[PairMap, ...] = getattr(mapped.map, name)
    if not maps:
        return None
    names = [body.name for body in mapped.map.bodies]
    found = np.zeros((states, len(names), len(names)), dtype=bool)
    for pair, (times, values) in zip(maps, pairs, strict=True):
        flags = values[:, 0] > 0.5
        one, other = (names.index(each) for each in pair.bodies)
        found[:, one, other] = flags if at is None else resampling.any_within(at, times, flags)
        found[:, other, one] = found[:, one, other]
    return found

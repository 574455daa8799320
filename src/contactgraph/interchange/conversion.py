"""Recordings to trajectories, by an import map."""

from dataclasses import replace
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.data.turns import angular_velocity, quaternions_of, rotations
from contactgraph.interchange import resampling
from contactgraph.interchange.contradictions import (
    check_counts,
    check_frames,
    doubts_of,
    doubts_of_motion,
)
from contactgraph.interchange.measurements import (
    STATE,
    MappedEpisode,
    Track,
    finite_rows,
    map_scene,
    read_track,
)
from contactgraph.interchange.recording import Recording
from contactgraph.interchange.scene_map import BodyMap, SceneMap

_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "days": 86400.0}
_SAME_STEP = 0.1
"""Largest relative difference of times from steps in another unit."""
_SHOWN = 12
"""Columns without a use that are named."""
State = dict[str, np.ndarray]
"""Of all bodies at one step, [N, W] each, by the names of `STATE`."""
Given = dict[str, dict[str, np.ndarray]]
"""Values [S, W] by the names of bodies, and of `STATE`."""
Rows = dict[str, list[tuple[np.ndarray, np.ndarray]]]
"""Times and values of what `SceneMap` calls controls, contact and holding."""


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
    doubts: set[str] = set()
    resampled: list[float] = []
    left = 0
    same: dict[int, str] = {}
    for episode in recording.episodes:
        try:
            if dt is None:
                raise InvalidInputError(
                    f"{scene_map.where}: the time of a step must be given, [time] dt = s; "
                    f"--inspect suggests one"
                )
            mapped = MappedEpisode(episode, scene_map, dt, recording.dt)
            parts, seconds = _converted(mapped)
            doubts.update(doubts_of(mapped))
            kept = [_within_bounds(each, scene_map) for each in parts]
            for each in parts:
                other = same.setdefault(hash(each.position.tobytes()), episode.name)
                if other != episode.name and np.ptp(each.position, axis=0).any():
                    doubts.add(f"the motion in {episode.name} is that in {other}: a copy?")
        except InvalidInputError as error:
            name = f"{episode.name}: " * (len(recording.episodes) > 1)
            raise InvalidInputError(f"{recording.where}: {name}{error}") from error
        found += [each for each in kept if each is not None]
        resampled += [] if seconds is None else [seconds]
        lost += [] if parts else [episode.name]
        left += sum(each is not part for each, part in zip(kept, parts, strict=True))
    if not found:
        raise InvalidInputError(
            f"{recording.where}: no step of dt = {dt:g} s in which all is known and in its bounds"
        )
    doubts.update(doubts_of_motion(scene_map, recording.episodes[0], found))
    there = {name: None for each in recording.episodes for name in (*each.columns, *each.others)}
    used = set.union(*(each.used for each in recording.episodes))
    unused = [name for name in there if name not in used]
    more = f", … ({len(unused)} in all)" if len(unused) > _SHOWN else ""
    notes = {
        f"not used: {', '.join(unused[:_SHOWN])}{more}": unused,
        f"left out, without a step in which all is known: {', '.join(lost)}": lost,
        f"{left} end, or are left out, where a body leaves its bounds": left,
        **dict.fromkeys(sorted(doubts), True),
        f"{len(resampled)} episodes with gaps or uneven stamps were resampled, and cut at gaps of "
        f"more than {scene_map.max_gap:g} s; {sum(resampled):.3g} s are left out, in which not all "
        "bodies and controls are known": resampled,
    }
    return tuple(found), [note for note, those in notes.items() if those]


def _converted(mapped: MappedEpisode) -> tuple[list[Trajectory], float | None]:
    """The trajectories of an episode, and the s of it that are left out; None: it had even stamps
    and no gaps."""
    tracks = {body.name: read_track(mapped, body) for body in mapped.map.bodies}
    rows = {
        name: [finite_rows(mapped, each.entries) for each in getattr(mapped.map, name)]
        for name in ("controls", "contact", "holding")
    }
    check_frames(mapped.map, tracks)
    moving = [each.times for each in tracks.values() if not each.fixed]
    if not moving:
        raise InvalidInputError("the position of at least one body must be recorded")
    times = max(moving, key=len)
    states = len(times)
    check_counts(mapped)
    apart = float(np.median(np.diff(times))) if states > 1 else 0.0
    for unit, scale in _UNITS.items():
        if abs(apart * scale / mapped.dt - 1.0) < _SAME_STEP:
            raise InvalidInputError(
                f"times must be in s, found some {apart:g} apart, which are steps of {mapped.dt:g} "
                f"s in {unit}: [time] columns with scale = {scale:g}"
            )
    controls = [each for each, _ in rows["controls"]]
    if (
        states > 1
        and all(np.array_equal(each, times) for each in moving)
        and all(
            len(each) in (states, states - 1) and np.array_equal(each, times[: len(each)])
            for each in controls
        )
        and all(len(each) == states for each, _ in rows["contact"] + rows["holding"])
        and resampling.is_even(times, mapped.dt)
    ):
        return [_trajectory(mapped, tracks, rows, None)], None
    if apart > mapped.map.max_gap:
        raise InvalidInputError(
            f"rows are {apart:g} s apart, but max_gap is {mapped.map.max_gap:g} s; times in ms, us "
            "or ns need [time] columns with a scale"
        )
    for name, track in tracks.items():
        if len(track.times) == 1 < states:
            raise InvalidInputError(
                f"{name}: must be measured more than once, or stand: static = true"
            )
    parts = resampling.even_times(moving, controls, mapped.dt, mapped.map.max_gap)
    left = np.ptp(np.concatenate(moving + controls)) - sum(map(np.ptp, parts))
    return [_trajectory(mapped, tracks, rows, at) for at in parts], float(left)


def _within_bounds(trajectory: Trajectory, scene_map: SceneMap) -> Trajectory | None:
    """The steps before a body leaves its bounds; None where there is none.

    Refuses a body that is faster than it can be.
    """
    dt, inside = trajectory.scene.dt, np.ones(len(trajectory.position), dtype=bool)
    for node, body in enumerate(scene_map.bodies):
        position = trajectory.position[:, node]
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        speed = float(steps.max()) / dt
        if body.max_speed is not None and speed > body.max_speed:
            raise InvalidInputError(
                f"{body.name}: max_speed is {body.max_speed:g} m/s, found {speed:.3g} m/s at "
                f"{dt * (int(steps.argmax()) + 1):.3g} s"
            )
        low, high = (-np.inf, np.inf) if body.bounds is None else body.bounds
        inside &= np.all((low <= position) & (position <= high), axis=1)
    if inside.all():
        return trajectory
    states = int(np.argmin(inside))
    if states < 2:
        return None
    names = (*STATE, "contact", "holding", "tracked", "measured_at")
    arrays = {name: getattr(trajectory, name) for name in names}
    cut: dict[str, Any] = {key: each[:states] for key, each in arrays.items() if each is not None}
    return replace(trajectory, control=trajectory.control[: states - 1], **cut)


def _trajectory(
    mapped: MappedEpisode, tracks: dict[str, Track], rows: Rows, at: np.ndarray | None
) -> Trajectory:
    """The trajectory at these times; None: at all of the recording's, which are even."""
    states = max(len(each.times) for each in tracks.values()) if at is None else len(at)
    given = {name: _at_times(track, at, states) for name, track in tracks.items()}
    found: dict[str, Any] = {**_states(mapped, given, None)}
    now = mapped.dt * np.arange(states)[:, None]
    for name, default in (("tracked", np.ones_like(now)), ("measured_at", now)):
        if any(name in each for each in given.values()):
            found[name] = np.hstack([each.get(name, default) for each in given.values()])
    for name in ("contact", "holding"):
        if rows[name]:
            found[name] = np.zeros((states, len(tracks), len(tracks)), dtype=bool)
        for pair, (times, values) in zip(getattr(mapped.map, name), rows[name], strict=True):
            one, other = (list(tracks).index(each) for each in pair.bodies)
            flags = values[:, 0] > 0.5
            flags = flags if at is None else resampling.any_within(at, times, flags)
            found[name][:, one, other] = found[name][:, other, one] = flags
    control = [
        values[: states - 1] if at is None else resampling.held_means(at, times, values)
        for times, values in rows["controls"]
    ]
    return Trajectory(
        map_scene(mapped, [each.shape[1] for each in control]),
        control=np.concatenate([np.zeros((states - 1, 0)), *control], axis=1),
        **found,
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
        else:
            found[name] = resampling.interpolated(at, track.times, values)
    if at is not None:
        times = at if track.fixed else track.times
        found["measured_at"] = (resampling.measured_at(at, times) - at[0])[:, None]
        on_time = resampling.is_tracked(at, times)[:, None]
        found["tracked"] = on_time & found.get("tracked", np.ones(1, dtype=bool))
    return found


def state_after(mapped: MappedEpisode, previous: State | None) -> State:
    """[N, W] by the names of `STATE`: the state that an episode of one row tells.

    Angles and signs of quaternions go on from ``previous``, the state before, and velocities that
    are not given are differences to it; at the start it is None, and these are 0. Without any
    orientation there are no turns.
    """
    given = {body.name: _at_times(read_track(mapped, body), None, 1) for body in mapped.map.bodies}
    return {name: values[-1] for name, values in _states(mapped, given, previous).items()}


def _states(mapped: MappedEpisode, given: Given, previous: State | None) -> State:
    """Positions, velocities and turns [S, N, W] in the world, derived where not recorded; the first
    are those of ``previous``, if any."""
    _to_world(mapped.map, given)
    for node, each in enumerate(given.values()):
        for name, before in (previous or {}).items():
            if name in each:
                each[name] = np.concatenate([before[node][None], each[name]])
        if previous and "orientation" in each:
            each["orientation"] = resampling.continued(each["orientation"])
    _add_rates(mapped, given)
    names = STATE if any("orientation" in each for each in given.values()) else STATE[:2]
    return {name: np.stack([each[name] for each in given.values()], axis=1) for name in names}


def _to_world(scene_map: SceneMap, given: Given) -> None:
    """Poses [S, W] of each body in the world, in the place of those that the map describes."""
    dimension = scene_map.dimension
    if any("orientation" in each for each in given.values()):
        for each in given.values():
            unknown = np.full((len(each["position"]), 1 if dimension == 2 else 4), np.nan)
            each["orientation"] = resampling.continued(each.get("orientation", unknown))
    for body in scene_map.bodies:
        if body.base is None:
            continue
        each, base = given[body.name], given[body.base]
        offset = each["position"]
        if body.in_frame_of is not None:
            offset = _turned(body, "in_frame_of", base.get("orientation"), offset)
            each["orientation"] = _composed(base["orientation"], each["orientation"])
        each["position"] = base["position"] + offset
    for body in scene_map.bodies:
        if body.reference is not None:
            if body.reference.shape != (dimension,):
                raise InvalidInputError(f"{body.name}: reference must have {dimension} numbers")
            each = given[body.name]
            offset = _turned(body, "reference", each.get("orientation"), body.reference)
            each["position"] = each["position"] + offset


def _add_rates(mapped: MappedEpisode, given: Given) -> None:
    """Adds the velocities [S, W] that are not given or known."""
    dt = mapped.dt
    for body in sorted(mapped.map.bodies, key=lambda body: body.base is not None):
        each = given[body.name]
        rate = np.diff(each["position"], axis=0, prepend=each["position"][:1]) / dt
        rate[0] = rate[min(1, len(rate) - 1)]  # that of a single state is 0
        if "velocity" in each:
            base = 0.0 if body.base is None else given[body.base]["velocity"]
            recorded = each["velocity"] + base
            rate = np.where(np.isfinite(recorded).all(axis=1, keepdims=True), recorded, rate)
        each["velocity"] = rate
        if "orientation" in each and body.angular_velocity is None:
            turn = each["orientation"]
            rate = np.full((len(turn), 1 if turn.shape[1] == 1 else 3), np.nan)
            known = np.asarray(np.isfinite(turn).all(axis=1))
            both = 1 + np.flatnonzero(known[1:] & known[:-1])
            if len(both):
                rate[both] = angular_velocity(turn[both - 1], turn[both], dt)
            first = np.flatnonzero(known & np.isnan(rate[:, 0]))
            later = np.minimum(first + 1, len(rate) - 1)
            rate[first] = np.nan_to_num(rate[later])  # one that is known alone has none
            each["angular_velocity"] = rate


def _turned(body: BodyMap, key: str, turn: np.ndarray | None, vector: np.ndarray) -> np.ndarray:
    """[S, D]: vectors of a frame, whose orientation is given, in world axes."""
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

"""Contradictions of a recording with its map, or itself: refused, or lines for people."""

from collections.abc import Iterator

import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.interchange.measurements import MappedEpisode, Track, finite_rows, is_mirrored
from contactgraph.interchange.recording import Episode
from contactgraph.interchange.scene_map import SceneMap

_SAME_GOAL = 1e-5
"""Change of a goal, relative, up to which it stands."""
_APART = 2.0
"""Median distance of bodies that touch, relative to that of the same ones that do not, from which
on a contact looks inverted; and of a target to its body, in 10 times that to another."""
_ROUNDED = 1e-3


def check_counts(mapped: MappedEpisode) -> None:
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


def check_frames(scene_map: SceneMap, tracks: dict[str, Track]) -> None:
    """Refuses positions that the recording says are in different frames, unless the map does."""
    frames = {name: track.frame for name, track in tracks.items() if track.frame}
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


def doubts_of(mapped: MappedEpisode) -> Iterator[str]:
    """Lines about controls that are in another frame than the positions, or have gaps; a goal that
    moves, a switch that is not 0 to 1, and mirrored poses. Refuses such a contact."""
    found, episode = mapped.map, mapped.episode
    frames = {body.position.read(episode).frame for body in found.bodies} - {""}
    switches = [each.entries for each in found.controls if each.kind == "switch"]
    for entries in (*(each.entries for each in (*found.contact, *found.holding)), *switches):
        _, values = finite_rows(mapped, entries)
        where, names, low, high = entries.where, entries.names, values.min(), values.max()
        if low < -_ROUNDED or high > 1.0 + _ROUNDED:
            wrong = f"{where}: {names} must be 0 to 1, found {low:g} to {high:g}"
            if entries not in switches:
                raise InvalidInputError(wrong)
            yield wrong
        if 0.0 < high <= 0.5 and entries not in switches:
            yield f"{where}: {names} is never above 0.5, from where on bodies count as touching"
    if found.goal is not None:
        goals = finite_rows(mapped, found.goal)[1]
        if np.ptp(goals, axis=0).max() > _SAME_GOAL * (1.0 + np.abs(goals).max()):
            yield f"{found.goal.where} moves within an episode, whose first one is taken for all"
    for body in filter(is_mirrored, found.bodies):
        yield f"{body.name}: its position is mirrored, but its orientation is not: scale = -1?"
    for each in found.controls:
        where, frame = each.entries.where, each.entries.read(episode).frame
        if frame and frames and frame not in frames:
            others = ", ".join(sorted(frames))
            yield f"{where} is in the frame {frame}, positions in {others}: do these not turn?"
        times, _ = finite_rows(mapped, each.entries)
        if np.diff(times).max(initial=0.0) > found.max_gap:
            yield f"{where} has gaps of more than {found.max_gap:g} s, in which it holds"


def doubts_of_motion(
    scene_map: SceneMap, episode: Episode, found: list[Trajectory]
) -> Iterator[str]:
    """Lines about contacts that look inverted, and targets that look like another body's."""
    index = {body.name: node for node, body in enumerate(scene_map.bodies)}
    position = np.concatenate([each.position for each in found])
    for name in ("contact", "holding"):
        for pair in getattr(scene_map, name):
            one, other = (index[each] for each in pair.bodies)
            touch = np.concatenate([getattr(each, name)[:, one, other] for each in found])
            apart = np.linalg.norm(position[:, one] - position[:, other], axis=1)
            near, far = (np.median(apart[each]) if each.any() else 0.0 for each in (touch, ~touch))
            if far and near > _APART * far:
                yield (
                    f"{pair.entries.where} reports contact at {near:.3g} m, and none at "
                    f"{far:.3g} m: inverted?"
                )
    controls, begin = np.concatenate([each.control for each in found]), 0
    before = np.concatenate([each.position[:-1] for each in found])
    positions = [each for each in scene_map.controls if each.kind == "position"]
    acting = [node for each in positions for node in each.bodies]
    for each in scene_map.controls:
        width = each.entries.read(episode).values.shape[1]
        target, begin = controls[:, begin : begin + width], begin + width
        if each not in positions or len(each.bodies) != 1 or width != scene_map.dimension:
            continue
        far = {
            name: np.median(np.linalg.norm(target - before[:, index[name]], axis=1))
            for name in acting
        }
        nearest = min(far, key=far.__getitem__)
        if 10.0 * far[nearest] < far[each.bodies[0]]:
            own = each.bodies[0]
            yield f"{each.entries.where}: targets of {own} are where {nearest} is, not it"

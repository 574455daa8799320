"""The motion of the bodies of a dataset, and signs that it cannot be right."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.dataset import Dataset
from contactgraph.data.trajectory import Trajectory
from contactgraph.data.turns import angular_velocity, rotation_vectors, turn_between

_ISOLATED = 10.0
"""Times the steps before and after it, and the median of those in which the body moves, from which
on a step is a jump."""

_PLACES, _IN_TURN = 1e-3, 0.1
"""m: the least step between places, and of it, up to which positions are of the same place."""
_TURNING, _COARSE = 0.01, 0.5
"""rad: the least step of a body that turns, and the median of such steps that looks odd."""
_FEW, _MOST = 5, 0.8
"""Waits between moves that are too few to tell, and the share of equal ones that tells."""
_OTHER_RATE = 0.5
"""Of the turns between poses, from which on recorded turn rates are off."""
_FAST = 100.0
"""m/s, from which on a body's speed looks odd."""
_LARGER = 100.0
"""Times as far from the origin as in the median trajectory, from which on one is in other units."""
_TURNS = 0.5
"""rad: the least sum of turns that is compared."""
_STANDS = 0.01
"""Of the extent of all positions, up to which a static body's are noise."""
_MISMATCH_STEPS = 10
_MISMATCH_LIMIT = 0.1
_PULL = 0.5
"""N away from a body in contact, above which a command is a pull."""
_PULLS, _HELD = 30, 0.95
"""Pulls that are too few to tell, and the share of held bodies among them that tells the hold."""
_ALWAYS_HELD = 0.9
"""Share of held bodies in contact above which hardly any hold is in question."""
_AT_REST = 1e-4
"""Displacement up to which a body rests, as a share of the extent of all positions: contacts that
bear a body move it by rounding."""


@dataclass(frozen=True)
class BodyMotion:
    """The motion of the nodes of one name in all trajectories, from pose to pose."""

    name: str
    text: str
    """One line: the fastest motions, the largest step, and the share of states not measured."""
    jumps: int
    """Steps of more than ten times those before and after, and the median of moving ones."""
    turn_jumps: int
    """The same of turns."""
    signs: tuple[str, ...]
    """A line for each other sign that the body cannot have moved so."""

    def __str__(self) -> str:
        return self.text


def body_motions(dataset: Dataset) -> list[BodyMotion]:
    """Of each name of a node, in the order of their first trajectory."""
    names = dict.fromkeys(name for each in dataset for name in each.scene.node_name)
    return [_motion(dataset, name) for name in names]


def motion_warnings(motions: list[BodyMotion], hint: str = "") -> list[str]:
    """A line for each sign that bodies cannot have moved so; ``hint`` is for those that jump."""
    found = []
    for what, name in {"positions": "jumps", "turns": "turn_jumps"}.items():
        counts = {each.name: getattr(each, name) for each in motions}
        those = [f"{body} {count} times" for body, count in counts.items() if count]
        if those:
            found.append(
                f"{what} jump: {', '.join(those)}, in one step by more than {_ISOLATED:g} times "
                f"those before and after; are these measurements?{hint}"
            )
    return found + [sign for each in motions for sign in each.signs]


def _motion(dataset: Dataset, name: str) -> BodyMotion:
    dt, tiny = dataset.dt, np.finfo(float).tiny
    runs = [
        (index, each, each.scene.node_name.index(name))
        for index, each in enumerate(dataset)
        if name in each.scene.node_name
    ]
    places = [each.position[:, node] for _, each, node in runs]
    steps = [np.linalg.norm(np.diff(place, axis=0), axis=1) for place in places]
    largest, index, time = max(
        (float(moved.max()), index, dt * (int(moved.argmax()) + 1))
        for moved, (index, _, _) in zip(steps, runs, strict=True)
    )
    pattern = next(filter(None, map(_pattern, places, steps)), "")
    distances = [float(np.abs(place).max()) for place in places]
    farther = max(distances) / max(float(np.median(distances)), tiny)
    turns, turned, off = [np.zeros(0)], 0.0, 0.0
    for _, each, node in runs:
        poses = each.orientation[:, node]
        turn = poses if poses.shape[1] == 1 else rotation_vectors(poses)
        turns.append(turn_between(turn[:-1], turn[1:]))
        recorded = each.angular_velocity[1:, node]
        both = np.isfinite(turns[-1]) & np.isfinite(recorded[:, 0])
        rates = angular_velocity(poses[:-1][both], poses[1:][both], dt)
        turned += dt * float(np.linalg.norm(rates, axis=-1).sum())
        off += dt * float(np.linalg.norm(rates - recorded[both], axis=-1).sum())
    known = np.concatenate(turns)[np.isfinite(np.concatenate(turns))]
    turning = known[known > _TURNING]
    usual = float(np.median(turning)) if len(turning) else 0.0
    error = off / max(turned, _TURNS) if max(off, turned) > _TURNS else 0.0
    drift = max(
        float(np.linalg.norm(place - place[0], axis=1).max())
        / max(float(np.linalg.norm(np.ptp(each.position, axis=(0, 1)))), tiny)
        if each.scene.static[node]
        else 0.0
        for place, (_, each, node) in zip(places, runs, strict=True)
    )
    tracked = [each.tracked[:, node] for _, each, node in runs if each.tracked is not None]
    lost = 1.0 - float(np.concatenate(tracked).mean()) if tracked else 0.0
    rate = f" and {known.max() / dt:.3g} rad/s" if len(known) else ""
    unmeasured = f"; not measured in {100 * lost:.0f} %" if lost else ""
    signs = {
        f"positions of {name} {pattern}": bool(pattern),
        f"{name} turns by {usual:.3g} rad in a step and more: angles in degrees, or flips?": (
            usual > _COARSE
        ),
        f"turn rates contradict orientations: those of {name} are off by {error:.3g} of the "
        "turns; check unit and frame": error > _OTHER_RATE,
        f"{name} moves at {largest / dt:.3g} m/s; check scale and dt": largest / dt > _FAST,
        f"{name} is {farther:.3g} times as far from the origin as usual in one trajectory: "
        "another unit?": farther > _LARGER,
        f"{name} is static, but moves: is it?": drift > _STANDS,
    }
    return BodyMotion(
        name=name,
        text=f"{name}: at most {largest / dt:.3g} m/s{rate}; largest step {100 * largest:.3g} cm, "
        f"to {time:.3g} s of trajectory {index}{unmeasured}",
        jumps=sum(map(_jumps, steps)),
        turn_jumps=sum(_jumps(np.nan_to_num(each)) for each in turns),
        signs=tuple(sign for sign, there in signs.items() if there),
    )


def _pattern(position: np.ndarray, steps: np.ndarray) -> str:
    """The sign that positions [T+1, D] return after two to four steps [T], or stand for some."""
    waits = np.diff(np.flatnonzero(steps > 0.0))
    usual = float(np.median(waits)) if len(waits) > _FEW else 1.0
    if usual > 1.0 and np.mean(waits == usual) > _MOST:
        return f"change in every {usual:g} steps alone: are rows filled up?"
    one, *others = (
        np.median(np.linalg.norm(position[lag:] - position[:-lag], axis=1))
        for lag in range(1, min(5, len(position)))
    )
    if len(others) == 3 and one > _PLACES and min(others) < _IN_TURN * one:
        return "alternate: are rows of several bodies?"
    return ""


def _jumps(steps: np.ndarray) -> int:
    """Steps [T] that are isolated."""
    moving = steps[steps > 0.0]
    if len(steps) < 3:
        return 0
    beside = np.pad(steps, 1, constant_values=0.0)
    limit = np.maximum(np.maximum(beside[:-2], beside[2:]), np.median(moving) if len(moving) else 0)
    return int(np.sum(steps > _ISOLATED * limit)) if len(moving) > 2 else 0


def velocity_mismatch(trajectory: Trajectory) -> float:
    """Share of the motion in which velocities and positions disagree; 0 where nothing moves, but
    for less than a ten-thousandth of the extent of all positions.

    The displacement over every 10 steps is compared with the integral of the velocities by the
    trapezoid rule or, where that fits better, of those at the ends of the steps, which backward
    differences are: the sum of the differences' norms over the larger of the two sums of norms.
    Wrong units or a wrong time step give values near 1; impacts and noise of single positions
    hardly count.
    """
    velocity, dt = trajectory.velocity, trajectory.scene.dt
    paths = (0.5 * dt * (velocity[1:] + velocity[:-1]), dt * velocity[1:])
    return min(_mismatch(trajectory.position, path) for path in paths)


def _mismatch(position: np.ndarray, displacement: np.ndarray) -> float:
    steps = min(_MISMATCH_STEPS, len(displacement))
    moved = position[steps:] - position[:-steps]
    path = np.concatenate([np.zeros_like(position[:1]), np.cumsum(displacement, axis=0)])
    integral = path[steps:] - path[:-steps]
    norms = [np.linalg.norm(each, axis=-1) for each in (moved, integral, moved - integral)]
    size = np.linalg.norm(np.ptp(position, axis=(0, 1)))
    moves = np.maximum(norms[0], norms[1]) > _AT_REST * size
    *totals, difference = (float(norm[moves].sum()) for norm in norms)
    return difference / max(totals) if max(totals) > 0.0 else 0.0


def velocity_warning(dataset: Dataset) -> str | None:
    """One line where velocities contradict positions by more than a tenth in some trajectory."""
    mismatch = np.array([velocity_mismatch(each) for each in dataset])
    wrong = np.flatnonzero(mismatch > _MISMATCH_LIMIT)
    if not len(wrong):
        return None
    worst = int(mismatch.argmax())
    return (
        f"velocities contradict positions in {len(wrong)} of {len(dataset)} trajectories, by "
        f"{100 * mismatch[worst]:.0f} % of the motion in trajectory {worst}; check units and dt"
    )


def pulls(trajectory: Trajectory) -> np.ndarray:
    """[P] bool: whether a body is held, for each time that a force begins to pull it.

    That is a force of more than 0.5 N on the first actuated body, away from a body that it touches
    or holds. None where holding was not recorded, or the control is no force.
    """
    scene, dimension = trajectory.scene, trajectory.scene.dimension
    kinds = scene.control_kind or ("force",) * trajectory.control_size
    contact, holding = trajectory.contact, trajectory.holding
    if contact is None or holding is None or kinds[:dimension] != ("force",) * dimension:
        return np.zeros(0, dtype=bool)
    hand = int(scene.actuated.argmax())
    away = trajectory.position[:-1, hand, None] - trajectory.position[:-1]
    force = np.einsum("tnd,td->tn", away, trajectory.control[:, :dimension])
    pulled = contact[:-1, hand] & (force > _PULL * np.linalg.norm(away, axis=-1))
    begins = pulled & ~np.concatenate([np.zeros_like(pulled[:1]), pulled[:-1]])
    return holding[:-1, hand][begins]


def pull_warning(dataset: Dataset) -> str | None:
    """One line where bodies are pulled almost only while they are held, but not touched so: a model
    would learn from the force that it holds, and could not plan to pull."""
    held = np.concatenate([pulls(each) for each in dataset])
    touched = [
        each.holding[each.contact]
        for each in dataset
        if each.contact is not None and each.holding is not None
    ]
    few = len(held) < _PULLS or held.mean() <= _HELD
    if few or np.concatenate(touched).mean() > _ALWAYS_HELD:
        return None
    return (
        f"in {held.sum()} of {len(held)} pulls at a body in contact it is held, so that the force "
        "tells what only motion should; record with --exploration 0.5"
    )

"""The motion of the bodies of a dataset, and signs that it cannot be right."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.dataset import Dataset
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


@dataclass(frozen=True)
class BodyMotion:
    """The fastest motions of the nodes of one name in all trajectories, from pose to pose."""

    name: str
    speed: float
    """m/s."""
    turn_rate: float | None
    """rad/s. None: no orientation is known."""
    step: float
    """m: the largest step."""
    trajectory: int
    """In which that is."""
    time: float
    """s, at its end."""
    jumps: int
    """Steps of more than ten times those before and after, and the median of moving ones."""
    turn_jumps: int
    """The same of turns."""
    pattern: str
    """What rows that are no measurements each look like; empty: nothing."""
    turn: float
    """rad: the median of the steps in which the body turns; 0: it does not."""
    rate_error: float
    """Of the recorded turn rates, summed over time, relative to the turns between poses."""
    larger: float
    """Largest distance from the origin, relative to that in the median trajectory."""
    drift: float
    """Largest distance from the first position of a static node, relative to the extent of all."""
    unmeasured: float
    """Share of states in which the body was not tracked."""

    def __str__(self) -> str:
        turning = "" if self.turn_rate is None else f" and {self.turn_rate:.3g} rad/s"
        lost = f"; not measured in {100 * self.unmeasured:.0f} %" if self.unmeasured else ""
        return (
            f"{self.name}: at most {self.speed:.3g} m/s{turning}; largest step "
            f"{100 * self.step:.3g} cm, to {self.time:.3g} s of trajectory {self.trajectory}{lost}"
        )


def body_motions(dataset: Dataset) -> list[BodyMotion]:
    """Of each name of a node, in the order of their first trajectory."""
    names = dict.fromkeys(name for each in dataset for name in each.scene.node_name)
    return [_motion(dataset, name) for name in names]


def motion_warnings(motions: list[BodyMotion], hint: str = "") -> list[str]:
    """A line for each sign that bodies cannot have moved so; ``hint`` is for those that jump."""
    found = []
    jumping = {"positions": "jumps", "turns": "turn_jumps"}
    for what, name in jumping.items():
        those = [
            f"{each.name} {getattr(each, name)} times" for each in motions if getattr(each, name)
        ]
        if those:
            found.append(
                f"{what} jump: {', '.join(those)}, in one step by more than {_ISOLATED:g} times "
                f"those before and after; are these measurements?{hint}"
            )
    for each in motions:
        signs = {
            f"positions of {each.name} {each.pattern}": each.pattern,
            f"{each.name} turns by {each.turn:.3g} rad in a step and more: angles in degrees, or "
            "flips?": each.turn > _COARSE,
            f"turn rates contradict orientations: those of {each.name} are off by "
            f"{each.rate_error:.3g} of the turns; check unit and frame": (
                each.rate_error > _OTHER_RATE
            ),
            f"{each.name} moves at {each.speed:.3g} m/s; check scale and dt": each.speed > _FAST,
            f"{each.name} is {each.larger:.3g} times as far from the origin as usual in one "
            "trajectory: another unit?": each.larger > _LARGER,
            f"{each.name} is static, but moves: is it?": each.drift > _STANDS,
        }
        found += [sign for sign, there in signs.items() if there]
    return found


def _motion(dataset: Dataset, name: str) -> BodyMotion:
    fastest, rate, largest, jumps = 0.0, [], (0.0, 0, 0.0), 0
    turn_jumps, turned, off, drift = 0, 0.0, 0.0, 0.0
    pattern, turns, tracked = "", list[np.ndarray](), list[np.ndarray]()
    places: list[float] = []
    for index, each in enumerate(dataset):
        if name not in each.scene.node_name:
            continue
        node, dt = each.scene.node_name.index(name), each.scene.dt
        steps = np.linalg.norm(np.diff(each.position[:, node], axis=0), axis=1)
        at = int(steps.argmax())
        largest = max(largest, (float(steps[at]), index, dt * (at + 1)))
        fastest = max(fastest, float(steps[at]) / dt)
        jumps += _jumps(steps)
        places.append(float(np.abs(each.position[:, node]).max()))
        pattern = pattern or _pattern(each.position[:, node], steps)
        if each.orientation is not None:
            turn = each.orientation[:, node]
            turn = turn if turn.shape[1] == 1 else rotation_vectors(turn)
            between = turn_between(turn[:-1], turn[1:])
            rate += [float(np.nanmax(between)) / dt] if np.isfinite(between).any() else []
            turn_jumps += _jumps(np.nan_to_num(between))
            turns.append(between[between > _TURNING])
            if each.angular_velocity is not None:
                both = np.isfinite(between) & np.isfinite(each.angular_velocity[1:, node, 0])
                poses = each.orientation[:, node]
                rates = angular_velocity(poses[:-1][both], poses[1:][both], dt)
                apart = rates - each.angular_velocity[1:, node][both]
                turned += dt * float(np.linalg.norm(rates, axis=-1).sum())
                off += dt * float(np.linalg.norm(apart, axis=-1).sum())
        if each.scene.static is not None and each.scene.static[node]:
            away = np.linalg.norm(each.position[:, node] - each.position[0, node], axis=1).max()
            extent = np.linalg.norm(np.ptp(each.position, axis=(0, 1)))
            drift = max(drift, float(away / max(extent, np.finfo(float).tiny)))
        if each.tracked is not None:
            tracked.append(each.tracked[:, node])
    lost = 1.0 - float(np.concatenate(tracked).mean()) if tracked else 0.0
    error = off / max(turned, _TURNS) if max(off, turned) > _TURNS else 0.0
    larger = max(places) / max(float(np.median(places)), np.finfo(float).tiny)
    top = max(rate, default=None)
    usual = float(np.median(np.concatenate(turns))) if any(map(len, turns)) else 0.0
    return BodyMotion(
        *(
            name,
            fastest,
            top,
            *largest,
            jumps,
            turn_jumps,
            pattern,
            usual,
            error,
            larger,
            drift,
            lost,
        )
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

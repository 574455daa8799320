"""The motion of the bodies of a dataset, and signs that it cannot be right."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data.dataset import Dataset
from contactgraph.data.turns import rotation_vectors, turn_between

_ISOLATED = 10.0
"""Times the steps before and after it, and the median of those in which the body moves, from which
on a step is a jump."""


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


def jump_warning(motions: list[BodyMotion]) -> str | None:
    """One line about bodies that jump; None: none does."""
    found = [f"{each.name} {each.jumps} times" for each in motions if each.jumps]
    if not found:
        return None
    return (
        f"positions jump: {', '.join(found)}, in one step by more than {_ISOLATED:g} times those "
        "before and after; are these measurements?"
    )


def _motion(dataset: Dataset, name: str) -> BodyMotion:
    fastest, rate, largest, jumps = 0.0, [], (0.0, 0, 0.0), 0
    tracked: list[np.ndarray] = []
    for index, each in enumerate(dataset):
        if name not in each.scene.node_name:
            continue
        node, dt = each.scene.node_name.index(name), each.scene.dt
        steps = np.linalg.norm(np.diff(each.position[:, node], axis=0), axis=1)
        at = int(steps.argmax())
        largest = max(largest, (float(steps[at]), index, dt * (at + 1)))
        fastest = max(fastest, float(steps[at]) / dt)
        jumps += _jumps(steps)
        if each.orientation is not None:
            turn = each.orientation[:, node]
            turn = turn if turn.shape[1] == 1 else rotation_vectors(turn)
            between = turn_between(turn[:-1], turn[1:])
            rate += [float(np.nanmax(between)) / dt] if np.isfinite(between).any() else []
        if each.tracked is not None:
            tracked.append(each.tracked[:, node])
    lost = 1.0 - float(np.concatenate(tracked).mean()) if tracked else 0.0
    return BodyMotion(name, fastest, max(rate, default=None), *largest, jumps, lost)


def _jumps(steps: np.ndarray) -> int:
    """Steps [T] that are isolated."""
    moving = steps[steps > 0.0]
    if len(steps) < 3:
        return 0
    beside = np.pad(steps, 1, constant_values=0.0)
    limit = np.maximum(np.maximum(beside[:-2], beside[2:]), np.median(moving) if len(moving) else 0)
    return int(np.sum(steps > _ISOLATED * limit)) if len(moving) > 2 else 0

"""Beliefs about one edge over time, by what has corrected them, beside the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Array

from contactgraph.data import (
    Dataset,
    Trajectory,
    TrajectoryBatch,
    pair_indices,
    with_edge_labels,
)
from contactgraph.evaluate.trajectory_prediction import filtered_beliefs
from contactgraph.model import (
    ContactBelief,
    ContactDynamics,
    MotionNoise,
    default_sensor,
)
from contactgraph.model.scene import check_fit, trajectory_for

EDGE_STATES = ("free", "touch", "hold", "contact")
"""Drawn states of an edge; the last is touch or hold, where holding was not recorded."""
_FREE, _TOUCH, _HOLD, _CONTACT = range(4)
_NOTHING = "nothing"


@dataclass(frozen=True, eq=False)
class BeliefTimeline:
    """Beliefs about an edge after each of the ``T`` steps of a trajectory, and its true state."""

    name: str
    """Of the trajectories, e.g. their task."""
    edge: str
    """The names of the edge's two nodes."""
    dt: float
    """s"""
    truth: np.ndarray
    """[T] int: index in `EDGE_STATES`."""
    belief: Mapping[str, np.ndarray]
    """[T] probability that the label is true, by the name of what has corrected the belief."""
    state: Mapping[str, np.ndarray]
    """[T] int: the likeliest state, index in `EDGE_STATES`, by the same names."""
    scores: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    """Over all trajectories, by the same names: F1 of the edges of the step just made, and the
    N-step error of bodies that move, m."""

    @property
    def label(self) -> np.ndarray:
        """[T] bool: whether the edge holds, or is in contact where holding was not recorded."""
        return self.truth >= _HOLD

    @property
    def label_name(self) -> str:
        """The state that is the label."""
        return EDGE_STATES[max(_HOLD, int(np.max(self.truth)))]

    def agreement(self, source: str) -> float:
        """Share of the steps after which the belief is on the side of the label."""
        return float(np.mean(self._right(source)))

    def changes_shown(self, source: str) -> int:
        """The changes of the label that the belief shows at most one step late."""
        right, label, changed = self._right(source), self.label, self._changed
        later = np.minimum(changed + 1, len(label) - 1)
        return int(np.sum(right[changed] | (right[later] & (label[later] == label[changed]))))

    @property
    def caption(self) -> str:
        """What the picture shows, in words."""
        times = {1: "once", 2: "twice"}.get(len(self._changed), f"{len(self._changed)} times")
        first, *others = self.belief
        right = {one: f"{100.0 * self.agreement(one):.0f} %" for one in self.belief}
        said = ", ".join(f"by {one} after {right[one]}" for one in others)
        shown = ", ".join(str(self.changes_shown(one)) for one in self.belief)
        return (
            f"The {self.label_name} begins or ends {times}. Corrected by {first} the belief is "
            f"right after {right[first]} of the steps, {said}; changes that it shows within a "
            f"step: {shown}."
        )

    @property
    def _changed(self) -> np.ndarray:
        return np.flatnonzero(np.diff(self.label)) + 1

    def _right(self, source: str) -> np.ndarray:
        return (self.belief[source] > 0.5) == self.label


def belief_timeline(
    model: ContactDynamics, dataset: Dataset, name: str, motion_noise: MotionNoise | None
) -> BeliefTimeline | None:
    """Beliefs about the edge that `most_changed_edge` chooses; None where there is none.

    Each belief is predicted for every step from the recorded state before it, then corrected: by
    measured contacts and motion, by motion alone, and by nothing; without a ``motion_noise`` by
    contacts, and by nothing. ``name`` is that of the trajectories.
    Raises `InvalidInputError` where model and data do not fit.
    """
    chosen = most_changed_edge(dataset)
    if chosen is None:
        return None
    index, edge = chosen
    labelled = with_edge_labels(dataset)
    trajectory = labelled.trajectories[index]
    check_fit(model, trajectory.scene, trajectory.control_size, "the trajectory")
    # Padded as `evaluate_open_loop` does, so that both share a compiled filter.
    nodes = max(2, *(each.scene.node_count for each in dataset))
    steps = max(each.steps for each in dataset)

    def observed(contact: np.ndarray | None) -> TrajectoryBatch[Array]:
        known = replace(trajectory, contact=contact, holding=None)
        return trajectory_for(model, known, nodes, steps)

    measured, unmeasured = observed(trajectory.contact), observed(None)
    sensor = replace(default_sensor(model), reports_touch=labelled is dataset)
    by_motion = motion_noise is not None
    corrections = {"contacts and motion" if by_motion else "contacts": (measured, motion_noise)}
    if by_motion:
        corrections["motion alone"] = unmeasured, motion_noise
    corrections[_NOTHING] = unmeasured, None
    belief, state = {}, {}
    for source, (batch, noise) in corrections.items():
        posterior, *_ = filtered_beliefs(model, batch, sensor, noise)
        types = posterior.type_probability[1 : trajectory.steps + 1, edge]
        contacts = ContactBelief(types, edge_types=posterior.edge_types)
        belief[source] = np.asarray(sensor.contact_probability(contacts))
        state[source] = _likeliest(contacts, sensor.reports_touch)
    first, second = (trajectory.scene.node_name[n] for n in pair_indices(nodes)[edge])
    truth = _true_states(dataset.trajectories[index], sensor.reports_touch)[1:, edge]
    return BeliefTimeline(name, f"{first} and {second}", dataset.dt, truth, belief, state)


def most_changed_edge(dataset: Dataset) -> tuple[int, int] | None:
    """The trajectory and the edge in it whose true state changes most often; the first of several.

    Of edges with an actuated end, where any such edge changes. None without recorded contacts, or
    where no edge changes.
    """
    unlabelled = with_edge_labels(dataset) is dataset
    best: tuple[int, int] | None = None
    most = (False, 0)
    for index, each in enumerate(dataset):
        if each.contact is None:
            return None
        pairs = pair_indices(each.scene.node_count)
        changes = np.sum(np.diff(_true_states(each, unlabelled), axis=0) != 0, axis=0)
        driven = each.scene.actuated[pairs].any(axis=1)
        for edge in np.flatnonzero(changes):
            found = bool(driven[edge]), int(changes[edge])
            if found > most:
                best, most = (index, int(edge)), found
    return best


def _true_states(trajectory: Trajectory, unlabelled: bool) -> np.ndarray:
    """[T+1, E] int: index in `EDGE_STATES`; ``unlabelled``: holding is not known."""
    first, second = pair_indices(trajectory.scene.node_count).T
    assert trajectory.contact is not None
    contact = trajectory.contact[:, first, second]
    if unlabelled or trajectory.holding is None:
        return np.where(contact, _CONTACT, _FREE)
    return np.where(trajectory.holding[:, first, second], _HOLD, np.where(contact, _TOUCH, _FREE))


def _likeliest(belief: ContactBelief, unlabelled: bool) -> np.ndarray:
    """[T] int: index in `EDGE_STATES` of the likeliest state."""
    active, hold = np.asarray(belief.contact), np.asarray(belief.holding)
    if unlabelled:
        return np.where(active > 0.5, _CONTACT, _FREE)
    return np.argmax(np.stack([1.0 - active, active - hold, hold]), axis=0)

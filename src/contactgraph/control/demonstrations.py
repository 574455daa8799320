"""Demonstrations for cost learning: states, controls, linear dynamics, and their task nodes."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import ControlLimits
from contactgraph.control.contact_cost import KINDS, BeliefCost
from contactgraph.control.learned_cost import TaskNode
from contactgraph.control.lqr import tracking_problem
from contactgraph.control.riccati import LQRProblem
from contactgraph.data import (
    Dataset,
    InvalidInputError,
    TrajectoryBatch,
    edge_id,
    pad_trajectories,
    pair_indices,
    with_edge_labels,
)
from contactgraph.inference.features import turn_length_of
from contactgraph.model import ContactBelief, LinearDynamics, StepModel, default_sensor
from contactgraph.model.filter import FilteredTrajectory, filter_trajectory
from contactgraph.model.scene import check_fit, dtype_of, on_device

_LASTS = 0.9
"""Part of the steps since a contact began in which it must be active to count as kept."""
_AT_LIMIT = 1e-4
"""Part of the range of a control within which it counts as at a limit."""


WindowCost = tuple[Float[Array, "m m"], Float[Array, "U U"], BeliefCost | None]
"""Q, R, and the cost of contacts, None: of none."""


class Demonstrations(eqx.Module):
    """Trajectories of the ``M`` kept nodes, padded to the longest; ``m = 2MD`` as `stack_state`."""

    A: Float[Array, "K T m m"]
    B: Float[Array, "K T m U"]
    offset: Float[Array, "K T m"]
    states: Float[Array, "K T+1 m"]
    controls: Float[Array, "K T U"]
    """The free controls; 0 where a control was at a limit, whose effect is in ``offset``."""
    goal: Float[Array, "K m"]
    """Of every node, at rest."""
    beliefs: ContactBelief
    """[K, T+1, E, types] about the step that follows each state, of the pairs of kept nodes."""

    def window(
        self, start: Int[Array, " 2"], horizon: int, cost: WindowCost
    ) -> tuple[LQRProblem, Float[Array, "H+1 m"], Float[Array, "H U"]]:
        """The problem of ``horizon`` steps from a ``start`` (demonstration, step), and what was
        demonstrated in them.

        The contacts are expanded about the demonstration.
        """
        demonstration, begin = start
        Q, R, contacts = cost
        steps = begin + jnp.arange(horizon + 1)
        A, B, offset, controls, types = (
            each[demonstration, steps[:-1]]
            for each in (
                *(self.A, self.B, self.offset, self.controls),
                self.beliefs.type_probability,
            )
        )
        states = self.states[demonstration, steps]
        problem = tracking_problem(A, B, offset, Q, R, self.goal[demonstration])
        if contacts is None:
            return problem, states, controls
        of_nodes = states.reshape(horizon + 1, -1, 2, contacts.dimension)
        count = of_nodes.shape[1]
        believed = ContactBelief(types, edge_types=self.beliefs.edge_types)
        more, q = contacts.expanded(of_nodes, believed, jnp.arange(count))
        # From `block_state`'s order to `stack_state`'s.
        order = np.arange(states.shape[1]).reshape(2, count, -1).swapaxes(0, 1).reshape(-1)
        problem = replace(
            problem, Q=problem.Q + more[:, order[:, None], order], q=problem.q + q[:, order]
        )
        return problem, states, controls


def demonstrations_of(
    dataset: Dataset,
    filtered: FilteredTrajectory,
    names: Sequence[str],
    goal: np.ndarray | None = None,
    limits: ControlLimits | None = None,
) -> Demonstrations:
    """The named nodes' part of every trajectory; ``goal`` [D] m in place of their own.

    Where a control was at one of ``limits``, its optimum lies beyond. So it is held at the limit in
    the plan too, and not compared.

    Raises `InvalidInputError`, naming the demonstration, where one has no goal.
    """
    count, longest = len(dataset), max(trajectory.steps for trajectory in dataset)
    dimension, M, U = dataset.dimension, len(names), dataset.control_size
    nodes = np.array([[each.scene.node_name.index(name) for name in names] for each in dataset])
    states = np.zeros((count, longest + 1, 2 * M * dimension))
    controls = np.zeros((count, longest, U))
    goals = np.zeros((count, M, 2, dimension))
    for number, trajectory in enumerate(dataset):
        target = trajectory.scene.goal if goal is None else goal
        if target is None:
            raise InvalidInputError(f"demonstration {number}: goal is missing")
        both = np.stack([trajectory.position, trajectory.velocity], axis=2)[:, nodes[number]]
        states[number, : trajectory.steps + 1] = both.reshape(trajectory.steps + 1, -1)
        controls[number, : trajectory.steps] = trajectory.control
        goals[number, :, 0] = target
    free = np.ones_like(controls) if limits is None else _within(controls, limits)
    dtype = filtered.dynamics.A.dtype
    kept = jax.tree.map(
        lambda block: jax.vmap(lambda one, chosen: one[:-1, chosen, :dimension])(block, nodes),
        filtered.dynamics,
    )
    A, B, offset = jax.jit(LinearDynamics.stacked)(kept)
    held = jnp.asarray(controls * (1.0 - free), dtype)
    return Demonstrations(
        A=A,
        B=B * jnp.asarray(free, dtype)[:, :, None, :],
        offset=offset + jnp.einsum("rtmu,rtu->rtm", B, held),
        states=jnp.asarray(states, dtype),
        controls=jnp.asarray(controls * free, dtype),
        goal=jnp.asarray(goals.reshape(count, -1), dtype),
        beliefs=ContactBelief(_among(filtered.prior, nodes), edge_types=filtered.prior.edge_types),
    )


def _among(beliefs: ContactBelief, nodes: np.ndarray) -> Float[Array, "K T+1 E types"]:
    """The probabilities of the pairs of these ``nodes`` [K, M], in `pair_indices`' order."""
    pairs = np.sort(nodes[:, pair_indices(nodes.shape[1])], axis=-1)
    edges = edge_id(pairs[..., 0], pairs[..., 1])
    return jnp.take_along_axis(beliefs.type_probability, edges[:, None, :, None], axis=2)


def lasting_contacts(
    demonstrations: Dataset, filtered: FilteredTrajectory, names: Sequence[str]
) -> BeliefCost:
    """A cost, of weight 1, of the contacts of named nodes that demonstrations make to keep.

    In at least half of them the pair becomes active and hardly ever inactive again. ``pairs`` are
    of the names' indices.
    """
    nodes = np.array(
        [[each.scene.node_name.index(name) for name in names] for each in demonstrations], int
    )
    probability = np.asarray(_among(filtered.posterior, nodes))
    holds = np.array([each.holds for each in filtered.posterior.edge_types])
    pairs, kinds = [], []
    for edge, pair in enumerate(pair_indices(len(names)).tolist()):
        lasting, holding = 0, 0
        for number, trajectory in enumerate(demonstrations):
            types = probability[number, : trajectory.steps + 1, edge]
            active = types[:, 0] < 0.5
            since = types[int(np.argmax(active)) :]
            lasting += bool(active.any() and np.mean(since[:, 0] < 0.5) >= _LASTS)
            holding += bool(np.mean(since[:, 1:] @ holds) > 0.5)
        if 2 * lasting >= len(demonstrations):
            held = not holds.all() and 2 * holding >= len(demonstrations)
            pairs.append(pair)
            kinds.append(KINDS.index("hold" if held else "touch"))
    return BeliefCost(
        pairs=jnp.array(pairs, jnp.int32).reshape(-1, 2),
        weight=jnp.ones(len(pairs)),
        dimension=demonstrations.dimension,
        kind=jnp.array(kinds, jnp.int32),
    )


def window_starts(dataset: Dataset, horizon: int) -> np.ndarray:
    """[W, 2] (demonstration, step) of every window of ``horizon`` steps.

    Raises `InvalidInputError`, naming the demonstration, where one is shorter.
    """
    for number, trajectory in enumerate(dataset):
        if trajectory.steps < horizon:
            raise InvalidInputError(
                f"demonstration {number}: control must have at least the horizon's {horizon} "
                f"steps, found {trajectory.steps}"
            )
    return np.array(
        [(i, t) for i, each in enumerate(dataset) for t in range(each.steps - horizon + 1)]
    )


def _within(controls: np.ndarray, limits: ControlLimits) -> np.ndarray:
    """1 where a control is inside its limits, 0 at them or beyond."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    margin = _AT_LIMIT * (upper - lower)
    return ((controls > lower + margin) & (controls < upper - margin)).astype(float)


def filter_demonstrations(model: StepModel, demonstrations: Dataset) -> FilteredTrajectory:
    """[K, T, …] The model's beliefs along every trajectory, padded to the longest and largest.

    Contacts correct the beliefs where they were recorded. Raises `InvalidInputError`, naming the
    demonstration, where one has no control or does not fit the model.
    """
    for number, trajectory in enumerate(demonstrations):
        if trajectory.control_size == 0:
            raise InvalidInputError(
                f"demonstration {number}: control must have at least one axis, found none"
            )
        check_fit(model, trajectory.scene, trajectory.control_size, f"demonstration {number}")
    batch = pad_trajectories(with_edge_labels(demonstrations), turn_length=turn_length_of(model))
    return _filtered(model, on_device(batch, dtype_of(model)))


def task_nodes(demonstrations: Dataset, filtered: FilteredTrajectory) -> tuple[TaskNode, ...]:
    """Every node by name; kept ones first, in the order of their contacts.

    An edge is active where its probability is above 1/2. The paper drops a node that is not
    actuated and has no active edge in any demonstration at any step. Raises `InvalidInputError`,
    naming the demonstration, where nothing touches or a node that takes part is missing.
    """
    probability = np.asarray(filtered.posterior.contact)
    contact_times: dict[str, list[float]] = {}
    counts: dict[str, int] = {}
    actuated: set[str] = set()
    for number, trajectory in enumerate(demonstrations):
        count = trajectory.scene.node_count
        pairs = pair_indices(count)
        active = probability[number, : trajectory.steps + 1, : len(pairs)] > 0.5
        if not active.any():
            raise InvalidInputError(
                f"demonstration {number}: the model infers no contact; at least one is required"
            )
        for node, name in enumerate(trajectory.scene.node_name):
            counts[name] = counts.get(name, 0) + 1
            contact_times.setdefault(name, [])
            touching = active[:, (pairs == node).any(axis=1)].any(axis=1)
            if touching.any():
                contact_times[name].append(float(np.argmax(touching)) * trajectory.scene.dt)
            if trajectory.scene.actuated[node]:
                actuated.add(name)
    nodes = [
        TaskNode(
            name=name,
            actuated=name in actuated,
            trajectories=counts[name],
            active_trajectories=len(times),
            first_contact_time=float(np.median(times)) if times else None,
        )
        for name, times in contact_times.items()
    ]
    for each in nodes:
        for number, trajectory in enumerate(demonstrations if each.kept else ()):
            if each.name not in trajectory.scene.node_name:
                raise InvalidInputError(
                    f"demonstration {number}: node_name must have {each.name!r}, which takes part "
                    f"in others, found {', '.join(trajectory.scene.node_name)}"
                )
    return tuple(sorted(nodes, key=_in_order))


def _in_order(each: TaskNode) -> tuple[bool, bool, float]:
    time = np.inf if each.first_contact_time is None else each.first_contact_time
    return not each.kept, not each.actuated, time


@eqx.filter_jit
def _filtered(model: StepModel, batch: TrajectoryBatch[Array]) -> FilteredTrajectory:
    return jax.lax.map(lambda one: filter_trajectory(model, one, default_sensor(model)), batch)

"""Learned costs: their nodes in a scene, and their terms in relative coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.control.contact_cost import KINDS, BeliefCost
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.host import Observation
from contactgraph.data import InvalidInputError, Scene

ROUNDING = 1e-5
"""Part of the largest eigenvalue, or entry, by which rounding may change a symmetric matrix."""


@dataclass(frozen=True)
class CostLearningConfig:
    """The settings of cost learning."""

    horizon: int = 20
    """H, steps of the policy's plan."""
    steps: int = 400
    """Of Adam."""
    batch: int = 256
    """Windows a step."""
    learning_rate: float = 0.1
    discount: float = 0.95
    """Weight of each step of a window against the one before."""
    prior_weight: float = 3.0
    """0: the demonstrations alone."""
    contacts: bool = True
    """Whether what contacts are worth is learned, too."""

    def __post_init__(self) -> None:
        for name in ("horizon", "steps", "batch"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, found {getattr(self, name)}")
        if not self.learning_rate > 0.0:
            raise InvalidInputError(f"learning_rate must be positive, found {self.learning_rate}")
        if not 0.0 < self.discount <= 1.0:
            raise InvalidInputError(f"discount must be above 0, at most 1, found {self.discount}")
        if not self.prior_weight >= 0.0:
            raise InvalidInputError(f"prior_weight must be 0 or more, found {self.prior_weight}")


@dataclass(frozen=True)
class TaskNode:
    """One node of the demonstrations: whether it takes part in the task, and why."""

    name: str
    actuated: bool
    trajectories: int
    """Demonstrations in which the node exists."""
    active_trajectories: int
    """Those in which the model infers an active edge of it at some step."""
    first_contact_time: float | None
    """s, when its first edge becomes active; the median over those. None: never."""

    @property
    def kept(self) -> bool:
        """A node takes part if it is actuated or has an active edge in any demonstration."""
        return self.actuated or self.active_trajectories > 0

    @property
    def reason(self) -> str:
        """The reason to keep or drop it, for a user."""
        if self.active_trajectories:
            when = (
                f"in contact in {self.active_trajectories} of {self.trajectories} trajectories, "
                f"from {self.first_contact_time:g} s"
            )
            return f"actuated; {when}" if self.actuated else when
        unused = f"no active edge in any of {self.trajectories} trajectories"
        return "actuated" if self.actuated else unused


@dataclass(frozen=True)
class LearnedContact:
    """A contact that the demonstrations make and keep; see `BeliefCost`."""

    kind: str
    """``"touch"``, ``"hold"``, or ``"avoid"``, which is never learned but may stand in a file."""
    nodes: tuple[str, str]
    """Names of kept nodes; the first one is moved."""
    weight: float | tuple[float, ...]
    """In the units of Q and R; one a step only in files that were written by hand."""


class LearnedCost(eqx.Module):
    """``sum (x - goal)^T Q (x - goal) + sum u^T R u`` over the nodes that take part in a task, and
    what their contacts cost.

    ``x`` is `stack_state`'s vector of the kept nodes, in their order; the goal is the same point
    for all of them, at rest (the paper's ``x_f``). A cost is known up to a factor: here the mean of
    R's diagonal is 1/N^2.

    It is a `Cost`: `MPC` and `ILQR` take it as it is, for the scene of the demonstrations and
    their goal. `in_scene` and `with_goal` give it for others.
    """

    Q: Float[Array, "m m"] | Float[Array, "H+1 m m"]
    """``m = 2MD``; symmetric, positive semi-definite; 1/m^2 and s^2/m^2. One a step, as R, only in
    files that were written by hand."""
    R: Float[Array, "U U"] | Float[Array, "H U U"]
    """Symmetric, positive definite; 1/N^2."""
    goal: Float[Array, " D"]
    """m"""
    nodes: Int[Array, " M"]
    """Indices of the kept nodes in the scene."""
    kept_nodes: tuple[str, ...] = eqx.field(static=True)
    """[M] names, in the order in which they come into contact: gripper, first object, …"""
    imitation_loss: Float[Array, " S"]
    """At each step of learning, without contacts; see `contactgraph.control.cost_learner`."""
    task_nodes: tuple[TaskNode, ...] = eqx.field(static=True, default=())
    """All nodes of the demonstrations, kept and dropped."""
    contacts: tuple[LearnedContact, ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        return f"LearnedCost({', '.join(self.kept_nodes)}; Q{list(np.shape(self.Q))})"

    def with_goal(self, goal: Sequence[float] | np.ndarray) -> "LearnedCost":
        """The same cost, with another goal [D] m."""
        point = np.asarray(goal, dtype=np.float64)
        if point.shape != self.goal.shape or not np.all(np.isfinite(point)):
            raise InvalidInputError(
                f"goal must be {self.goal.shape[0]} finite numbers [m], found {goal}"
            )
        return replace(self, goal=jnp.asarray(point, self.goal.dtype))

    def in_scene(self, scene: Scene) -> "LearnedCost":
        """The same cost in another scene: its goal, and its nodes of the same names.

        Raises `InvalidInputError` where the scene has no goal or lacks a node.
        """
        if scene.goal is None:
            raise InvalidInputError("the scene has no goal; a cost needs one")
        if scene.dimension != self.goal.shape[0]:
            raise InvalidInputError(
                f"the cost is for dimension D {self.goal.shape[0]}, but the scene has "
                f"{scene.dimension}; they must agree"
            )
        missing = [name for name in self.kept_nodes if name not in scene.node_name]
        if missing:
            raise InvalidInputError(
                f"the cost is about the nodes {', '.join(self.kept_nodes)}, but the scene has no "
                f"{', '.join(missing)}; its nodes are {', '.join(scene.node_name)}"
            )
        nodes = [scene.node_name.index(name) for name in self.kept_nodes]
        return replace(self.with_goal(scene.goal), nodes=jnp.asarray(nodes, jnp.int32))

    @property
    def order(self) -> tuple[int, ...]:
        """[M] Indices of the kept nodes in the scene."""
        return tuple(int(node) for node in self.nodes)

    def among(self, nodes: Sequence[int]) -> "LearnedCost":
        """The same cost about other nodes [M] in place of the kept ones, in this order."""
        return replace(self, nodes=jnp.asarray(nodes, jnp.int32))

    def seeing(self, observation: Observation) -> "LearnedCost":
        """Itself, whatever is observed."""
        return self

    def quadratic(self, node_count: int) -> QuadraticCost:
        """The cost of a scene padded to ``node_count`` nodes."""
        part = self.Q.shape[-1] // len(self.kept_nodes)
        rows = (part * self.nodes[:, None] + jnp.arange(part)).reshape(-1)
        size = node_count * part
        Q = jnp.zeros((*self.Q.shape[:-2], size, size), self.Q.dtype)
        rest = jnp.concatenate([self.goal, jnp.zeros_like(self.goal)])
        goal = jnp.zeros((node_count, part), self.Q.dtype).at[self.nodes].set(rest)
        return QuadraticCost(
            Q=Q.at[..., rows[:, None], rows[None, :]].set(self.Q),
            R=self.R,
            goal=goal.reshape(-1),
            cost_node_ids=self.nodes,
            contacts=self._contacts(),
        )

    def _contacts(self) -> tuple[BeliefCost, ...]:
        if not self.contacts:
            return ()
        pairs = [[self.kept_nodes.index(name) for name in each.nodes] for each in self.contacts]
        given = [np.asarray(each.weight) for each in self.contacts]
        if len(sizes := {len(each) for each in given if each.ndim}) > 1:
            raise InvalidInputError(f"contacts must vary over as many steps each, found {sizes}")
        weights = np.broadcast_arrays(*given)
        return (
            BeliefCost(
                pairs=self.nodes[jnp.array(pairs)],
                weight=jnp.array(np.stack(weights, axis=-1), self.Q.dtype),
                dimension=self.goal.shape[0],
                kind=jnp.array([KINDS.index(each.kind) for each in self.contacts]),
            ),
        )


def relative_basis(nodes: int, dimension: int) -> np.ndarray:
    """``T`` [m, m] of ``M`` nodes with D degrees of freedom, in `stack_state`'s order.

    ``z = T (x - goal)`` are each node's state relative to the next one's, in the order of their
    contacts, and the last one's relative to the goal. The basis is invertible: every symmetric
    positive semi-definite Q is ``T^T W T``. The blocks on W's diagonal, the *relative terms* and
    the *goal term*, tie a gripper to an object and an object to its goal, as the paper's costs do.
    """
    return np.kron(np.eye(nodes) - np.eye(nodes, k=1), np.eye(2 * dimension))


def relative_terms(Q: np.ndarray, dimension: int) -> np.ndarray:
    """``W`` [..., m, m] of a ``Q`` [..., m, m]."""
    back = np.linalg.inv(relative_basis(Q.shape[-1] // (2 * dimension), dimension))
    return back.T @ np.asarray(Q, dtype=np.float64) @ back


def relative_names(nodes: Sequence[str]) -> tuple[str, ...]:
    """Names of W's blocks, e.g. ``("gripper - target", "target - goal")``."""
    return tuple(f"{a} - {b}" for a, b in zip(nodes, (*nodes[1:], "goal"), strict=True))


def independent_part(W: Float[Array, "m m"], isotropy: Float[Array, "D D"]) -> Float[Array, "m m"]:
    """The part of W without products of different terms or axes, equal along isotropic axes.

    It is the orthogonal projection onto all W of this form; within a term position and velocity may
    be tied. ``isotropy``: `isotropic_axes`.
    """
    D = isotropy.shape[0]
    M = W.shape[0] // (2 * D)
    blocks = W.reshape(M, 2, D, M, 2, D)
    own = jnp.einsum("apdaqd->apqd", blocks) @ isotropy.T
    return jnp.einsum("apqd,ab,de->apdbqe", own, jnp.eye(M), jnp.eye(D)).reshape(W.shape)


def isotropic_axes(gravity: np.ndarray) -> np.ndarray:
    """[D, D] Row i averages over the axes that axis i is equal to: those without gravity [D]."""
    falls = np.asarray(gravity) != 0.0
    same = (falls[:, None] == falls[None, :]) & ~(falls[:, None] & falls[None, :])
    same = same | np.eye(len(falls), dtype=bool)
    return same / same.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class CostTerm:
    """One of the relative terms of a cost, or its goal term, in units of force.

    With ``W`` the term's block of `relative_terms`, ``position = sqrt(mean diag W_pp / mean diag
    R)``, means over axes; ``velocity`` the same of ``W_vv``. A factor on Q and R changes neither.
    """

    name: str
    """E.g. ``"gripper - target"``."""
    position: float
    """N/m: a deviation of 1 m costs as much as this force, for one step each."""
    velocity: float
    """N s/m: a deviation of 1 m/s costs as much as this force, for one step each."""


def cost_terms(cost: LearnedCost) -> tuple[CostTerm, ...]:
    """The terms of a cost in the order of its kept nodes; the last one is about the goal.

    Of weights that vary over time, those of the first step.
    """
    D = cost.goal.shape[0]
    Q, R = (np.asarray(each, np.float64) for each in (cost.Q, cost.R))
    Q, R = (each.reshape(-1, *each.shape[-2:])[0] for each in (Q, R))
    weights = np.diagonal(relative_terms(Q, D)).reshape(-1, 2, D)
    of_force = float(np.mean(np.diagonal(R)))
    # Below zero by rounding alone is zero.
    sizes = np.sqrt(np.maximum(weights.mean(axis=2), 0.0) / of_force)
    return tuple(
        CostTerm(name, float(position), float(velocity))
        for name, (position, velocity) in zip(relative_names(cost.kept_nodes), sizes, strict=True)
    )

"""Costs of a plan, quadratic in state and control."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import is_known
from contactgraph.control.contact_cost import ContactCost
from contactgraph.data.errors import InvalidInputError
from contactgraph.inference.features import turn_length_of
from contactgraph.model import ContactBelief
from contactgraph.model.contact_dynamics import ContactDynamics

_ROUNDING = 1e-5
"""Of the entries of a positive semi-definite matrix in single precision, relative."""


class Cost(Protocol):
    """A cost for `MPC` and `ILQR`: any object that becomes quadratic in a scene."""

    def quadratic(self, node_count: int) -> "QuadraticCost":
        """The cost of a scene padded to ``node_count`` nodes."""
        ...


def _symmetric(matrix: Any) -> Any:
    """The symmetric part of matrices [..., n, n]; arrays of NumPy stay NumPy's."""
    matrix = matrix if isinstance(matrix, np.ndarray) else jnp.asarray(matrix)
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2]:
        raise InvalidInputError(f"a weight must be a square matrix, found shape {matrix.shape}")
    return 0.5 * (matrix + matrix.swapaxes(-1, -2))


def _is_definite(matrix: Any) -> bool:
    try:
        np.linalg.cholesky(np.asarray(matrix, np.float64))
    except np.linalg.LinAlgError:
        return False
    return True


class QuadraticCost(eqx.Module):
    """``sum_{t=0..H} (x_t - goal)^T Q_t (x_t - goal) + sum_{t=0..H-1} u_t^T R_t u_t``.

    The paper's convention: no factor 1/2. ``x`` is `stack_state`'s vector, ``n = 2ND``. Of ``Q``
    and ``R`` only the symmetric parts count. Every leaf is an array, so another goal or weight does
    not recompile a function of it.

    Raises `InvalidInputError` where a number is not finite, ``Q`` is not positive semi-definite,
    ``R`` is not positive definite, or shapes do not fit.

    >>> cost = QuadraticCost(Q=jnp.eye(4), R=jnp.eye(2), goal=jnp.zeros(4))
    >>> cost
    QuadraticCost(Q[4, 4], R[2, 2], goal[4])
    >>> float(cost(states=jnp.ones((2, 4)), controls=jnp.ones((1, 2))))  # 4 a state, 2 a control
    10.0
    """

    Q: Float[Array, "n n"] | Float[Array, "H+1 n n"] = eqx.field(converter=_symmetric)
    """State weight, the same for all steps or one a step; 1/m^2 and s^2/m^2."""
    R: Float[Array, "U U"] | Float[Array, "H U U"] = eqx.field(converter=_symmetric)
    """Control weight, 1/N^2."""
    goal: Float[Array, " n"] | Float[Array, "H+1 n"]
    """Target state, m and m/s."""
    terminal_weight: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.ones(()))
    """Factor on the last step's ``Q``."""
    cost_node_ids: Int[Array, " M"] | None = None
    """Nodes whose rows of ``Q`` are not all zero. None: all of them.

    The dynamics are block diagonal, one block a node, so the gain on a node without cost is
    exactly zero: naming the ``M`` nodes that have one makes the backward pass cost what ``M``
    nodes cost and changes no answer. Rows of other nodes are ignored.
    """
    contacts: tuple[ContactCost, ...] = ()
    """Added to it: what is to be touched, and what is not; see `touch`, `avoid`, `keep_clear`."""
    turn_length: float = eqx.field(static=True, default=1.0)
    """m; unit of turns, where ``n = 2NG`` includes them: 1 for angles in rad and rates in rad/s.
    See `contactgraph.data.generalized_coordinates`."""

    def __check_init__(self) -> None:
        size = np.shape(self.goal)[-1]
        if self.Q.shape[-2:] != (size, size) or self.R.shape[-2] != self.R.shape[-1]:
            raise InvalidInputError(
                f"Q [{size}, {size}] and R [U, U] must fit the goal [{size}], found {self!r}"
            )
        if not is_known(*jax.tree.leaves(self)):
            return
        Q, weight = np.asarray(self.Q, np.float64), np.asarray(self.terminal_weight)
        for name, value in (("Q", Q), ("R", self.R), ("goal", self.goal)):
            if len(unknown := np.argwhere(~np.isfinite(value))):
                raise InvalidInputError(f"{name} must be finite, not so at {unknown[0].tolist()}")
        if not np.all(weight >= 0.0):
            raise InvalidInputError(f"terminal_weight must be at least 0, found {weight}")
        slack = _ROUNDING * np.max(np.abs(Q), initial=np.finfo(np.float32).tiny)
        weighed = np.flatnonzero(np.any(Q != 0.0, axis=tuple(range(Q.ndim - 1))))  # a small part
        if not _is_definite(Q[..., weighed[:, None], weighed] + slack * np.eye(len(weighed))):
            raise InvalidInputError("Q must be positive semi-definite: this cost has no minimum")
        if not _is_definite(self.R):
            raise InvalidInputError("R must be positive definite: each control must cost something")

    def __repr__(self) -> str:
        shapes = (f"{name}{list(np.shape(getattr(self, name)))}" for name in ("Q", "R", "goal"))
        return f"QuadraticCost({', '.join(shapes)})"

    @property
    def control_size(self) -> int:
        """U, the size of the control."""
        return self.R.shape[-1]

    def __call__(
        self,
        states: Float[Array, "H+1 ..."],
        controls: Float[Array, "H U"],
        beliefs: ContactBelief | None = None,
    ) -> Array:
        """The cost of states [H+1, N, 2, D], or [H+1, n] without ``contacts``, and controls."""
        return jnp.sum(self.by_step(states, controls, beliefs))

    def by_step(
        self,
        states: Float[Array, "H+1 ..."],
        controls: Float[Array, "H U"],
        beliefs: ContactBelief | None = None,
    ) -> Float[Array, " H+1"]:
        """The cost of each step, of the last its state alone; none is negative.

        ``beliefs`` [H, E, K] are needed with ``contacts``; `InvalidInputError` without.
        """
        Q, R, goal = self.over(controls.shape[0])
        error = states.reshape(goal.shape) - goal
        of_state = jnp.sum(error * jnp.einsum("tij,tj->ti", Q, error), axis=-1)
        of_control = jnp.sum(controls * jnp.einsum("tij,tj->ti", R, controls), axis=-1)
        for each in self.contacts:
            if beliefs is None:
                raise InvalidInputError("a cost of contacts needs the plan's beliefs")
            of_state += each.by_step(states, beliefs)
        return of_state.at[:-1].add(of_control)

    def quadratic(self, node_count: int) -> "QuadraticCost":
        """Itself: the `Cost` that is one already."""
        return self

    def fitted(self, model: object, node_count: int, xp: Any = jnp) -> "QuadraticCost":
        """The cost in the coordinates of the model's states; a cost of positions alone weighs no
        turn.

        ``xp``: jnp, or np for a cost of NumPy arrays. Raises `InvalidInputError` where ``goal`` has
        neither 2ND entries nor, for bodies that turn, 2NG, or ``R`` is of other controls.
        """
        size = getattr(model, "control_size", self.control_size)
        if size != self.control_size:
            raise InvalidInputError(
                f"the cost is of {self.control_size} controls, but the model of {size}"
            )
        found, turn_length = self.goal.shape[-1], turn_length_of(model)
        known, rest = divmod(found, 2 * node_count)
        dimension = known
        if turn_length is not None:
            assert isinstance(model, ContactDynamics)
            dimension, coordinates = model.dimension, model.coordinates
            rest = rest or known not in (dimension, coordinates)
        if rest:
            raise InvalidInputError(
                f"cost.goal must have 2ND entries for the capacity N = {node_count}, found {found}"
            )
        if turn_length is None or (known, turn_length) == (coordinates, self.turn_length):
            return self
        unit = np.ones(coordinates)
        unit[dimension:] = turn_length / self.turn_length
        whole = self._with_coordinates(node_count, coordinates, unit, xp)
        return replace(whole, turn_length=turn_length)

    def with_angle(
        self, node: int, angle: float, weight: float, node_count: int
    ) -> "QuadraticCost":
        """Also ``weight`` [1/rad^2] times the squared difference of a body's angle from ``angle``
        [rad], at every step; a cost in the plane, of which it becomes one with turns."""
        whole = self._with_coordinates(node_count, 3, np.ones(3))
        index = 6 * node + 2
        return replace(
            whole,
            Q=whole.Q.at[..., index, index].add(weight),
            goal=whole.goal.at[..., index].set(angle),
        )

    def _with_coordinates(
        self, node_count: int, coordinates: int, unit: np.ndarray, xp: Any = jnp
    ) -> "QuadraticCost":
        """With G = ``coordinates`` a node, in these units; those beyond its own cost nothing."""
        known = self.goal.shape[-1] // (2 * node_count)
        of_node, size = (node_count, 2, known), 2 * node_count * coordinates
        Q = self.Q.reshape(*self.Q.shape[:-2], *of_node, *of_node)
        goal = self.goal.reshape(*self.goal.shape[:-1], *of_node)
        more = (0, coordinates - known)

        def padded(values: Any, axes: tuple[int, ...]) -> Any:
            widths = [more if axis - values.ndim in axes else (0, 0) for axis in range(values.ndim)]
            return xp.pad(values, widths)

        Q = padded(Q, (-4, -1)) / (unit[:, None, None, None] * unit)
        goal = padded(goal, (-1,)) * unit
        return replace(
            self,
            Q=Q.reshape(*self.Q.shape[:-2], size, size).astype(self.Q.dtype),
            goal=goal.reshape(*self.goal.shape[:-1], size).astype(self.goal.dtype),
        )

    @property
    def last(self) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
        """``Q`` with the terminal weight, and ``goal``, of the last state."""
        Q = self.Q.reshape(-1, *self.Q.shape[-2:])[-1]
        return Q * self.terminal_weight, self.goal.reshape(-1, self.goal.shape[-1])[-1]

    def over(self, horizon: int) -> tuple[Array, Array, Array]:
        """``Q [H+1,n,n]``, ``R [H,U,U]`` and ``goal [H+1,n]``, one a step.

        Raises `InvalidInputError` where weights are those of another horizon.
        """
        size = self.goal.shape[-1]
        for name, value, count in (("Q", self.Q, horizon + 1), ("R", self.R, horizon)):
            if value.ndim == 3 and len(value) != count:
                raise InvalidInputError(
                    f"{name} must have {count} matrices for {horizon} steps, found {len(value)}"
                )
        Q = jnp.broadcast_to(self.Q, (horizon + 1, size, size))
        R = jnp.broadcast_to(self.R, (horizon, *self.R.shape[-2:]))
        goal = jnp.broadcast_to(self.goal, (horizon + 1, size))
        return Q.at[-1].multiply(self.terminal_weight), R, goal


def chain_cost(
    chain: Sequence[int],
    pick_weights: Sequence[float] | np.ndarray,
    goal_weights: Sequence[float] | np.ndarray,
    control_weight: float,
    goal: Sequence[float] | np.ndarray,
    node_count: int,
    control_size: int | None = None,
    command_weight: float | None = None,
    terminal_weight: float = 1.0,
) -> QuadraticCost:
    """A cost that ties each node of the chain to the next, and the last to the goal, as the paper.

    ``sum over neighbours (x_a - x_b)^T diag(pick_weights) (x_a - x_b)
    + (x_last - x_goal)^T diag(goal_weights) (x_last - x_goal) + control_weight |u|^2``,
    at every step, with ``x_goal`` at rest in ``goal``.

    **Arguments:** ``chain``: nodes, gripper first. ``pick_weights``, ``goal_weights``: [2D],
    D on positions, then D on velocities. ``goal``: [D] m. ``node_count``: N, the capacity.
    ``control_size``: U; D where it is not given. ``command_weight``: on the squares of components
    beyond D, such as a switch; None: ``control_weight``. ``terminal_weight``: factor on the last
    step's cost of the state.

    Raises `InvalidInputError` where a weight is negative or a shape or node does not fit.
    """
    point = np.asarray(goal, dtype=np.float64)
    dimension = point.shape[0] if point.ndim == 1 else 0
    if dimension == 0 or not np.all(np.isfinite(point)):
        raise InvalidInputError(f"goal must be D finite numbers [m], found {goal}")
    if len(chain) == 0 or len(set(chain)) != len(chain):
        raise InvalidInputError(f"chain must name different nodes, at least one, found {chain}")
    if min(chain) < 0 or max(chain) >= node_count:
        raise InvalidInputError(f"chain must name nodes 0 to {node_count - 1}, found {chain}")
    if not control_weight > 0:
        raise InvalidInputError(f"control_weight must be positive, found {control_weight}")
    if not (command_weight is None or command_weight > 0):
        raise InvalidInputError(f"command_weight must be positive, found {command_weight}")
    pick = _checked_weights("pick_weights", pick_weights, 2 * dimension)
    last = _checked_weights("goal_weights", goal_weights, 2 * dimension)

    size = 2 * dimension
    Q = np.zeros((node_count, size, node_count, size))
    for first, second in itertools.pairwise(chain):
        Q[first, :, first] += np.diag(pick)
        Q[second, :, second] += np.diag(pick)
        Q[first, :, second] -= np.diag(pick)
        Q[second, :, first] -= np.diag(pick)
    Q[chain[-1], :, chain[-1]] += np.diag(last)
    target = np.zeros((node_count, size))
    target[list(chain), :dimension] = point
    R = control_weight * np.eye(dimension if control_size is None else control_size)
    if command_weight is not None:
        R[dimension:, dimension:] *= command_weight / control_weight
    return QuadraticCost(
        Q=jnp.asarray(Q.reshape(node_count * size, node_count * size)),
        R=jnp.asarray(R),
        goal=jnp.asarray(target.reshape(-1)),
        terminal_weight=jnp.asarray(float(terminal_weight)),
        cost_node_ids=jnp.asarray(np.asarray(chain, dtype=np.int32)),
    )


def _checked_weights(name: str, weights: Sequence[float] | np.ndarray, size: int) -> np.ndarray:
    checked = np.asarray(weights, dtype=np.float64)
    if checked.shape != (size,):
        raise InvalidInputError(f"{name} must have shape ({size},), found {checked.shape}")
    if not (np.all(np.isfinite(checked)) and np.all(checked >= 0)):
        raise InvalidInputError(f"{name} must be finite and not negative, found {weights}")
    return checked

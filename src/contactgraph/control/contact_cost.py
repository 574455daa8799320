"""Costs of contacts that a plan is to make, keep or avoid: of beliefs, and of distances."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.graph import edge_id
from contactgraph.model import ContactBelief

KINDS = ("avoid", "touch", "hold")
_AVOID, _TOUCH, _HOLD = range(len(KINDS))
_LENGTH = 1.0
"""m; at this distance a contact that is missing costs twice as much as close by."""
_TINY = 1e-9
"""m; where two bodies coincide, no direction leads away."""

Pairs = Sequence[tuple[int, int]] | np.ndarray


class ContactCost(eqx.Module):
    """A term of `QuadraticCost` about pairs of bodies: not quadratic, and expanded by Gauss-Newton.

    The first body of a pair is moved away from, or to, the second one, which is taken to move as it
    is predicted: its own share in the slope is left out. What is planned is still judged by the
    whole cost. Other arrays of the same shapes do not recompile.
    """

    pairs: Int[Array, "P 2"]
    weight: Float[Array, " P"] | Float[Array, "T P"]
    dimension: int = eqx.field(static=True)
    """D; coordinates of a position, of which turns are none."""

    @property
    def reach(self) -> float:
        """m; up to which distance bodies matter that touch nothing."""
        return 0.0

    @property
    def wanted_nodes(self) -> np.ndarray:
        """Nodes that are to be touched, which a plan must be about wherever they are."""
        return np.zeros(0, np.int32)

    @abstractmethod
    def by_step(
        self, states: Float[Array, "H+1 N 2 G"], beliefs: ContactBelief
    ) -> Float[Array, " H+1"]:
        """The cost of each step; ``beliefs`` [H, E, K], belief t about step t."""

    @abstractmethod
    def _residual(self, states: Array, beliefs: ContactBelief) -> tuple[Array, Array, Array]:
        """``r`` [H+1, P] of the cost ``weight * r^2``, its slope [H+1, P, D] with respect to the
        first body's position, and the weight [H+1, P]."""

    def among(self, node_ids: np.ndarray) -> Any:
        """In the part of a scene about these nodes, -1 for padding; on the host.

        Pairs with a node outside the part weigh nothing.
        """
        ids, pairs = node_ids[node_ids >= 0], np.asarray(self.pairs)
        inside = np.isin(pairs, ids)
        after: Any = np.where(inside, np.searchsorted(ids, pairs), 0).astype(np.int32)
        weight: Any = np.where(inside.all(axis=1), np.asarray(self.weight), 0)
        return replace(self, pairs=after, weight=weight)

    def _weights(self, steps: int) -> Float[Array, "T P"]:
        """Raises `InvalidInputError` where they are those of another number of steps."""
        if self.weight.ndim == 2 and len(self.weight) != steps:
            raise InvalidInputError(
                f"weights of contacts must be of {steps} steps, found {len(self.weight)}"
            )
        return jnp.broadcast_to(self.weight, (steps, len(self.pairs)))

    def _apart(self, states: Array) -> tuple[Array, Array]:
        """[H+1, P] m between the centres, and [H+1, P, D] from the second to the first."""
        position = states[:, :, 0, : self.dimension]
        apart = position[:, self.pairs[:, 0]] - position[:, self.pairs[:, 1]]
        return jnp.sqrt(jnp.sum(apart**2, axis=-1) + _TINY**2), apart

    def expanded(
        self,
        states: Float[Array, "H+1 N 2 G"],
        beliefs: ContactBelief,
        node_ids: Int[Array, " M"],
    ) -> tuple[Float[Array, "H+1 m m"], Float[Array, "H+1 m"]]:
        """``Q``, positive semi-definite, and ``q`` of ``x^T Q x + 2 q^T x`` near these states, for
        x as `block_state` of the M nodes."""
        residual, slope, weight = self._residual(states, beliefs)
        is_first = self.pairs[:, 0, None] == node_ids
        J = jnp.where(is_first[..., None], slope[:, :, None, :], 0.0)
        more = states.shape[-1] - self.dimension
        J = jnp.pad(J, [(0, 0)] * 3 + [(0, more)]).reshape(*residual.shape, -1)
        J = jnp.concatenate([J, jnp.zeros_like(J)], axis=-1)  # no slope in velocities
        x = jnp.moveaxis(states[:, node_ids], 2, 1).reshape(len(states), -1)
        weighted = weight[..., None] * J
        rest = residual - jnp.einsum("tpi,ti->tp", J, x)
        return jnp.einsum("tpi,tpj->tij", weighted, J), jnp.einsum("tpi,tp->ti", weighted, rest)


class BeliefCost(ContactCost):
    r"""``sum over steps and pairs of weight * P(not as wanted) * (1 + (|x_a - x_b| / 1 m)^2)``,
    the last factor only where a contact is wanted, so that the way to it pays, too.

    The probability is what the model believes along the plan: of being active where a pair is to
    be avoided, of not being active where it is to touch, of not holding where it is to hold. So a
    weight is what one step without the contact, or with one that is not wanted, costs.

    What the belief owes to the motion has no part in the linear dynamics. The slope is therefore
    that of ``weight * P * (d / d_0)^2`` for a contact that is wanted, which is the same cost at the
    distance ``d_0`` of the trajectory, and none where the centres meet; and of
    ``weight * P * (2 - d / d_0)^2`` for one that is not.
    """

    kind: Int[Array, " P"]
    """Of `KINDS`, by index."""

    @property
    def wanted_nodes(self) -> np.ndarray:
        """See `ContactCost`."""
        return np.unique(np.asarray(self.pairs)[np.asarray(self.kind) != _AVOID])

    def by_step(
        self, states: Float[Array, "H+1 N 2 G"], beliefs: ContactBelief
    ) -> Float[Array, " H+1"]:
        """The cost of each step; none of the last state, about which there is no belief."""
        return jnp.sum(self._costs(states, beliefs)[0], axis=-1)

    def _residual(self, states: Array, beliefs: ContactBelief) -> tuple[Array, Array, Array]:
        costs, length, apart = self._costs(states, beliefs)
        away = jnp.where(self.kind == _AVOID, -1.0, 1.0) / length**2
        return jnp.ones_like(length), away[..., None] * apart, costs

    def _costs(self, states: Array, beliefs: ContactBelief) -> tuple[Array, Array, Array]:
        """[H+1, P], and what `_apart` gives."""
        length, apart = self._apart(states)
        edge = edge_id(jnp.min(self.pairs, axis=-1), jnp.max(self.pairs, axis=-1))
        count = edge_id(0, states.shape[1])
        listed = jax.vmap(lambda belief: belief.over(edge, count))(beliefs)
        active, holding = listed.contact, listed.holding
        violated = jnp.where(self.kind == _AVOID, active, 1.0 - active)
        violated = jnp.where(self.kind == _HOLD, 1.0 - holding, violated)
        far = jnp.where(self.kind == _AVOID, 0.0, (length / _LENGTH) ** 2)
        costs = jnp.pad(self._weights(len(violated)) * violated, [(0, 1), (0, 0)]) * (1.0 + far)
        return costs.astype(states.dtype), length, apart


class DistanceCost(ContactCost):
    """``sum over steps and pairs of weight * max(0, distance - |x_a - x_b|)^2``, ``weight`` in
    1/m^2, the same for all states or one [H+1, P] a state; 0 leaves a pair out."""

    distance: Float[Array, " P"]
    """m, from centre to centre."""

    @property
    def reach(self) -> float:
        """See `ContactCost`."""
        return float(np.max(np.asarray(self.distance), initial=0.0))

    def by_step(
        self, states: Float[Array, "H+1 N 2 G"], beliefs: ContactBelief
    ) -> Float[Array, " H+1"]:
        """The cost of each state, whatever is believed."""
        missing = self._missing(self._apart(states)[0])
        return jnp.sum(self._weights(len(missing)) * missing**2, axis=-1)

    def _residual(self, states: Array, beliefs: ContactBelief) -> tuple[Array, Array, Array]:
        length, apart = self._apart(states)
        missing = self._missing(length)
        slope = jnp.where((missing > 0.0)[..., None], -apart / length[..., None], 0.0)
        return missing, slope, self._weights(len(missing))

    def _missing(self, length: Array) -> Array:
        return jax.nn.relu(self.distance - length)


def touch(pairs: Pairs, weight: float | np.ndarray, dimension: int = 2) -> BeliefCost:
    """A cost of not being in contact: each step costs ``weight`` times the probability of it.

    ``pairs``: (moved node, other node); the moved one must be a node with a cost. ``weight``: one
    number, [P], or [H, P], one a step. Raises `InvalidInputError` where a number is out of range.
    """
    return _beliefs(_TOUCH, pairs, weight, dimension)


def hold(pairs: Pairs, weight: float | np.ndarray, dimension: int = 2) -> BeliefCost:
    """A cost of not holding, for models of three edge types or more; arguments as of `touch`."""
    return _beliefs(_HOLD, pairs, weight, dimension)


def avoid(pairs: Pairs, weight: float | np.ndarray, dimension: int = 2) -> BeliefCost:
    """A cost of being in contact; arguments as of `touch`."""
    return _beliefs(_AVOID, pairs, weight, dimension)


def keep_clear(
    pairs: Pairs,
    distance: float | Sequence[float] | np.ndarray,
    weight: float | np.ndarray,
    dimension: int = 2,
) -> DistanceCost:
    """A cost of coming nearer than ``distance`` [m, centre to centre], one number or [P].

    ``weight`` [1/m^2] may be [H+1, P]; the other arguments and errors are those of `touch`.
    """
    nodes, weights = _checked(pairs, weight)
    gaps = _not_negative("distance", np.broadcast_to(distance, len(nodes)))
    return DistanceCost(nodes, weights, dimension, jnp.asarray(gaps))


def _beliefs(kind: int, pairs: Pairs, weight: float | np.ndarray, dimension: int) -> BeliefCost:
    nodes, weights = _checked(pairs, weight)
    return BeliefCost(nodes, weights, dimension, jnp.full(len(nodes), kind, jnp.int32))


def _checked(pairs: Pairs, weight: float | np.ndarray) -> tuple[Array, Array]:
    nodes = np.asarray(pairs, dtype=np.int32).reshape(-1, 2)
    if np.any(nodes < 0) or np.any(nodes[:, 0] == nodes[:, 1]):
        raise InvalidInputError(f"pairs must name two different nodes each, found {pairs}")
    weights = _not_negative("weight", weight)
    weights = np.broadcast_to(weights, (*weights.shape[:-1], len(nodes)))
    return jnp.asarray(nodes), jnp.asarray(weights)


def _not_negative(name: str, values: Any) -> np.ndarray:
    checked = np.asarray(values, dtype=np.float64)
    if not (np.all(np.isfinite(checked)) and np.all(checked >= 0.0)):
        raise InvalidInputError(f"{name} must be finite and not negative, found {values}")
    return checked

"""Inference of active edges: their prior and weight by distance, and beliefs from step to step."""

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from contactgraph.bodies.geometry import Geometry
from contactgraph.bodies.graph import HOLD, EdgeType
from contactgraph.bodies.message_passing import EdgeNetwork, MessagePassing
from contactgraph.data.trajectory_batch import Nodes
from contactgraph.inference.contact_belief import ContactBelief


class ClosestApproachPrior(eqx.Module):
    r"""Probability of contact from the closest approach of two nodes within the step.

    $$ q = \epsilon + (1 - 2 \epsilon)\, \sigma\big( 2 (m \rho - d) / (s \rho) \big) $$

    with $\rho$ the contact distance, which the model learns from impacts, and $d$ the distance of
    closest approach in the next step: the edge of a step must already be active when bodies touch
    *within* it. No gradient flows to $\rho$. The prior is never more certain than $\epsilon$,
    because an unknown force may bring bodies together or keep them apart.
    """

    margin: float = eqx.field(static=True, default=1.003)
    """$m$; factor on the contact distance below which nodes count as touching."""
    sharpness: float = eqx.field(static=True, default=0.002)
    """$s$."""
    min_probability: float = eqx.field(static=True, default=0.01)
    r"""$\epsilon$."""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Prior probability that each edge is active."""
        touch = jax.lax.stop_gradient(geometry.contact_distance)
        margin = (self.margin * touch - geometry.closest_approach) / (self.sharpness * touch)
        spread = 1.0 - 2.0 * self.min_probability
        return self.min_probability + spread * jax.nn.sigmoid(2.0 * margin)


class SmoothCutoff(eqx.Module):
    """Weight of an edge by distance: 1 below `inner` [m], exactly 0 from `outer` [m] on.

    A node beyond the cutoff of all others changes no prediction of theirs, exactly.
    """

    inner: float = eqx.field(static=True, default=0.15)
    outer: float = eqx.field(static=True, default=0.25)

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight of each edge in [0, 1], by its closest approach in the step."""
        fraction = (self.outer - geometry.closest_approach) / (self.outer - self.inner)
        fraction = jnp.clip(fraction, 0.0, 1.0)
        return fraction**2 * (3.0 - 2.0 * fraction)


class NoCutoff(eqx.Module):
    """Weight 1 at every distance: the paper's all-pairs inference."""

    outer: float = eqx.field(static=True, default=math.inf)
    """m"""

    def __call__(self, geometry: Geometry) -> Float[Array, " E"]:
        """Weight 1 for every edge."""
        return jnp.ones_like(geometry.distance)


class EdgeInference(eqx.Module):
    """Beliefs about the types of edges, from step to step.

    ``embed`` turns one step's graph into edge embeddings, independent of time; ``predict`` turns
    the belief about the last step, an embedding and the geometric prior into the belief about the
    next one. The split keeps the expensive part out of the loop over time. Another recurrent cell
    is another class with these two methods and a field ``edge_types``: see
    ``examples/extend_recurrent_cell.py``. All else has a default.
    """

    edge_types: eqx.AbstractVar[tuple[EdgeType, ...]]
    """The active types."""
    commands: int = eqx.field(static=True, default=0, kw_only=True)
    """Last components of the control that are features of the edges of actuated nodes."""

    def embed(
        self,
        node: Float[Array, "N F"],
        edge: Float[Array, "2 E G"],
        weight: Float[Array, " E"],
        edge_index: Int[Array, "2 E"],
    ) -> Float[Array, "E M"]:
        """What one step's graph tells about every edge, by default nothing; ``edge`` are
        `edge_inputs`."""
        return jnp.zeros((weight.shape[0], 0), node.dtype)

    @abstractmethod
    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The belief about the next step, and the probability of each pair of types before and
        after; `without_change` makes these of a belief alone."""

    def init(self, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]) -> ContactBelief:
        """The belief before the first observation: by default the geometric prior."""
        return ContactBelief(prior, edge_types=self.edge_types)

    def table(self, belief: ContactBelief) -> Float[Array, "E K A"]:
        """The probability of each type and age; by default there are no ages."""
        return belief.type_probability[..., None]

    def parted(
        self, table: Float[Array, "E K A"], embedding: Float[Array, "E M"]
    ) -> Float[Array, "E K A"]:
        """The table before a step, linear in that after the last one: by default the same."""
        return table

    def transitions(
        self, embedding: Float[Array, "E M"], prior: Float[Array, "E K"]
    ) -> Float[Array, "E K A K"]:
        """The probability of each type after a step, given type and age before it: by default that
        which `predict` has for a first belief."""

        def from_type(types: Float[Array, " K"]) -> Float[Array, "E K"]:
            belief = self.init(embedding, jnp.broadcast_to(types, prior.shape))
            return self.predict(belief, embedding, prior)[0].type_probability

        every = jnp.eye(prior.shape[-1], dtype=prior.dtype)
        return jax.vmap(from_type, out_axes=1)(every)[:, :, None]

    @property
    def log_prior(self) -> Float[Array, ""] | float:
        """Log-density of the parameters of the transitions before training, up to a constant."""
        return 0.0

    @property
    def networks(self) -> list[MessagePassing | EdgeNetwork]:
        """Those whose messages decide about edges."""
        return []

    def edge_inputs(
        self,
        features: Float[Array, "2 E F"],
        geometry: Geometry,
        nodes: Nodes,
        command: Float[Array, " U"],
    ) -> Float[Array, "2 E G"]:
        """What `embed` is given of every edge: by default the model's edge ``features`` alone."""
        return features


class PriorEdges(EdgeInference):
    """The geometric prior alone, as an ablation of inference: no belief survives a step.

    The prior knows no types, so all of its active part is of one. Corrections still apply to the
    step just made. With ``least`` 1 every edge is active at every step (the paper's No-GIM).
    """

    edge_types: tuple[EdgeType, ...] = eqx.field(static=True, default=(HOLD,))
    active_type: int = eqx.field(static=True, default=1)
    least: float = eqx.field(static=True, default=0.0)
    """Probability that an edge is active whatever its prior."""

    def predict(
        self, belief: ContactBelief, embedding: Float[Array, "E 0"], prior: Float[Array, "E K"]
    ) -> tuple[ContactBelief, Float[Array, "E K K"]]:
        """The prior; pairs of equal types, none of which motion makes possible if it is not."""
        active = self.least + (1.0 - self.least) * jnp.sum(prior[:, 1:], axis=-1)
        types = jnp.zeros_like(prior).at[:, 0].set((1.0 - self.least) * prior[:, 0])
        types = types.at[:, self.active_type].set(active)
        joint = types[:, :, None] * jnp.eye(types.shape[-1], dtype=types.dtype)
        return ContactBelief(types, edge_types=self.edge_types), joint

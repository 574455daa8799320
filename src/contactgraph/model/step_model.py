"""What the planner asks of a model. Any object with these two functions can be planned with."""

from typing import Protocol

from jaxtyping import Array, Float

from contactgraph.model.belief import ContactBelief
from contactgraph.model.linear_dynamics import LinearDynamics
from contactgraph.model.state import ModelState, Nodes


class StepModel(Protocol):
    """A locally linear model, whose linearisation knows the control through `ModelState.push` only.

    It must be a pytree (an `equinox.Module` is), so that its weights can be passed to compiled
    functions.
    """

    def linear_step(self, state: ModelState, nodes: Nodes) -> tuple[LinearDynamics, ContactBelief]:
        """The linear dynamics of the coming step, and the belief they rest on."""
        ...

    def initial_belief(
        self, position: Float[Array, "N D"], velocity: Float[Array, "N D"], nodes: Nodes
    ) -> ContactBelief:
        """The belief before anything was seen."""
        ...

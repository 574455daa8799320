"""Learning the cost of demonstrations through a differentiable LQR.

**The policy.** From each state of a demonstration, `lqr_trajectory` solves the linear-quadratic
problem of the next ``H`` steps, with the learned model's dynamics along the demonstration. Model
predictive control with this cost would plan the same there, if it met the same contacts.

**The loss.** Planned against demonstrated states and controls, each in units of its variation in
the demonstrations. Step ``t`` of a window has the weight ``discount**t``, since a controller that
replans acts on the first steps. A control at its limit is held there in the plan too.

**What is learned.** With ``z`` the relative coordinates of `relative_basis`,
``Q = T^T W T``, ``W = S L L^T S`` and ``R = Lu Lu^T``, ``L`` and ``Lu`` lower triangular and free:
every symmetric positive semi-definite Q and R, and no other. ``S`` (fixed) carries the units. A
cost is known up to a factor, which the mean of R's diagonal settles: it is 1/N^2.

**The prior.** Demonstrations with one goal and one object position leave much of Q open: a pull
towards the object and a pull towards some point relative to the goal are the same. Independent
terms transfer to other goals: gripper to object, object to goal, isotropic along all axes without
gravity. The share of ``W`` that is not of this form costs ``prior_weight`` times its square, and
stays where the demonstrations require it.

Source: the paper's cost learning (its section of that name), which follows Amos et al. 2018,
"Differentiable MPC for End-to-end Planning and Control"; prior and basis are ours.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from contactgraph.control.box_qp import ControlLimits
from contactgraph.control.contact_cost import KINDS, BeliefCost
from contactgraph.control.demonstrations import (
    Demonstrations,
    WindowCost,
    demonstrations_of,
    filter_demonstrations,
    lasting_contacts,
    task_nodes,
    window_starts,
)
from contactgraph.control.learned_cost import (
    ROUNDING,
    CostLearningConfig,
    LearnedContact,
    LearnedCost,
    independent_part,
    isotropic_axes,
    relative_basis,
)
from contactgraph.control.lqr_adjoint import lqr_trajectory
from contactgraph.data import Dataset, InvalidInputError
from contactgraph.model import StepModel

if TYPE_CHECKING:
    import optax

_CHUNK = 50
"""Steps in one compiled call."""
_LEAST = 1e-5
"""R's smallest eigenvalue; their mean is 1."""
_FIRST_CONTACT = 0.1
"""Weight of a contact at first, in units of the square of a typical control."""
_DEFAULT = CostLearningConfig()


class FreeCost(eqx.Module):
    """The learned parameters."""

    L: Float[Array, "m m"]
    Lu: Float[Array, "U U"]
    log_contact: Float[Array, " P"]
    """Logarithm of the weights of contacts, in units of the square of a typical control."""


LearnerState = tuple[FreeCost, "optax.OptState"]


class CostLearner(eqx.Module):
    """The constants of cost learning."""

    basis: Float[Array, "m m"]
    """T"""
    units: Float[Array, " m"]
    """S: with L = 1 a typical error gives a typical control."""
    isotropy: Float[Array, "D D"]
    contacts: BeliefCost
    """Those that are wanted; each weight is the square of a typical control."""
    state_weight: Float[Array, "H+1 m"]
    control_weight: Float[Array, "H U"]
    config: CostLearningConfig = eqx.field(static=True)

    def begin(self) -> LearnerState:
        """The first state, in which a typical error gives a typical control."""
        m, U = self.basis.shape[0], self.control_weight.shape[1]
        dtype = self.basis.dtype
        begin = jnp.full(self.contacts.weight.shape, np.log(_FIRST_CONTACT), dtype)
        free = FreeCost(jnp.eye(m, dtype=dtype), jnp.eye(U, dtype=dtype), begin)
        return free, self.optimiser().init(free)

    def optimiser(self) -> "optax.GradientTransformation":
        """Adam, with a rate that falls to zero."""
        import optax  # slow to import

        config = self.config
        return optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.steps))

    def cost(self, free: FreeCost) -> tuple[Array, Array, Array]:
        """Q, R, and the relative terms without units."""
        L, Lu = jnp.tril(free.L), jnp.tril(free.Lu)
        W = L @ L.T
        R = Lu @ Lu.T
        scaled = self.units[:, None] * W * self.units[None, :]
        return self.basis.T @ scaled @ self.basis, R * R.shape[0] / jnp.trace(R), W

    def weighted(self, free: FreeCost) -> BeliefCost:
        """The contacts with their learned weights."""
        return replace(self.contacts, weight=self.contacts.weight * jnp.exp(free.log_contact))

    def loss(
        self, free: FreeCost, data: Demonstrations, windows: Int[Array, "b 2"]
    ) -> tuple[Array, Array]:
        """The objective, and the imitation loss without contacts.

        The weights of contacts are those that imitate best with Q and R as they are.
        """
        Q, R, W = self.cost(free)
        imitation = total = self.imitation((Q, R, None), data, windows)
        if len(self.contacts.pairs):
            fixed = jax.lax.stop_gradient((Q, R))
            total += self.imitation((*fixed, self.weighted(free)), data, windows)
        tied = jnp.sum((W - independent_part(W, self.isotropy)) ** 2) / jnp.sum(W**2)
        even = jnp.sum((R - jnp.eye(R.shape[0])) ** 2) / R.shape[0]
        return total + self.config.prior_weight * (tied + even), imitation

    def imitation(
        self, cost: WindowCost, data: Demonstrations, windows: Int[Array, "b 2"]
    ) -> Array:
        """The imitation loss, a mean over windows (demonstration, step)."""

        def one(window: Int[Array, " 2"]) -> Array:
            problem, states, controls = data.window(window, self.config.horizon, cost)
            planned = lqr_trajectory(problem, states[0])
            of_states = jnp.sum(self.state_weight * (planned.states - states) ** 2)
            return of_states + jnp.sum(self.control_weight * (planned.controls - controls) ** 2)

        return jnp.mean(jax.vmap(one)(windows))


def cost_learner(
    data: Demonstrations,
    starts: np.ndarray,
    config: CostLearningConfig,
    isotropy: np.ndarray,
    contacts: BeliefCost,
) -> CostLearner:
    """A learner whose units are those of the data; arguments as of `fit_cost`.

    Raises `InvalidInputError` where no window moves or no control acts.
    """
    D, H = isotropy.shape[0], config.horizon
    m = data.states.shape[-1]
    states = np.asarray(data.states, dtype=np.float64)
    index, begin = starts[:, 0], starts[:, 1]
    moved = (states[index, begin + H] - states[index, begin]).reshape(len(starts), -1, 2, D)
    force = _size(np.asarray(data.controls), "control")
    distance = _size(moved[:, :, 0], "position")
    speed = _size(states.reshape(*states.shape[:2], -1, 2, D)[:, :, :, 1], "velocity")
    scale = np.tile(np.repeat([distance, speed], D), m // (2 * D))
    weight = config.discount ** np.arange(H)
    weight = weight / weight.sum()
    dtype = data.states.dtype
    U = data.controls.shape[-1]
    return CostLearner(
        basis=jnp.asarray(relative_basis(m // (2 * D), D), dtype),
        units=jnp.asarray(force / scale, dtype),
        isotropy=jnp.asarray(isotropy, dtype),
        contacts=replace(contacts, weight=jnp.full(len(contacts.pairs), force**2, dtype)),
        state_weight=jnp.asarray(np.append(0.0, weight)[:, None] / (m * scale**2), dtype),
        control_weight=jnp.asarray(np.tile(weight[:, None] / (U * force**2), (1, U)), dtype),
        config=config,
    )


def _size(values: np.ndarray, name: str) -> float:
    """Root mean square; raises where it is zero."""
    size = float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
    if not size > 0.0:
        raise InvalidInputError(f"demonstrations: {name} never changes from 0")
    return size


@eqx.filter_jit
def advance_learner(
    learner: CostLearner, data: Demonstrations, state: LearnerState, windows: Int[Array, "S b 2"]
) -> tuple[LearnerState, tuple[Array, dict[str, Array]]]:
    """As many steps of Adam as there are batches of windows.

    Of each step the imitation loss, and the smallest eigenvalues of Q and R.
    """
    import optax  # slow to import

    optimiser = learner.optimiser()

    def step(state: LearnerState, batch: Array) -> tuple[LearnerState, tuple]:
        free, inner = state
        gradient, imitation = jax.grad(learner.loss, has_aux=True)(free, data, batch)
        change, inner = optimiser.update(gradient, inner)
        free = optax.apply_updates(free, change)
        Q, R, _ = learner.cost(free)
        q, r = jnp.linalg.eigvalsh(Q), jnp.linalg.eigvalsh(R)
        # Below zero by rounding alone is zero.
        rounded = jnp.where(q[0] > -ROUNDING * q[-1], jnp.maximum(q[0], 0.0), q[0])
        return (free, inner), (imitation, {"R": r[0], "Q": rounded})

    return jax.lax.scan(step, state, windows)


def fit_cost(
    data: Demonstrations,
    starts: np.ndarray,
    isotropy: np.ndarray,
    contacts: BeliefCost,
    config: CostLearningConfig,
    seed: int = 0,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> tuple[Array, Array, Array, Array]:
    """Q [m, m], R [U, U] and weights of contacts [P] whose optimal plans from the states ``starts``
    [W, 2] are the data; and the imitation loss of each step.

    ``isotropy`` [D, D]: `isotropic_axes`. ``contacts``: `lasting_contacts`. ``seed``: of the order
    of windows. ``on_step`` receives, every 50 steps, the steps done and the imitation loss. Raises
    `InvalidInputError` where Q or R loses its definiteness, with the step and the smallest
    eigenvalue.
    """
    learner = cost_learner(data, starts, config, isotropy, contacts)
    order = np.random.default_rng(seed).integers(len(starts), size=(config.steps, config.batch))
    state = learner.begin()
    parts: list[np.ndarray] = []
    for begin in range(0, config.steps, _CHUNK):
        windows = jnp.asarray(starts[order[begin : begin + _CHUNK]])
        state, (loss, smallest) = advance_learner(learner, data, state, windows)
        for name, least in (("R", _LEAST), ("Q", 0.0)):
            values = np.asarray(smallest[name])
            if len(lost := np.flatnonzero(~(values >= least))):
                raise InvalidInputError(
                    f"learning the cost stopped at step {begin + lost[0] + 1}: {name}'s smallest "
                    f"eigenvalue is {values[lost[0]]:.3g}; a smaller learning rate may help"
                )
        parts.append(np.asarray(loss))
        on_step(begin + len(windows), float(np.mean(loss)))
    Q, R, _ = learner.cost(state[0])
    weights = learner.weighted(state[0]).weight
    return 0.5 * (Q + Q.T), 0.5 * (R + R.T), weights, jnp.concatenate(parts)


def learn_cost(
    model: StepModel,
    demonstrations: Dataset,
    config: CostLearningConfig = _DEFAULT,
    *,
    goal: Sequence[float] | np.ndarray | None = None,
    limits: ControlLimits | None = None,
    seed: int = 0,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
) -> LearnedCost:
    """Q and R under which the model's optimal plans are the demonstrations.

    Nodes that take part in none of them are left out (`task_nodes`). ``goal`` [D] m replaces the
    goals of the scenes. ``limits`` bounded the demonstrated controls. ``seed`` and ``on_step`` are
    those of `fit_cost`.

    Raises `InvalidInputError` where a demonstration has no control or goal, is shorter than the
    horizon, does not fit the model, touches nothing or lacks a node; and where Q or R loses its
    definiteness, with the step and the smallest eigenvalue.
    """
    scene = demonstrations.trajectories[0].scene
    target = None if goal is None else np.asarray(goal, dtype=np.float64)
    if target is not None and (target.shape != (scene.dimension,) or not np.isfinite(target).all()):
        raise InvalidInputError(f"goal must be {scene.dimension} finite numbers [m], found {goal}")
    starts = window_starts(demonstrations, config.horizon)
    filtered = filter_demonstrations(model, demonstrations)
    nodes = task_nodes(demonstrations, filtered)
    kept = tuple(each.name for each in nodes if each.kept)
    data = demonstrations_of(demonstrations, filtered, kept, target, limits)
    isotropy = isotropic_axes(scene.gravity)
    contacts = lasting_contacts(demonstrations, filtered, kept if config.contacts else ())
    Q, R, weights, loss = fit_cost(data, starts, isotropy, contacts, config, seed, on_step)
    return LearnedCost(
        Q=Q,
        R=R,
        goal=data.goal[0, : scene.dimension],
        nodes=jnp.asarray([scene.node_name.index(name) for name in kept], jnp.int32),
        kept_nodes=kept,
        imitation_loss=loss,
        task_nodes=nodes,
        contacts=tuple(
            LearnedContact(KINDS[kind], (kept[first], kept[second]), float(weight))
            for kind, (first, second), weight in zip(
                contacts.kind.tolist(), contacts.pairs.tolist(), weights, strict=True
            )
        ),
    )

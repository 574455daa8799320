"""Scenes and models that the model tests share."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.bodies.geometry import Geometry, geometry
from contactgraph.bodies.shapes import meeting
from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    PAPER_PRESETS,
    ContactDynamics,
    ModelConfig,
    ModelState,
    Nodes,
    full_ab,
    ours,
    paper_literal,
)
from contactgraph.model import PRESETS as NAMED
from contactgraph.relations import relations

DT = 0.05


def geometry_of(
    position,
    velocity,
    edge_index,
    dt,
    contact_distance,
    control_displacement=None,
    *,
    anchor=None,
    half_size=None,
    static=None,
) -> Geometry:
    """Of balls, and of bars and boxes where an ``anchor`` or ``half_size`` is given."""
    places = meeting(position, edge_index, anchor, half_size).with_fixed(static)
    moved = control_displacement
    return geometry(
        places,
        velocity=velocity,
        coasting=velocity,
        dt=dt,
        contact_distance=contact_distance,
        driven=None if moved is None else places.relative(moved),
    )


jitted_geometry = eqx.filter_jit(geometry_of)


@eqx.filter_jit
def compiled(function: Callable, *arguments):
    """``function(*arguments)`` as one program; uncompiled, each operation would be one."""
    return function(*arguments)


def assert_same(ours, theirs, **tolerance: float) -> None:
    """Every leaf equals the other's: within these tolerances, without any of them bit for bit."""
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        if tolerance:
            np.testing.assert_allclose(one, other, **tolerance)
        else:
            np.testing.assert_array_equal(one, other)


PRESETS = {
    "recurrent": NAMED["ours-recurrent"],
    "memoryless": NAMED["ours-memoryless"],
    "no_inference": NAMED["ours-no-inference"],
    "full_ab": full_ab,
    "paper_literal": paper_literal,
    "paper_literal_no_gim": PAPER_PRESETS["paper-literal-no-gim"],
    "ours": ours,
    "relations": relations,
}


def slippery_bodies(config: ModelConfig) -> ContactDynamics:
    """The preset `ours`, which nothing slows but touches."""
    return eqx.tree_at(
        lambda each: (
            each.local_dynamics.head.damper_raw,
            each.local_dynamics.head.deceleration_raw,
        ),
        ours(replace(config, rough=True), key=jax.random.key(0)),
        [jnp.full(len(config.node_types), -10.0)] * 2,
    )


def preset(
    name: str, dimension: int = 2, seed: int = 0, width: int = 16, hinges: bool = False
) -> ContactDynamics:
    """A preset with random weights, of the number type that is on."""
    return _preset(name, dimension, seed, width, hinges, jnp.zeros(()).dtype)


@cache
def _preset(
    name: str, dimension: int, seed: int, width: int, hinges: bool, _: np.dtype
) -> ContactDynamics:
    def construct() -> ContactDynamics:
        key = jax.random.PRNGKey(0)
        return PRESETS[name](
            ModelConfig(dimension, dimension, DT, width=width, hinges=hinges), key=key
        )

    return with_random_weights(construct, seed)


def with_random_weights(construct: Callable[[], ContactDynamics], seed: int = 0) -> ContactDynamics:
    """The result of `construct`, with weights drawn by numpy, which compiles nothing."""
    rng = np.random.default_rng(seed)

    def draw(path: tuple, leaf: object) -> object:
        if not isinstance(leaf, jax.ShapeDtypeStruct):
            return leaf
        if leaf.ndim == 0:  # The touch distance, and the raw theta.
            return jax.device_put(np.full((), 0.1, leaf.dtype))
        # Masses and gains are exponentials and squares of theirs: some that bodies could have.
        name = path[-1].name if hasattr(path[-1], "name") else ""
        if name == "matrix":  # of an actuation, the same along all axes
            return jax.device_put(np.broadcast_to(np.eye(*leaf.shape[1:]), leaf.shape))
        if name in ("bias", "stiffness_root") and "actuation" in str(path):
            return jax.device_put(np.zeros(leaf.shape, leaf.dtype))
        single = name == "log_mass"
        bound = 0.2 if single else 1.5 / np.sqrt(leaf.shape[-1])
        return jax.device_put(rng.uniform(-bound, bound, leaf.shape).astype(leaf.dtype))

    return jax.tree_util.tree_map_with_path(draw, eqx.filter_eval_shape(construct))


def nodes_of(count: int, capacity: int | None = None) -> Nodes:
    """The first of `count` nodes is actuated; every pair that exists is a candidate."""
    mask = np.arange(capacity or count) < count
    pairs = pair_indices(len(mask))
    return Nodes(
        actuated=jnp.asarray(np.arange(len(mask)) == 0),
        mask=jnp.asarray(mask),
        candidate=jnp.asarray(mask[pairs].all(axis=1)),
    )


def hinged(nodes: Nodes, *anchors: tuple[float, ...]) -> Nodes:
    """The same nodes, of which those from the second on hang on hinges there."""
    anchor = np.full((len(nodes.mask), len(anchors[0])), np.nan)
    anchor[1 : 1 + len(anchors)] = anchors
    return nodes._replace(anchor=jnp.asarray(anchor))


def crowd(model: ContactDynamics, nodes: Nodes, seed: int = 0, size: float = 0.15) -> ModelState:
    """Nodes close enough that most edges matter, with the prior as belief."""
    rng = np.random.default_rng(seed)
    shape = (len(nodes.mask), model.dimension)
    exists, kind = np.asarray(nodes.mask)[:, None], jnp.zeros(()).dtype
    drawn = rng.uniform(-size, size, shape), rng.normal(size=shape)
    position, velocity = (jax.device_put((exists * each).astype(kind)) for each in drawn)
    return state_at(model, position, velocity, nodes)


_initial_belief = eqx.filter_jit(ContactDynamics.initial_belief)


def state_at(model: ContactDynamics, position, velocity, nodes: Nodes) -> ModelState:
    return ModelState(position, velocity, _initial_belief(model, position, velocity, nodes))


def follow(model: ContactDynamics, nodes: Nodes, position, velocity, controls) -> ModelState:
    """The states after each control. Every number of controls is another program."""
    return _follow(model, nodes, *map(jnp.asarray, (position, velocity, controls)))


@eqx.filter_jit
def _follow(model: ContactDynamics, nodes: Nodes, position, velocity, controls) -> ModelState:
    belief = model.initial_belief(position, velocity, nodes)
    return model.rollout(ModelState(position, velocity, belief), controls, nodes)

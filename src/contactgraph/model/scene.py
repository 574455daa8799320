"""Scenes and trajectories as a model takes them, and whether they suit it."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.data.padding import pad_nodes, pad_trajectories
from contactgraph.data.trajectory_batch import Nodes, TrajectoryBatch
from contactgraph.dynamics.body_types import PACE
from contactgraph.inference.features import turn_length_of
from contactgraph.model.body_mass import varying_types


def scene_nodes(scene: Scene, node_capacity: int | None = None) -> Nodes:
    """The nodes of a scene, padded to ``node_capacity`` (default: no padding).

    Raises `InvalidInputError` where the scene has more nodes.
    """
    capacity = scene.node_count if node_capacity is None else node_capacity
    return jax.tree.map(jnp.asarray, pad_nodes(scene, capacity))


def told_log_mass(model: Any, scene: Scene) -> np.ndarray | None:
    """[N] `Nodes.log_mass` of the masses that a scene tells, in units of the first actuated node's.

    None where bodies of a type weigh alike in the model, or the scene tells no mass or has no such
    node.
    """
    head = varying_types(model)
    if head is None or scene.mass is None or not scene.actuated.any():
        return None
    types = np.asarray(model.features.node_type(scene_nodes(scene), head.log_mass.dtype))
    missing = np.log(scene.mass) - PACE * types @ np.asarray(head.log_mass)
    return np.asarray(missing - missing[np.argmax(scene.actuated)])


def check_fit(model: Any, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where a scene or its control do not suit the model.

    ``other`` names what does not, e.g. ``"the data"``. Only models with `Features`, such as a
    `ContactDynamics`, declare what they are for.
    """
    if not hasattr(model, "features"):
        return
    if model.neighbor_list is not None:
        raise InvalidInputError(
            f"beliefs about {other} are over all pairs, so the model must have no neighbor list "
            "(neighbor_list=None)"
        )
    for what, found, wanted in (
        ("dimension D", scene.dimension, model.dimension),
        ("control size U", control_size, model.control_size),
    ):
        if found != wanted:
            raise InvalidInputError(
                f"the model is for {what} {wanted}, but {other} has {found}; they must agree"
            )
    if not math.isclose(scene.dt, model.dt, rel_tol=1e-6):
        raise InvalidInputError(
            f"the model is for dt {model.dt:g} s, but {other} has {scene.dt:g} s; they must agree"
        )
    check_controls(model, scene, control_size, other)
    unknown = sorted(set(scene.node_type) - set(model.features.types))
    if model.features.types and unknown:
        raise InvalidInputError(
            f"{other} has nodes of type {', '.join(unknown)}, which the model does not know; it "
            f"knows {', '.join(model.features.types)}"
        )
    if model.features.turn_length is not None and not scene.polygons:
        raise InvalidInputError(
            f"the model is for bodies that turn, but {other} has no polygons, their outlines"
        )
    if model.features.hinges is True and not scene.hinged.any():
        raise InvalidInputError(
            f"the model is for bodies on hinges, but {other} has no anchor, the position of "
            "each hinge"
        )
    if model.features.hinges is False and scene.hinged.any():
        raise InvalidInputError(
            f"the model has no hinges, but {other} has an anchor; train a model on such data"
        )


def check_controls(model: Any, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where the model's control does not reach a degree of freedom.

    Component d of the control moves degree of freedom d of every actuated node, and further ones
    move nothing. Free matrices (`FreeLinearDynamics`) map any control to any motion.
    """
    aligned = getattr(getattr(model, "local_dynamics", None), "axis_aligned", False)
    if control_size < scene.dimension and scene.actuated.any() and aligned:
        raise InvalidInputError(
            f"{other} has actuated nodes, but control size U {control_size}; it must be at least "
            f"D = {scene.dimension}, because component d of the control moves degree of freedom d "
            "(zeros where there is no drive), or no node may be actuated"
        )


def on_device(batch: TrajectoryBatch[np.ndarray], dtype: np.dtype) -> TrajectoryBatch[Array]:
    """The same trajectories as JAX arrays; floating-point numbers have the type ``dtype``."""

    def moved(leaf: np.ndarray) -> Array:
        return jnp.asarray(leaf, dtype if np.issubdtype(leaf.dtype, np.floating) else None)

    return jax.tree.map(moved, batch)


def trajectory_for(
    model: object,
    trajectory: Trajectory,
    node_capacity: int | None = None,
    steps: int | None = None,
    contacts: bool = True,
) -> TrajectoryBatch[Array]:
    """One trajectory in the coordinates of the model, without a batch axis: `pad_trajectories`."""
    batch = pad_trajectories(
        (trajectory,),
        node_capacity,
        steps,
        contacts=contacts,
        turn_length=turn_length_of(model),
    )
    return on_device(batch.at(0), dtype_of(model))


def dtype_of(model: object) -> np.dtype:
    """The floating type of the model's weights; JAX's default where it has none."""
    for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array)):
        return np.dtype(leaf.dtype)
    return np.dtype(jax.dtypes.canonicalize_dtype(np.float64))

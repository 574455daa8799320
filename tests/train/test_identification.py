"""Laws of touches found by simulated steps, without gradients."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.data import Dataset, Scene, Trajectory, generalized_coordinates
from contactgraph.identify import identify
from contactgraph.model import (
    ContactDynamics,
    ModelConfig,
    ModelState,
    PriorEdges,
    ours,
    scene_nodes,
)
from contactgraph.train import TrainConfig, fit, initial_state

DT = 0.02
OUTLINE = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
SCENE = Scene(
    *(("box", "far"), ("box",) * 2, np.zeros(2, bool), DT),
    gravity=np.array([0.0, -9.81]),
    planes=np.array([[0.0, 1.0, 0.0]]),
    polygons=(OUTLINE,) * 2,
    polygon_of=np.arange(2),
    control_kind=(),
)


@eqx.filter_jit
def follow(model: ContactDynamics, nodes, position, velocity) -> ModelState:
    belief = model.initial_belief(position, velocity, nodes)
    return model.rollout(ModelState(position, velocity, belief), jnp.zeros((40, 0)), nodes)


def recorded(model: ContactDynamics, seed: int) -> Trajectory:
    rng, length = np.random.default_rng(seed), model.features.turn_length
    height, velocity = rng.uniform(0.1, 0.2, 2), rng.uniform([-1.5, -1.0], [1.5, 0.0], (2, 2))
    turning = rng.uniform(-3.0, 3.0, (2, 1)), rng.uniform(-4.0, 4.0, (2, 1))
    place = np.stack([[0.0, 9.0], height], axis=1)
    state = generalized_coordinates(length, place, velocity, *turning)
    first = [jnp.asarray(each, jnp.float32) for each in state]
    found = follow(model, scene_nodes(SCENE), *first)
    position, velocity = (
        np.concatenate([start[None], np.asarray(each)])
        for start, each in zip(state, (found.position, found.velocity), strict=True)
    )
    turn, rate = position[..., 2:] / length, velocity[..., 2:] / length
    control = np.zeros((40, 0))
    return Trajectory(
        SCENE,
        position[..., :2],
        velocity[..., :2],
        control,
        orientation=turn,
        angular_velocity=rate,
    )


def at_rest(states: int) -> Trajectory:
    still, zero = np.zeros((states, 2, 2)), np.zeros((states, 2, 1))
    place = still + np.array([[0.0, 0.03], [9.0, 0.03]])
    control = np.zeros((states - 1, 0))
    return Trajectory(SCENE, place, still, control, orientation=zero, angular_velocity=zero)


def config(dataset: Dataset) -> ModelConfig:
    return replace(identify(dataset).config, width=4)


def laws(model: ContactDynamics) -> tuple[float, float]:
    """Bounce on the floor, and the coefficient of friction."""
    head = model.local_dynamics.head
    return tuple(float(each[0]) for each in head.laws(jnp.eye(1), jnp.zeros(1, int)))


def test_bounce_and_friction_of_a_model_are_found_from_its_own_motion() -> None:
    fresh = ours(config(Dataset((at_rest(9),))), key=jax.random.key(0))
    true = eqx.tree_at(
        lambda each: (
            each.local_dynamics.head.bounce_raw,
            each.local_dynamics.head.friction_raw,
        ),
        fresh,
        (jnp.array([0.0, 0.4]), jnp.array([0.4, 0.3])),
    )
    data = [recorded(true, seed) for seed in range(12)]
    assert config(Dataset(tuple(data))).identified
    training = TrainConfig(steps=7, batch_size=4, window_length=3, check_every=3)
    progress = []
    result = fit(
        initial_state(fresh, training, 0),
        *(Dataset(tuple(data[:10])), Dataset(tuple(data[10:]))),
        training,
        progress.append,
    )
    assert isinstance(result.model.inference, PriorEdges)
    assert [each.step for each in progress] == [7] and int(result.state.step) == 7
    np.testing.assert_allclose(laws(result.model), laws(true), rtol=0.05)
    assert abs(laws(fresh)[1] - laws(true)[1]) > 0.3
    assert result.held_out_rmse_m < 0.1 * result.baselines.constant_velocity_rmse_m


def test_what_the_data_do_not_tell_stays() -> None:
    """Boxes at rest: gradients of nothing once made them bounce by 0.83 and slide."""
    data = Dataset((at_rest(41),) * 4)
    made = config(data)
    assert made.identified
    training = TrainConfig(steps=3, batch_size=4, window_length=3, check_every=3)
    fresh = ours(made, key=jax.random.key(0))
    result = fit(initial_state(fresh, training, 0), data, data, training)
    bounce, friction = laws(result.model)
    assert bounce < 0.2 and friction > 0.3

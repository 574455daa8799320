"""Pins between two bodies: motion against Box2D and a closed form, gaps, energy, padding."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import follow, slippery_bodies

from contactgraph.data import Dataset, Scene, Trajectory, generalized_coordinates
from contactgraph.envs.planar.body import PlanarBody
from contactgraph.envs.planar.world import PlanarWorld
from contactgraph.envs.shaped_tasks import box_outline
from contactgraph.evaluate import evaluate_open_loop
from contactgraph.evaluate.metrics import pin_drift
from contactgraph.evaluate.trajectory_prediction import largest_pin_gaps, pin_gaps
from contactgraph.identify import Units, identify, in_units
from contactgraph.identify.shapes import CONTACT_DISTANCE
from contactgraph.inference.contact_belief import nothing_active
from contactgraph.model import ContactDynamics, ModelConfig, scene_nodes

pytestmark = pytest.mark.usefixtures("double_precision")

DT, STEPS, FORCE = 0.05, 200, 2.0
HALF = np.array([0.1, 0.015])
END, BEGIN = np.array([0.1, 0.0]), np.array([0.3, -0.2])
TURN_LENGTH = float(np.sqrt((HALF @ HALF) / 3.0))
encode = eqx.filter_jit(ContactDynamics.encode)
SCENE = Scene(
    node_name=("hand", "first", "second"),
    node_type=("hand", "link", "link"),
    actuated=np.array([True, False, False]),
    dt=DT,
    control_kind=("force", "force"),
    polygons=(box_outline(HALF), box_outline(HALF)),
    polygon_of=np.array([1, 2]),
    pins=np.array([[0, 1], [2, 1]]),
    pin_points=np.array([[[0.0, 0.0], -END], [-END, END]]),
    candidate_edges=np.zeros((0, 2), int),  # it may fold
)
CONFIG = ModelConfig(
    2,
    2,
    DT,
    0.06,
    width=4,
    node_types=("link", "hand"),
    turn_length=TURN_LENGTH,
    inertia={"link": 1.0},
    learned_contact_distance=False,
    theta=0.51,
)
PENDULUM = replace(
    SCENE,
    actuated=np.zeros(3, bool),
    static=np.array([True, False, False]),
    control_kind=None,
)


@cache
def model() -> ContactDynamics:
    """Links of 1 kg on no table."""
    return slippery_bodies(CONFIG)


def start(angles, rates, speed=(0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates and their rates of a chain that begins at `BEGIN`, with a speed of its hand."""
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=1) * END[0]
    across = np.stack([-axes[:, 1], axes[:, 0]], axis=1) * np.asarray(rates)[:, None]
    steps = np.array([BEGIN, axes[0], axes[0] + axes[1]])
    moved = np.array([[0.0, 0.0], across[0], across[0] + across[1]])
    return generalized_coordinates(
        TURN_LENGTH,
        np.cumsum(steps, axis=0),
        np.cumsum(moved, axis=0) + speed,
        np.array([0.0, *angles])[:, None],
        np.array([0.0, *rates])[:, None],
    )


def followed(scene: Scene, at: tuple[np.ndarray, np.ndarray], controls) -> tuple[np.ndarray, ...]:
    found = follow(model(), scene_nodes(scene), *at, controls)
    return np.asarray(found.position), np.asarray(found.velocity)


def gaps(position: np.ndarray) -> np.ndarray:
    angle = position[..., 2] / TURN_LENGTH
    return pin_gaps(SCENE.pins, SCENE.pin_points, position[..., :2], angle)


def driven(seed: int = 0) -> np.ndarray:
    return FORCE * np.random.default_rng(seed).normal(size=(STEPS, 2))


@pytest.mark.usefixtures("engine")
def test_a_chain_moves_as_in_a_simulator() -> None:
    """Pulled for half a second, and turning by about 4 rad/s."""
    angles, rates, mass = (0.3, 0.3), (2.0, -4.0), 1.0  # its hinges are in the middle
    position, velocity = start(angles, rates)
    links = [
        PlanarBody(
            position[1 + link, :2],
            mass,
            half_size=HALF,
            angle=angles[link],
            rotates=True,
            velocity=velocity[1 + link, :2],
            angular_velocity=rates[link],
        )
        for link in range(2)
    ]
    world = PlanarWorld([PlanarBody(BEGIN, mass, radius=0.005), *links], DT, 500)
    world.join(0, 1)
    world.join(1, 2)
    controls, seen = driven(), []
    for force in controls[:10]:
        world.step(np.array([force, np.zeros(2), np.zeros(2)]))
        seen.append(world.position)
    found, _ = followed(SCENE, (position, velocity), controls)
    travelled = np.abs(np.array(seen) - position[:, :2]).max()
    assert np.abs(found[:10, :, :2] - seen).max() < 0.005 * travelled


def test_a_link_on_a_post_turns_for_ever() -> None:
    """By the same angle in each step, on a circle. The pin of the second link is padding."""
    nodes = scene_nodes(PENDULUM)
    pins, points = (jnp.asarray(each).at[1].set(0) for each in (nodes.pins, nodes.pin_points))
    position, velocity = start((0.0, 0.0), (3.0, 0.0))
    position[2, 0], velocity[2] = 9.0, 0.0
    single = nodes._replace(pins=pins, pin_points=points)
    found = follow(model(), single, position, velocity, np.zeros((STEPS, 2)))
    rate = found.velocity[:, 1, 2] / TURN_LENGTH
    np.testing.assert_allclose(rate, 3.0, rtol=0.02)
    position = np.asarray(found.position)
    angle = position[:, 1, 2] / TURN_LENGTH
    circle = BEGIN + 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    np.testing.assert_allclose(position[:, 1, :2], circle, atol=1e-6)


@pytest.mark.parametrize("scene", [SCENE, PENDULUM])
def test_pins_stay_together_over_many_steps(scene: Scene) -> None:
    position, _ = followed(scene, start((0.3, 1.2), (5.0, -8.0)), driven())
    assert np.isfinite(position).all()
    assert gaps(position).max() < 1e-5


def test_a_gap_is_closed_within_a_step() -> None:
    position, velocity = start((0.3, 1.2), (0.0, 0.0))
    position = position + np.random.default_rng(0).normal(0.0, 0.005, position.shape)
    found, _ = followed(SCENE, (position, velocity), np.zeros((STEPS, 2)))
    assert gaps(position).max() > 5e-3 and gaps(found)[0].max() < 1e-5


@pytest.mark.parametrize("scene", [SCENE, PENDULUM])
@pytest.mark.parametrize("seed", range(3))
def test_energy_never_grows(scene: Scene, seed: int) -> None:
    """Not even where velocities would part the pins at first."""
    rng = np.random.default_rng(seed)
    position, _ = start(rng.uniform(-np.pi, np.pi, 2), (0.0, 0.0))
    velocity = rng.normal(0.0, 1.0, position.shape)
    velocity[0] *= scene.actuated[0] * np.array([1.0, 1.0, 0.0])
    _, after = followed(scene, (position, velocity), np.zeros((STEPS, 2)))
    energy = np.sum(np.concatenate([velocity[None], after]) ** 2, axis=(1, 2))
    assert np.diff(energy).max() < 1e-6 * energy[0]
    assert energy[-1] > 0.3 * energy[1]  # nor is it lost, but by the impact of the first step


def test_padded_pins_change_nothing() -> None:
    nodes = scene_nodes(SCENE, 4)
    more = nodes._replace(
        pins=jnp.concatenate([nodes.pins, jnp.zeros((2, 2), int)]),
        pin_points=jnp.concatenate([nodes.pin_points, jnp.zeros((2, 2, 2))]),
    )
    at = start((0.3, 1.2), (2.0, -3.0))
    padded = [np.pad(each, ((0, 1), (0, 0))) for each in at]
    found = follow(model(), more, *padded, driven()).position[:10, :3]
    np.testing.assert_allclose(found, followed(SCENE, at, driven())[0][:10], atol=1e-9)


def test_bodies_that_a_pin_joins_do_not_touch() -> None:
    """The links overlap once the chain is bent."""
    at = tuple(map(jnp.asarray, start((0.3, 2.5), (0.0, 0.0))))
    every = replace(SCENE, candidate_edges=None)
    free = replace(every, pins=None, pin_points=None)
    given = *at, jnp.zeros(model().control_size)
    nothing = nothing_active(model().inference.edge_types)
    weight, apart = (
        encode(model(), *given, scene_nodes(each), nothing).weight for each in (every, free)
    )
    assert not weight[0] and not weight[2] and apart[0] == apart[2] == 1.0


def test_the_drift_of_pins_is_the_largest_gap_of_all_predictions() -> None:
    """Of a model that knows the pins: next to none."""
    position, velocity = start((0.3, 1.2), (2.0, -4.0))
    recorded = chain(np.stack([position] * 5), np.stack([velocity] * 5))
    found = evaluate_open_loop(model(), Dataset((recorded,)), horizon_s=2 * DT)
    assert 0.0 < found["pin_drift_m"] < 1e-5
    assert (
        not found.recorded.edge_exists[:, [0, 2]].any() and found.recorded.edge_exists[:, 1].all()
    )
    free = replace(SCENE, pins=None, pin_points=None)
    none = largest_pin_gaps(free, np.zeros((3, 2, 3, 3)))
    unpinned = replace(found.predictions["n_step"], pin_gap=none)
    assert pin_drift(found.recorded, unpinned) == {"pin_drift_m": None}


def test_data_of_a_chain_tell_the_force_on_its_hand_and_no_contact_distance() -> None:
    """Though the chain is never let go."""
    position, velocity = followed(SCENE, start((0.3, 1.2), (0.0, 0.0)), driven())
    first = [np.stack(each)[None] for each in start((0.3, 1.2), (0.0, 0.0))]
    states = (np.concatenate(pair) for pair in zip(first, (position, velocity), strict=True))
    dataset = Dataset((chain(*states, driven()),))
    found = identify(dataset).in_data
    np.testing.assert_allclose(found.actuation["hand"].matrix, np.eye(2), atol=0.01)
    assert found.contact_distance == CONTACT_DISTANCE
    for each in in_units(dataset, Units(0.01, (1.0, 1.0))):
        np.testing.assert_allclose(each.scene.pin_points, 100.0 * SCENE.pin_points)


def chain(position, velocity, control=None) -> Trajectory:
    """A recorded chain, of its coordinates [T+1, N, 3]."""
    return Trajectory(
        SCENE,
        position[..., :2],
        velocity[..., :2],
        np.zeros((len(position) - 1, 2)) if control is None else control,
        orientation=position[..., 2:] / TURN_LENGTH,
        angular_velocity=velocity[..., 2:] / TURN_LENGTH,
    )

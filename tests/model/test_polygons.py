"""Bodies of polygons: nearest points against Shapely, levers against MuJoCo, whole steps."""

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import shapely
from model_scenes import follow, slippery_bodies

from contactgraph.bodies.polygons import contact_points
from contactgraph.bodies.rotations import levers, placed, turned
from contactgraph.data import InvalidInputError, Scene, generalized_coordinates
from contactgraph.data.outlines import signed_area
from contactgraph.data.padding import pad_nodes
from contactgraph.inference.contact_belief import ContactBelief
from contactgraph.model import ContactDynamics, ModelConfig, ModelState, scene_nodes
from contactgraph.model.scene import check_fit

pytestmark = pytest.mark.usefixtures("double_precision")

DT, LENGTH = 0.02, 0.05
T = (
    np.array([[-0.06, -0.03], [0.06, -0.03], [0.06, 0.0], [-0.06, 0.0]]),
    np.array([[-0.015, 0.0], [0.015, 0.0], [0.015, 0.09], [-0.015, 0.09]]),
)
BOX = (np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]]),)
TRIANGLE = (np.array([[-0.04, -0.03], [0.05, -0.02], [0.0, 0.06]]),)
DOMINO = (np.array([[-0.01, -0.05], [0.01, -0.05], [0.01, 0.05], [-0.01, 0.05]]),)
SHAPES = {"domino": DOMINO, "t": T, "box": BOX, "triangle": TRIANGLE, "disc": ()}
EDGE = jnp.array([[0], [1]])
COUNT = 2500
"""Of pairs of bodies, for all of which one program is compiled."""


def scene(kinds: tuple[str, ...], **options) -> Scene:
    shapes = [(node, each) for node, kind in enumerate(kinds) for each in SHAPES[kind]]
    return Scene(
        node_name=tuple(f"{kind}-{node}" for node, kind in enumerate(kinds)),
        node_type=kinds,
        actuated=np.zeros(len(kinds), bool),
        dt=DT,
        polygons=tuple(each for _, each in shapes),
        polygon_of=np.array([node for node, _ in shapes]),
        **options,
    )


@cache
def outlines(*kinds: str) -> np.ndarray:
    """[N, 2, 4, 2] m"""
    found = np.zeros((len(kinds), 2, 4, 2))
    padded = np.asarray(pad_nodes(scene(kinds), len(kinds)).outlines)
    found[:] = padded[:, -1:, -1:]
    found[:, : padded.shape[1], : padded.shape[2]] = padded
    found[:, padded.shape[1] :] = found[:, padded.shape[1] - 1 : padded.shape[1]]
    found[:, :, padded.shape[2] :] = found[:, :, padded.shape[2] - 1 : padded.shape[2]]
    return found


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def nearest(shapes, position, angle):
    coordinates = jnp.concatenate([position, angle[:, None]], axis=1)
    return contact_points(placed(shapes, coordinates, 1.0), EDGE, LENGTH)


def drawn(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    second = rng.uniform(-0.2, 0.2, (COUNT, 2))
    position = np.stack([rng.uniform(-0.01, 0.01, (COUNT, 2)), second], axis=1)
    return position, rng.uniform(-np.pi, np.pi, (COUNT, 2))


def as_shapely(kind: str, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[S] geometries."""
    if not SHAPES[kind]:
        return shapely.points(position)
    parts = [
        shapely.polygons(position[:, None] + np.asarray(turned(each, angle[:, None])))
        for each in SHAPES[kind]
    ]
    return shapely.union_all(np.array(parts), axis=0)


@pytest.mark.parametrize("kinds", [("t", "box"), ("t", "t"), ("triangle", "disc"), ("t", "disc")])
def test_gaps_and_points_are_those_of_a_geometry_library(kinds: tuple[str, str]) -> None:
    position, angle = drawn()
    found = nearest(outlines(*kinds), position, angle)
    one, other = (as_shapely(kind, position[:, i], angle[:, i]) for i, kind in enumerate(kinds))
    gap = np.asarray(found.gap)[:, 0, 0]
    apart = ~shapely.intersects(one, other)
    assert 0.5 < apart.mean() < 0.99
    # A point within a ten thousandth of the line of a side counts as above that.
    np.testing.assert_allclose(
        gap[apart], shapely.distance(one, other)[apart], rtol=2e-4, atol=1e-6
    )
    shallow = ~apart & (shapely.area(shapely.intersection(one, other)) < 1e-6)
    assert (
        np.all(np.abs(gap[shallow]) < 2e-3) or not SHAPES[kinds[1]]
    )  # a disc's centre has no area
    on_first = shapely.points(np.asarray(found.on_first)[apart, 0, 0])
    on_second = shapely.points(np.asarray(found.on_second)[apart, 0, 0])
    assert np.all(shapely.distance(on_first, one[apart]) < 1e-6 + 0.015 * gap[apart])
    assert np.all(shapely.distance(on_second, other[apart]) < 1e-6 + 0.015 * gap[apart])


def test_a_box_on_a_box_has_two_points_of_contact() -> None:
    position = np.tile([[0.0, 0.0], [0.01, 0.0601]], (COUNT, 1, 1))
    found = nearest(outlines("box", "box"), position, np.zeros((COUNT, 2)))
    np.testing.assert_allclose(found.gap[0, 0], 1e-4, atol=1e-9)
    np.testing.assert_allclose(found.normal[0, 0], [[0.0, 1.0]] * 2, atol=1e-9)
    np.testing.assert_allclose(sorted(found.on_first[0, 0, :, 0]), [-0.04, 0.05], atol=1e-9)


def test_the_gap_changes_as_its_gradient_says() -> None:
    position, angle = drawn(seed=1)
    shapes = outlines("t", "box")

    def total(position, angle):
        return jnp.sum(nearest(shapes, position, angle).gap[:, 0, 0])

    by_place, by_angle = jax.jit(jax.grad(total, argnums=(0, 1)))(position, angle)
    small, rng = 1e-7, np.random.default_rng(2)
    along, turn = rng.normal(size=position.shape), rng.normal(size=angle.shape)
    ends = [
        np.asarray(nearest(shapes, position + s * along, angle + s * turn).gap)[:, 0, 0]
        for s in (-small, small)
    ]
    expected = (ends[1] - ends[0]) / (2.0 * small)
    found = np.sum(by_place * along, axis=(1, 2)) + np.sum(by_angle * turn, axis=1)
    # Where the nearest feature is another on either side, there is no derivative.
    smooth = np.abs(found - expected) < 1e-3 * (1.0 + np.abs(expected))
    assert smooth.mean() > 0.99


def test_padding_of_outlines_changes_nothing() -> None:
    position, angle = drawn(seed=3)
    two = outlines("box", "triangle")
    one = np.asarray(pad_nodes(scene(("box", "triangle")), 2).outlines)
    assert one.shape != two.shape
    found, padded = (nearest(each, position, angle) for each in (one, two))
    np.testing.assert_allclose(found.gap[:, :, 0], padded.gap[:, :, 0], atol=1e-12)


def test_levers_are_mujocos_jacobian() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint type="slide" axis="1 0 0"/>'
        '<joint type="slide" axis="0 1 0"/><joint type="hinge" axis="0 0 1"/>'
        '<geom type="box" size="0.05 0.03 0.02" mass="1"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qpos[:] = [0.1, -0.2, 0.7]
    mujoco.mj_forward(model, data)
    point, unit = np.array([0.14, -0.21]), 0.04
    expected = np.zeros((3, 3))
    mujoco.mj_jac(model, data, expected, None, np.append(point, 0.0), 1)
    position = jnp.array([[0.1, -0.2, 0.7 * unit]])
    found = levers(point[None], position, jnp.ones(1), jnp.array([0]), unit)
    np.testing.assert_allclose(found[0] * np.array([1.0, 1.0, unit]), expected[:2], atol=1e-12)


def test_boxes_that_rest_on_each_other_meet_along_the_normal_of_their_faces() -> None:
    """In single precision, up to which their gap is known."""
    rng = np.random.default_rng(0)
    below, above = rng.uniform(-0.5, 0.5, (200, 2)), np.stack([0.02 + 0 * rng.random(200)] * 2, 1)
    above[:, 1] = 0.06 + rng.uniform(-3e-8, 3e-8, 200)
    position = np.stack([below, below + above], axis=1).astype(np.float32)
    found = nearest(outlines("box", "box").astype(np.float32), position, np.zeros((200, 2), "f"))
    assert found.gap.dtype == np.float32 and np.abs(found.gap).max() < 1e-6
    assert found.on_face.all()
    np.testing.assert_allclose(found.normal, np.broadcast_to([0.0, 1.0], (200, 1, 2, 2)), atol=1e-6)


GRAVITY = np.array([0.0, -9.81])
FLOOR = np.array([[0.0, 1.0, 0.0]])
TURN_LENGTH = float(np.sqrt((0.1**2 + 0.06**2) / 12.0))
CONFIG = ModelConfig(
    2,
    0,
    DT,
    LENGTH,
    width=4,
    node_types=("box",),
    plane_distance={"box": 0.0},
    turn_length=TURN_LENGTH,
    inertia={"box": 1.0},
    learned_contact_distance=False,
)


@cache
def model(identified: bool = False) -> ContactDynamics:
    """Boxes without friction against the air."""
    return slippery_bodies(replace(CONFIG, identified=identified))


def followed(model: ContactDynamics, nodes, start) -> ModelState:
    """60 steps, the same program for all that is looked at."""
    return follow(model, nodes, *start, np.zeros((60, 0)))


@eqx.filter_jit
def touching(model: ContactDynamics, nodes, start, types, steps: int) -> tuple:
    """Position and velocity after steps in which contacts are of these types."""

    def step(at: tuple, _: None) -> tuple:
        graph = model.encode(*at, jnp.zeros(0), nodes, ContactBelief(types))
        linear = model.linearize(model.cut_edges(graph, ContactBelief(types)))
        return linear(*at, jnp.zeros(0)), None

    return jax.lax.scan(step, tuple(map(jnp.asarray, start)), length=steps)[0]


def fallen(angle: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates and their rates of a box that stands on a corner of a floor at ``angle``."""
    nodes = scene_nodes(scene(("box", "box"), gravity=GRAVITY, planes=FLOOR))
    heights = [-np.asarray(turned(BOX[0], each))[:, 1].min() for each in (angle, 0.0)]
    position = np.array([[0.0, heights[0]], [1.0, heights[1]]])
    still = np.array([[speed, 0.0], [0.0, 0.0]])
    turn, rate = np.array([[angle], [0.0]]), np.zeros((2, 1))
    start = generalized_coordinates(TURN_LENGTH, position, still, turn, rate)
    found = followed(model(), nodes, start)
    return np.asarray(found.position), np.asarray(found.velocity)


def test_a_box_topples_onto_its_side_and_rests() -> None:
    position, velocity = fallen(0.7, 0.0)
    np.testing.assert_allclose(position[-1, :, 1], 0.03, atol=2e-3)
    np.testing.assert_allclose(np.sin(position[-1, :, 2] / TURN_LENGTH), 0.0, atol=0.05)
    np.testing.assert_allclose(velocity[-1], 0.0, atol=0.05)
    assert np.abs(position[:, 1] - position[0, 1]).max() < 1e-4  # it was at rest from the start


@pytest.mark.parametrize(("angle", "speed"), [(0.7, 0.0), (1.2, 0.5), (0.4, -0.8)])
def test_a_falling_box_gains_no_energy(angle: float, speed: float) -> None:
    position, velocity = fallen(angle, speed)
    energy = 0.5 * np.sum(velocity[:, 0] ** 2, axis=-1) + 9.81 * position[:, 0, 1]
    begin = 0.5 * speed**2 - 9.81 * np.asarray(turned(BOX[0], angle))[:, 1].min()
    assert energy.max() <= begin + 1e-3
    assert np.diff(energy).max() < 2e-2 * begin
    assert energy[-1] < begin


def test_a_stack_that_touches_stays_where_it_is() -> None:
    """Three boxes of which geometry alone cannot tell that weight presses them together."""
    nodes = scene_nodes(scene(("box",) * 3, gravity=GRAVITY, planes=FLOOR))
    types = jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    start = np.array([[0.0, 0.03, 0.0], [0.02, 0.09, 0.0], [-0.01, 0.15, 0.0]])
    # Contacts are soft, untrained as they are.
    position, velocity = touching(model(), nodes, (start, np.zeros_like(start)), types, 10)
    np.testing.assert_allclose(position, start, atol=6e-4)
    np.testing.assert_allclose(velocity, 0.0, atol=4e-3)


@pytest.mark.parametrize("apart", [0.0, 0.3])
def test_a_standing_box_that_is_struck_above_its_middle_tips_over(apart: float) -> None:
    """One corner lifts off, which a touch that pulls would hold down; a third stands behind."""
    row = replace(scene(("domino",) * 3, gravity=GRAVITY, planes=FLOOR), node_type=("box",) * 3)
    nodes = scene_nodes(row)
    position = np.array([[-0.06, 0.1], [0.0, 0.05], [0.1 + apart, 0.05]])
    velocity = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    still = np.zeros((3, 1))
    start = generalized_coordinates(TURN_LENGTH, position, velocity, still, still)
    touch = jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0]), (3, 3))
    found, _ = touching(replace(model(True), substeps=4), nodes, start, touch, 5)
    turn = np.asarray(found)[:, 2] / TURN_LENGTH
    corner = np.asarray(found)[1, :2] + np.asarray(turned(jnp.array([0.01, -0.05]), turn[1]))
    assert turn[1] < -0.15 and abs(corner[1]) < 2e-3 and abs(turn[2]) < 1e-3


def test_a_step_in_parts_is_as_many_small_steps() -> None:
    """A box that spins lands on a floor."""
    nodes = scene_nodes(scene(("box",), gravity=GRAVITY, planes=FLOOR))
    position, velocity = np.array([[[0.0, 0.07]], [[0.5, -1.0]]])
    turn, rate = np.array([[0.3]]), np.array([[12.0]])
    start = generalized_coordinates(TURN_LENGTH, position, velocity, turn, rate)

    def moved(steps: int, **options) -> np.ndarray:
        found = followed(replace(model(), **options), nodes, start)
        states = np.concatenate([found.position, found.velocity], axis=-1)
        return states[steps - 1 : 12 * steps : steps]

    parts = moved(1, substeps=4)
    np.testing.assert_allclose(parts, moved(4, dt=DT / 4), atol=1e-9)
    assert np.abs(parts - moved(1))[:, 0, 1].max() > 1e-3
    assert np.abs(np.diff(parts[:, 0, 4])).max() > 0.5  # it landed


def test_a_turned_scene_moves_as_the_scene_does() -> None:
    angle, shift = 0.8, np.array([0.3, -0.1])
    sine, cosine = np.sin(angle), np.cos(angle)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    position = np.array([[0.0, 0.0], [0.105, 0.02]])
    velocity = np.array([[0.8, 0.0], [0.0, 0.0]])
    angles, rates = np.array([[0.1], [0.4]]), np.array([[0.0], [2.0]])
    nodes = scene_nodes(scene(("box", "box")))

    def moved(position, velocity, angles) -> np.ndarray:
        start = generalized_coordinates(TURN_LENGTH, position, velocity, angles, rates)
        return np.asarray(followed(model(), nodes, start).position[:20])

    plain = moved(position, velocity, angles)
    other = moved(position @ turn.T + shift, velocity @ turn.T, angles + angle)
    np.testing.assert_allclose(other[..., :2], plain[..., :2] @ turn.T + shift, atol=1e-6)
    np.testing.assert_allclose(other[..., 2], plain[..., 2] + TURN_LENGTH * angle, atol=1e-6)
    assert np.abs(plain[-1, 1, :2] - position[1]).max() > 0.02  # it was struck


def test_outlines_run_counter_clockwise_whatever_was_recorded() -> None:
    (reversed_,) = Scene(
        ("box",), ("box",), np.zeros(1, bool), DT, polygons=(BOX[0][::-1],), polygon_of=[0]
    ).outlines_of(0)
    assert signed_area(reversed_) > 0.0


def test_a_model_that_turns_needs_outlines() -> None:
    plain = Scene(("box-0",), ("box",), np.zeros(1, bool), DT)
    with pytest.raises(InvalidInputError, match="no polygons, their outlines"):
        check_fit(model(), plain, 0, "the data")

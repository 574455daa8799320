"""Bodies that turn in space: features against MuJoCo, levers, turns that do not add up, steps."""

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_scenes import follow, slippery_bodies
from scipy.spatial.transform import Rotation

from contactgraph.bodies.geometry import Meeting
from contactgraph.bodies.graph import EncodedGraph
from contactgraph.bodies.planes import plane_points
from contactgraph.bodies.polygons import contact_points
from contactgraph.bodies.rotations import composed, levers, placed, rotation_matrix
from contactgraph.data import Scene, generalized_coordinates
from contactgraph.data.outlines import hull_rows, outline_moments
from contactgraph.data.padding import pad_nodes
from contactgraph.data.turns import quaternions, turn_between
from contactgraph.dynamics.body_types import DECELERATION, PACE
from contactgraph.inference.contact_belief import nothing_active
from contactgraph.model import (
    HOLD,
    TOUCH,
    ContactDynamics,
    ModelConfig,
    ModelState,
    scene_nodes,
)

pytestmark = pytest.mark.usefixtures("double_precision")

DT, LENGTH = 0.02, 0.05
HALF = np.array([0.05, 0.03, 0.02])
SIGNS = 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
BOX = HALF * SIGNS
EDGE = jnp.array([[0], [1]])
COUNT = 3000
"""Of pairs of bodies, for all of which one program is compiled."""
encode = eqx.filter_jit(ContactDynamics.encode)


def scene(shapes: list[np.ndarray | None], **options) -> Scene:
    known = [node for node, each in enumerate(shapes) if each is not None]
    return Scene(
        node_name=tuple(f"body-{node}" for node in range(len(shapes))),
        node_type=tuple("ball" if each is None else "box" for each in shapes),
        actuated=np.zeros(len(shapes), bool),
        dt=DT,
        dimension=3,
        polygons=tuple(shapes[node] for node in known),
        polygon_of=np.array(known),
        **options,
    )


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def nearest(shapes, position):
    return contact_points(placed(shapes, position, 1.0), EDGE, LENGTH)


@jax.jit
def on_plane(shapes, position, plane):
    return plane_points(placed(shapes, position, 1.0), plane, LENGTH)


def drawn(count: int, reach: float, seed: int = 0) -> np.ndarray:
    """[count, 2, 6] m and rad"""
    rng = np.random.default_rng(seed)
    position = np.zeros((count, 2, 6))
    position[:, 1, :3] = rng.uniform(-reach, reach, (count, 3))
    position[:, :, 3:] = Rotation.random(2 * count, rng).as_rotvec().reshape(count, 2, 3)
    return position


def mujoco_distances(kind: str, size: str, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances, and points of both, of a box from another body."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body mocap="true"><geom type="box" size="0.05 0.03 0.02"/></body>'
        f'<body mocap="true"><geom type="{kind}" size="{size}"/></body></worldbody></mujoco>'
    )
    data, found, ends = mujoco.MjData(model), [], []
    for state in position:
        data.mocap_pos[:] = state[:, :3]
        data.mocap_quat[:] = quaternions(state[:, 3:])
        mujoco.mj_kinematics(model, data)
        between = np.zeros(6)
        found.append(mujoco.mj_geomDistance(model, data, 0, 1, 1.0, between))
        ends.append(between.reshape(2, 3))
    return np.array(found), np.array(ends)


def test_a_box_and_a_ball_are_as_far_apart_as_mujoco_says() -> None:
    position = drawn(COUNT, 0.1)
    outlines = pad_nodes(scene([BOX, None]), 2).outlines
    points = nearest(outlines, position)
    gap = np.asarray(points.gap)[:, 0, 0] - 0.01
    expected, ends = mujoco_distances("sphere", "0.01", position)
    apart = expected > 0.0
    assert 0.5 < apart.mean() < 0.95
    np.testing.assert_allclose(gap[apart], expected[apart], rtol=2e-4, atol=1e-5)
    np.testing.assert_allclose(np.asarray(points.on_first)[apart, 0, 0], ends[apart, 0], atol=2e-3)
    # A centre inside lies as deep as the nearest face.
    inside = Rotation.from_rotvec(position[:, 0, 3:]).inv().apply(position[:, 1, :3])
    depth = np.max(np.abs(inside) - HALF, axis=1)
    deep = depth < 0.0
    assert deep.sum() > 20
    np.testing.assert_allclose(gap[deep], depth[deep] - 0.01, atol=1e-6)
    assert np.all(np.asarray(points.gap)[:, 0, 1:] > 1.0), "one point, of a ball"


def test_two_boxes_are_as_far_apart_as_mujoco_says() -> None:
    position = drawn(COUNT, 0.12, seed=1)
    outlines = pad_nodes(scene([BOX, BOX]), 2).outlines
    gap = np.asarray(nearest(outlines, position).gap)[:, 0, 0]
    expected, _ = mujoco_distances("box", "0.05 0.03 0.02", position)
    apart = expected > 1e-4
    assert 0.5 < apart.mean() < 0.95
    np.testing.assert_allclose(gap[apart], expected[apart], rtol=1e-3, atol=2e-4)
    touching = (expected < 0.0) & (expected > -1e-3)
    assert touching.sum() >= 5
    np.testing.assert_allclose(gap[touching], expected[touching], atol=2e-4)


def test_a_box_on_a_box_touches_it_at_the_corners_of_their_common_face() -> None:
    """Corners of one box, and places where edges of both cross."""
    position = np.zeros((COUNT, 2, 6))
    position[:, 1] = [0.04, 0.035, 0.0401, 0.0, 0.0, 0.0]
    outlines = pad_nodes(scene([BOX, BOX]), 2).outlines
    found = nearest(outlines, position)
    np.testing.assert_allclose(found.gap[0, 0], 1e-4, atol=1e-9)
    np.testing.assert_allclose(found.normal[0, 0], [[0.0, 0.0, 1.0]] * 4, atol=1e-9)
    corners = sorted(np.asarray(found.on_first[0, 0, :, :2]).round(9).tolist())
    np.testing.assert_allclose(
        corners, [[-0.01, 0.005], [-0.01, 0.03], [0.05, 0.005], [0.05, 0.03]]
    )
    heights, lowest = on_plane(outlines, position[0], np.array([[0.0, 0.0, 1.0, -0.02]]))
    np.testing.assert_allclose(heights[0, 0], 0.0, atol=1e-12)
    assert len(np.unique(np.asarray(lowest[0, 0]).round(9), axis=0)) == 4


def test_the_rows_of_a_hull_hold_its_surface() -> None:
    rng = np.random.default_rng(3)
    for points, edges in ((BOX, 12), (rng.normal(size=(9, 3)), None)):
        rows = hull_rows(points)
        begins = {tuple(each) for each in rows[:, 3]}
        assert begins == {tuple(each) for each in rows.reshape(-1, 3)}
        found = {frozenset(map(tuple, each)) for each in rows[:, 3:]}
        assert edges is None or len(found) == edges
        corners = rows[:, :3] - points.mean(axis=0)
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(np.sum(outward * corners[:, 0], axis=1) > 0.0)
    volume, square = outline_moments(BOX)
    np.testing.assert_allclose(volume, 8.0 * np.prod(HALF))
    np.testing.assert_allclose(square, ((HALF**2).sum() - HALF**2) / 3.0)


def test_turns_in_space_are_composed() -> None:
    rng = np.random.default_rng(4)
    turn, by = rng.normal(size=(500, 3)), 0.1 * rng.normal(size=(500, 3))
    found = np.array(composed(jnp.asarray(turn), jnp.asarray(by)))
    expected = Rotation.from_rotvec(turn) * Rotation.from_rotvec(by)
    assert np.max((Rotation.from_rotvec(found).inv() * expected).magnitude()) < 1e-7
    matrix = rotation_matrix(jnp.asarray(found))
    np.testing.assert_allclose(matrix, expected.as_matrix(), atol=1e-7)
    assert np.max(np.linalg.norm(found - turn - by, axis=1)) < 1.0, "it continues without a jump"
    spin = jnp.array([[0.0, 0.0, 2.0 * np.pi - 1e-3], [0.0, 0.0, 0.0]])
    by = jnp.array([[0.0, 0.0, 2e-3], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(composed(spin, by), spin + by, atol=1e-9)


def test_recorded_turns_continue_and_become_rotation_vectors() -> None:
    angle = np.linspace(0.0, 9.0 * np.pi, 200)
    axis = np.array([0.6, 0.0, 0.8])
    quaternion = np.roll(Rotation.from_rotvec(angle[:, None] * axis).as_quat(), 1, axis=1)
    quaternion[::3] *= -1.0
    rate = np.broadcast_to([0.0, 1.0, 0.0], (200, 1, 3))
    still = np.zeros((200, 1, 3))
    found, velocity = generalized_coordinates(0.02, still, still, quaternion[:, None], rate)
    np.testing.assert_allclose(found[:, 0, 3:], 0.02 * angle[:, None] * axis, atol=1e-9)
    own = Rotation.from_rotvec(angle[:, None] * axis).inv().apply(rate[:, 0].copy())
    np.testing.assert_allclose(velocity[:, 0, 3:], 0.02 * own, atol=1e-12)


def test_levers_tell_how_the_points_of_a_body_move() -> None:
    position, unit = jnp.asarray(drawn(1, 0.1, seed=5)[0]), 0.03
    position = position.at[:, 3:].multiply(unit)
    corners, rng = jnp.asarray(BOX)[None].repeat(2, 0), np.random.default_rng(6)
    velocity, small = jnp.asarray(rng.normal(size=(2, 6))), 1e-6

    def after(share: float):
        turn = composed(position[:, 3:] / unit, share * velocity[:, 3:] / unit)
        moved = position.at[:, :3].add(share * velocity[:, :3]).at[:, 3:].set(unit * turn)
        return placed(corners, moved, unit).reshape(-1, 3)

    node = jnp.repeat(jnp.arange(2), 8)
    jacobian = levers(after(0.0), position, jnp.ones(2), node, unit)
    found = jnp.einsum("cdg,cg->cd", jacobian, velocity[node])
    np.testing.assert_allclose(found, (after(small) - after(-small)) / (2 * small), atol=1e-6)


GRAVITY = np.array([0.0, 0.0, -9.81])
FLOOR = np.array([[0.0, 0.0, 1.0, 0.0]])
SQUARE = outline_moments(BOX)[1]
TURN_LENGTH = float(np.sqrt(SQUARE.mean()))
CONFIG = ModelConfig(
    3,
    0,
    DT,
    LENGTH,
    width=4,
    node_types=("box",),
    plane_distance={"box": 0.0},
    turn_length=TURN_LENGTH,
    inertia={"box": SQUARE / TURN_LENGTH**2},
    learned_contact_distance=False,
)


@cache
def model() -> ContactDynamics:
    """Boxes without friction against the air."""
    return slippery_bodies(CONFIG)


def followed(model: ContactDynamics, nodes, start) -> ModelState:
    """120 steps, the same program for all that is looked at."""
    return follow(model, nodes, *start, np.zeros((120, 0)))


def coordinates(position, velocity, turn: Rotation, rate) -> tuple[np.ndarray, np.ndarray]:
    quaternion = np.roll(turn.as_quat(), 1, axis=-1)
    return generalized_coordinates(
        TURN_LENGTH, np.array(position), np.array(velocity), quaternion, np.array(rate)
    )


def turns(position) -> Rotation:
    return Rotation.from_rotvec(np.array(position)[..., 3:] / TURN_LENGTH)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_falling_box_gains_no_energy_and_comes_to_rest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nodes = scene_nodes(scene([BOX, BOX], gravity=GRAVITY, planes=FLOOR))
    turn = Rotation.random(2, rng)
    position = np.array([[0.0, 0.0, 0.09], [1.0, 0.0, 0.3]])
    rate = rng.normal(size=(2, 3))
    start = coordinates(position, np.zeros((2, 3)), turn, rate)
    found = followed(model(), nodes, start)
    velocity = np.concatenate([start[1][None], found.velocity])
    height = np.concatenate([start[0][None], found.position])[..., 2]
    square = np.concatenate([np.ones(3), SQUARE / TURN_LENGTH**2])
    energy = 0.5 * np.sum(square * velocity**2, axis=-1) + 9.81 * height
    assert np.all(energy.max(axis=0) <= energy[0] + 1e-3)
    assert np.diff(energy, axis=0).max() < 2e-2 * energy[0].max()
    np.testing.assert_allclose(energy[-1], 9.81 * height[-1], atol=5e-3)
    # Each lies on one of its faces.
    upright = np.abs(turns(found.position[-1]).as_matrix()[:, 2])
    np.testing.assert_allclose(upright.max(axis=1), 1.0, atol=5e-3)
    # They fall by up to 2 cm in a step, and what then overlaps is not pushed apart.
    np.testing.assert_allclose(height[-1], HALF[upright.argmax(axis=1)], atol=5e-3)


def test_a_box_alone_falls_as_beside_a_far_one() -> None:
    start = coordinates([[0.0, 0.0, 0.04]], [[0.3, 0.0, 0.0]], Rotation.identity(1), [[1, 2, 0]])
    beside = tuple(np.concatenate([each, each + 1.0 * (np.arange(6) == 0)]) for each in start)
    alone, pair = (
        followed(model(), scene_nodes(scene(boxes, gravity=GRAVITY, planes=FLOOR)), begin)
        for boxes, begin in (([BOX], start), ([BOX, BOX], beside))
    )
    np.testing.assert_allclose(alone.position[:10, 0], pair.position[:10, 0], atol=1e-9)


def test_a_step_in_parts_is_as_many_small_steps() -> None:
    """A box that spins about its own axis along a floor lands on it."""
    nodes = scene_nodes(scene([BOX], gravity=GRAVITY, planes=FLOOR))
    turn = Rotation.from_rotvec([[0.0, 0.3, 0.0]])
    start = coordinates([[0.0, 0.0, 0.07]], [[0.5, 0.0, -1.0]], turn, [[0.0, 12.0, 0.0]])

    def moved(steps: int, **options) -> np.ndarray:
        found = followed(replace(model(), **options), nodes, start)
        states = np.concatenate([found.position, found.velocity], axis=-1)
        return states[steps - 1 : 10 * steps : steps]

    parts = moved(1, substeps=2)
    np.testing.assert_allclose(parts, moved(2, dt=DT / 2), atol=1e-6)
    assert np.abs(parts - moved(1))[:, 0].max() > 1e-3
    assert np.abs(np.diff(parts[:, 0, 8])).max() > 0.5  # it landed


def test_places_that_are_known_are_not_found_again() -> None:
    nodes = scene_nodes(scene([BOX, None]))
    position, velocity = map(jnp.asarray, (drawn(1, 0.08)[0], 0.1 * drawn(1, 1.0, 1)[0]))

    def encoded(meeting: Meeting | None) -> EncodedGraph:
        return encode(
            model(), position, velocity, jnp.zeros(0), nodes, nothing_active((TOUCH, HOLD)), meeting
        )

    graph = encoded(None)
    known = encoded(graph.contact_points)
    points = graph.contact_points
    moved = encoded(replace(points, displacement=2.0 * points.displacement))
    np.testing.assert_array_equal(known.geometry.distance, graph.geometry.distance)
    assert moved.geometry.distance[0] > 1.5 * graph.geometry.distance[0]


def test_a_turned_scene_moves_as_the_scene_does() -> None:
    whole, shift = Rotation.from_rotvec([0.3, -0.8, 0.5]), np.array([0.3, -0.1, 0.2])
    position = np.array([[0.0, 0.0, 0.0], [0.105, 0.01, 0.012]])
    velocity = np.array([[1.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    turn = Rotation.from_rotvec([[0.1, 0.0, 0.0], [0.0, 0.3, 0.2]])
    rate = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 2.0]])
    nodes = scene_nodes(scene([BOX, BOX]))

    def moved(*state) -> np.ndarray:
        return np.array(followed(model(), nodes, coordinates(*state)).position[:20])

    plain = moved(position, velocity, turn, rate)
    other = moved(
        whole.apply(position) + shift, whole.apply(velocity), whole * turn, whole.apply(rate)
    )
    expected = whole.apply(plain[..., :3].reshape(-1, 3)).reshape(-1, 2, 3) + shift
    np.testing.assert_allclose(other[..., :3], expected, atol=1e-6)
    off = turn_between(turns(other).as_rotvec(), (whole * turns(plain)).as_rotvec())
    assert off.max() < 1e-5
    assert np.abs(plain[-1, 1, :3] - position[1]).max() > 0.02, "it was struck"
    assert turn_between(turns(plain[-1]).as_rotvec(), turn.as_rotvec()).min() > 0.1


def test_orientations_are_unit_quaternions_after_many_steps() -> None:
    """And a body that nothing touches turns evenly about an axis of its own."""
    position = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    turn = Rotation.from_rotvec([[1.0, 0.5, -0.3], [0.0, 0.0, 0.0]])
    own = np.array([[0.0, 0.0, 3.0], [1.0, -2.0, 0.5]])
    start = coordinates(position, np.zeros((2, 3)), turn, turn.apply(own))
    nodes, parts = scene_nodes(scene([BOX, BOX])), []
    for _ in range(10):
        parts.append(followed(model(), nodes, start))
        start = parts[-1].position[-1], parts[-1].velocity[-1]
    found = jax.tree.map(lambda *each: np.concatenate(each), *parts)
    length = np.linalg.norm(quaternions(np.asarray(found.position)[..., 3:] / TURN_LENGTH), axis=-1)
    np.testing.assert_allclose(length, 1.0, atol=1e-12)
    damped = np.asarray(found.velocity)[..., 3:] / TURN_LENGTH
    np.testing.assert_allclose(damped[0], own, rtol=1e-3, atol=1e-12)
    angle = DT * np.concatenate([own[None], damped]).cumsum(axis=0)
    share = model().local_dynamics.discretization.theta
    assert 0.5 < share < 1.0
    # Each stays on its axis: the turn is that of the sum of all angles.
    for body in range(2):
        axis = own[body] / np.linalg.norm(own[body])
        total = (1.0 - share) * angle[-2, body] @ axis + share * (
            angle[-1, body] - angle[0, body]
        ) @ axis
        expected = turn[body] * Rotation.from_rotvec(float(total) * axis)
        assert (turns(found.position[-1, body]).inv() * expected).magnitude() < 1e-3


@pytest.mark.parametrize(("speed", "rate"), [(0.0, 15.0), (1.0, 10.0), (1.0, 2.0)])
def test_a_box_that_slides_and_spins_stops_as_in_mujoco(speed: float, rate: float) -> None:
    """The friction of the ground acts at its corners; MuJoCo's box rocks a little as it slides."""
    size = " ".join(map(str, HALF))
    world = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.0005" cone="elliptic" impratio="10"/><worldbody>
        <geom type="plane" size="5 5 1" friction="0.3 0 0"/>
        <body pos="0 0 {HALF[2]}"><freejoint/>
        <geom type="box" size="{size}" friction="0.3 0 0"/></body></worldbody></mujoco>"""
    )
    truth = mujoco.MjData(world)
    mujoco.mj_step(world, truth, 200)
    truth.qvel[:] = [speed, 0.0, 0.0, 0.0, 0.0, rate]
    turn, begin = 0.0, truth.qpos[0]
    for _ in range(400):
        mujoco.mj_step(world, truth)
        turn += world.opt.timestep * truth.qvel[5]
    moved = truth.qpos[0] - begin
    raw = jnp.full(1, (np.log(np.expm1(0.3 * 9.81 / DECELERATION)) + 6.0) / PACE)
    rough = eqx.tree_at(
        lambda each: (
            each.local_dynamics.head.deceleration_raw,
            each.local_dynamics.head.friction_raw,
        ),
        model(),
        [raw, jnp.full(2, -5.0)],
    )
    nodes = scene_nodes(scene([BOX, BOX], gravity=GRAVITY, planes=FLOOR))
    at = np.array([[0.0, 0.0, HALF[2]], [0.0, 9.0, HALF[2]]])
    moving = np.tile([speed, 0.0, 0.0], (2, 1)), Rotation.identity(2)
    start = coordinates(at, *moving, np.tile([0.0, 0.0, rate], (2, 1)))
    found = followed(rough, nodes, start).position[9, 0]
    np.testing.assert_allclose(found[5] / TURN_LENGTH, turn, rtol=0.07)
    np.testing.assert_allclose(found[0], moved, rtol=0.05, atol=1e-6)

"""Search over approaches: behind a body and push, never worse than going on, or stay."""

import dataclasses
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import StickyBodies, nodes_of, state_of

from contactgraph.control import (
    ILQR,
    AffinePolicy,
    Approaches,
    ControlLimits,
    Leap,
    MultiStartILQR,
    PlanningProblem,
    avoid,
    chain_cost,
)
from contactgraph.control.lanes import in_lanes
from contactgraph.control.proposals.approach import Approach
from contactgraph.control.proposals.approaches import _Scene
from contactgraph.data import InvalidInputError, Scene
from contactgraph.model import ActuationFit, ModelConfig, ModelState, ours, scene_nodes

DT, H, REACH = 0.05, 25, 0.1
SERVO = ActuationFit(60.0 * np.eye(2), np.zeros(2), 0.0, 60.0, residual=0.0)
CONFIG = ModelConfig(
    *(2, 2, DT, REACH),
    width=4,
    node_types=("box", "hand"),
    actuation={"hand": SERVO},
    rough=True,
)
LIMITS = ControlLimits(jnp.full(2, -1.0), jnp.full(2, 1.0))
SCENE = Scene(("hand", "box"), ("hand", "box"), np.array([True, False]), DT)
NODES = scene_nodes(SCENE)
GOAL = np.array([0.0, 0.0])
PLANNER = MultiStartILQR(H, 4, LIMITS, proposals=(Approaches(32),))
WEIGHTS = [0.03, 0.03, 0.002, 0.002], [50.0, 50.0, 1.0, 1.0], 1e-3
COST = chain_cost((0, 1), *WEIGHTS, GOAL, 2)
IDLE = AffinePolicy(jnp.zeros((H, 2, 2, 2, 2)), jnp.zeros((H, 2)))


@cache
def model():
    """Fresh weights: a touch pushes; the ground stops a box that nothing pushes."""
    fresh = ours(CONFIG, key=jax.random.key(0))
    return eqx.tree_at(lambda each: each.local_dynamics.head.damper_raw, fresh, jnp.full(2, 3.0))


def state(hand, box):
    position = jnp.asarray(np.array([hand, box]), jnp.zeros(()).dtype)
    still = jnp.zeros_like(position)
    return ModelState(position, still, model().initial_belief(position, still, NODES))


@eqx.filter_jit
def planned(planner, model, state, cost, guess):
    return planner.solve(model, state, NODES, cost, guess)


def solve(planner, state, guess=IDLE):
    return planned(planner, model(), state, COST, guess)


def box_end(plan):
    return np.asarray(plan.states)[-1, 1, 0]


def test_a_leap_crosses_what_a_descent_hovers_before() -> None:
    """A touch pushes the first body away from the next, to which both are then taken."""
    begin = state_of([[0.26, 0.0], [0.0, 0.0], [2.0, 0.0]], np.zeros((3, 2)))
    weights, nodes = ([3.0, 3.0, 0.2, 0.2], [50.0, 50.0, 1.0, 1.0], 0.01), nodes_of(3, 3)
    cost = chain_cost((0, 1, 2), *weights, [2.0, 1.0], 3)
    limits = ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))
    descent = ILQR(30, 5, limits)
    leap = MultiStartILQR(30, 5, limits, proposals=(Leap(),))
    hovers, leaps = (
        jax.jit(partial(each.solve, StickyBodies(), nodes=nodes, cost=cost))(begin)
        for each in (descent, leap)
    )
    assert hovers.states[-1, 0, 0, 0] > REACH and hovers.states[-1, 1, 0, 0] == 0.0
    assert leaps.states[-1, 1, 0, 0] > 1.0 and leaps.cost < 0.97 * hovers.cost


def test_it_goes_round_a_body_that_stands_between_the_hand_and_its_goal():
    """Plain iLQR leaves the box 0.3 m from its goal."""
    found = solve(PLANNER, state([0.15, 0.01], [0.3, 0.0]))
    assert np.linalg.norm(box_end(found) - GOAL) < 0.15
    controls = np.asarray(found.controls)
    assert np.all((controls >= LIMITS.lower) & (controls <= LIMITS.upper))


def test_the_running_plan_is_always_among_the_starts():
    """It is improved, where a search alone would find its first plan once more."""
    begin = state([0.3, 0.3], [0.3, 0.0])
    plans = [solve(PLANNER, begin)]
    for _ in range(2):
        going_on = AffinePolicy(jnp.zeros_like(plans[-1].policy.K), plans[-1].controls)
        plans.append(solve(PLANNER, begin, going_on))
    first, second, third = (float(plan.cost) for plan in plans)
    assert second < 0.99 * first and third <= (1.0 + 1e-5) * second


def test_a_body_at_its_goal_is_left_alone():
    plan = solve(PLANNER, state([0.25, 0.0], GOAL))
    assert np.linalg.norm(box_end(plan) - GOAL) < 1e-3


def _scene(model, begin, nodes, cost):
    return _Scene.of(PlanningProblem(PLANNER, model, begin, nodes, cost.quadratic(2), IDLE))


@eqx.filter_jit
def aims(model, begin, nodes):
    """Goals, aims and turns of 16 starts."""
    return _scene(model, begin, nodes, COST).pairs(16)[2:]


@pytest.mark.parametrize(("bounce_raw", "images"), [(0.0, 0), (0.5, 4)])
def test_every_second_start_aims_at_an_image_in_a_wall_off_which_the_body_bounces(
    bounce_raw: float, images: int
) -> None:
    """A wall at x = -1, and a ceiling at y = 2, which is none."""
    planes, gravity = np.array([[1.0, 0.0, -1.0], [0.0, -1.0, -2.0]]), np.array([0.0, -9.81])
    nodes = scene_nodes(dataclasses.replace(SCENE, planes=planes, gravity=gravity))
    elastic = eqx.tree_at(
        lambda each: each.local_dynamics.head.bounce_raw, model(), jnp.full(3, bounce_raw)
    )
    goal, aim, turn = map(np.asarray, aims(elastic, state([0.1, 0.2], [0.3, 0.0]), nodes))
    assert not turn.any()
    image = np.all(np.isclose(aim, [-2.0 - GOAL[0], GOAL[1]]), axis=1)
    assert image.sum() == images and not image[::2].any()
    np.testing.assert_allclose(aim[~image], goal[~image])


def test_equal_states_give_equal_plans():
    begin = state([0.1, 0.2], [0.3, 0.0])
    np.testing.assert_array_equal(solve(PLANNER, begin).controls, solve(PLANNER, begin).controls)


@eqx.filter_jit
def followed(model, begin, nodes, approach):
    """The controls of an approach, their cost, and the states that they lead to."""
    controls, cost = _scene(model, begin, nodes, COST).follow(approach, ILQR(H))
    return controls, cost, model.rollout(begin, controls, nodes)


@pytest.mark.parametrize("wall", [5.0, 0.58], ids=["free", "near a wall"])
def test_a_hand_moves_as_an_approach_wants(wall):
    """Also beside a wall, which it touches at half of the contact distance."""
    begin = state([0.0, 0.5], [0.3, 0.0])
    nodes = scene_nodes(dataclasses.replace(SCENE, planes=np.array([[0.0, -1.0, -wall]])))
    approach = made(direction=[1.0, 0.0], travel=0.2)
    wanted, _ = approach.wanted(
        begin.position, begin.velocity, False, begin.position, jnp.asarray(REACH), DT
    )
    controls, cost, after = followed(model(), begin, nodes, approach)
    np.testing.assert_allclose(after.velocity[0, 0], wanted, atol=0.02)
    x = jnp.stack([after.position, after.velocity], axis=2)
    x = jnp.concatenate([jnp.stack([begin.position, begin.velocity], axis=1)[None], x])
    np.testing.assert_allclose(cost, COST(x, controls), rtol=1e-4)


def test_approaches_in_lanes_end_as_they_do_one_by_one():
    """In double precision: contacts enlarge rounding a thousandfold within these steps."""
    single = model()  # made here, since it is kept for other tests
    with jax.enable_x64(True):
        scene, ends, cost = jax.tree.map(
            lambda leaf: leaf.astype(float) if eqx.is_inexact_array(leaf) else leaf,
            (single, [made([np.cos(turn), np.sin(turn)]) for turn in (0.0, 1.0, 3.0)], COST),
        )
        scene = _scene(scene, state([0.1, 0.2], [0.3, 0.0]), NODES, cost)
        follow = partial(scene.follow, planner=ILQR(H, limits=LIMITS))
        stack = partial(jax.tree.map, lambda *each: jnp.stack(each, axis=-1))
        together = eqx.filter_jit(in_lanes(follow, len(ends)))(stack(*ends))
        alone = stack(*map(eqx.filter_jit(follow), ends))
        for one, other in zip(together, alone, strict=True):
            assert one.dtype == np.float64
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-8)


def made(direction, travel=1.0, dimension=2, grasps=False, commands=0, swerve=None, by_touch=False):
    return Approach(
        hand=jnp.asarray(0),
        body=jnp.asarray(1),
        direction=jnp.asarray(direction),
        aside=jnp.zeros(dimension),
        speed=jnp.asarray(0.4),
        travel=jnp.asarray(travel),
        run_up=jnp.asarray(1.5),
        swerve=jnp.asarray(swerve or [0.0] * dimension),
        approach_speed=jnp.asarray(1.0),
        goal=jnp.full(dimension, 0.5),
        grasps=jnp.asarray(grasps or by_touch),
        by_touch=jnp.asarray(by_touch),
        command=jnp.array([[1.0], [-1.0]])[:, :commands],
    )


def test_an_approach_that_swerves_comes_from_another_side():
    start, wait = np.array([-1.0, 0.4]), np.array([-1.5 * REACH, 0.0])
    for swerve, least, most in ((0.0, 0.0, 0.01), (0.8, 0.1, 0.4)):
        path = walk(made([1.0, 0.0], swerve=[0.0, swerve]), start, np.zeros(2), 40)
        arrives = int(np.argmin(np.linalg.norm(path - wait, axis=1)))
        assert np.linalg.norm(path[arrives] - wait) < 0.05
        line = np.interp(path[:arrives, 0], [start[0], wait[0]], [start[1], wait[1]])
        beside = np.abs(path[:arrives, 1] - line).max()
        assert least <= beside <= most


def walk(approach, hand, body, steps):
    """[steps+1, D] m: a hand that moves as wanted beside a body that does not move."""
    begin, path = np.stack([hand, body]), [np.asarray(hand)]
    for _ in range(steps):
        now = jnp.asarray(np.stack([path[-1], body]))
        path.append(
            path[-1] + DT * np.asarray(approach.wanted(now, 0.0 * now, False, begin, REACH, DT)[0])
        )
    return np.array(path)


@pytest.mark.parametrize("start", [[0.3, 0.0], [0.15, 0.3], [0.12, -0.2]])
def test_the_way_round_keeps_clear_of_the_body_and_ends_in_a_push(start):
    path = walk(made([1.0, 0.0]), np.array(start), np.zeros(2), 40)
    behind = int(np.argmax((path[:, 0] < 0.0) & (np.abs(path[:, 1]) < 0.5 * REACH)))
    assert behind > 0
    assert np.linalg.norm(path[:behind], axis=1).min() > 1.1 * REACH
    velocity = np.diff(path, axis=0)[behind + 5] / DT
    np.testing.assert_allclose(velocity, [0.4, 0.0], atol=0.06)


def test_in_space_the_way_round_leads_over_the_body():
    path = walk(made([1.0, 0.0, 0.0], dimension=3), np.array([0.2, 0.0, 0.0]), np.zeros(3), 40)
    assert path[:, 2].max() > REACH
    assert path[:, 2].min() > -1e-6


def test_a_push_ends_where_it_should_and_no_travel_is_to_stay():
    at_end = jnp.array([[0.1, 0.0], [0.2, 0.0]])
    begin = jnp.array([[-0.1, 0.0], [0.0, 0.0]])
    for travel, now in ((0.2, at_end), (0.0, begin)):
        approach = made([1.0, 0.0], travel)
        assert not np.any(approach.wanted(now, 0.0 * now, False, begin, REACH, DT)[0])


def test_a_grasp_closes_inside_the_body_and_takes_it_to_its_goal_once_it_holds():
    """From above, open on the way; a push keeps its command."""
    grasp = made([0.0, 0.0, -1.0], dimension=3, grasps=True, commands=1)
    body, begin = np.zeros(3), np.array([[0.3, 0.1, 0.0], [0.0, 0.0, 0.0]])
    path = walk(grasp, begin[0], body, 60)
    lateral = np.linalg.norm(path[:, :2], axis=1)
    low = np.linalg.norm(path, axis=1) < 1.1 * REACH
    assert low.any()
    assert np.all(lateral[low] < 0.35 * REACH)  # it does not come from the side
    np.testing.assert_allclose(path[-1], body, atol=0.01)

    def wanted(hand, held):
        now = jnp.asarray(np.stack([hand, body]))
        return grasp.wanted(now, 0.0 * now, held, begin, REACH, DT)

    assert wanted(path[0], False)[1] == 1.0
    assert wanted(path[-1], False)[1] == -1.0
    velocity, command = wanted(path[-1], True)
    assert command == -1.0
    np.testing.assert_allclose(velocity, np.full(3, 1.0 / np.sqrt(3.0)), rtol=1e-3)
    push = made([1.0, 0.0, 0.0], dimension=3, commands=1)
    still = jnp.zeros((2, 3))
    assert push.wanted(jnp.asarray(begin), still, False, begin, REACH, DT)[1] == -1.0


def test_a_grasp_by_touch_presses_a_moving_body_until_it_holds_it():
    """At a velocity relative to the body's own; then it takes the body to its goal."""
    grasp = made([1.0, 0.0], by_touch=True)
    begin, velocity = jnp.array([[-REACH, 0.0], [0.0, 0.0]]), jnp.array([[0.2, 0.3], [0.2, 0.3]])

    def wanted(held):
        return np.asarray(grasp.wanted(begin, velocity, held, begin, REACH, DT)[0])

    pressing = wanted(False) - np.asarray(velocity[1])
    assert 0.1 < pressing[0] <= 0.4 + 1e-6 and pressing[1] == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(wanted(True), np.full(2, 1.0 / np.sqrt(2.0)), rtol=1e-3)


def test_a_search_knows_costs_of_contacts():
    """A touch that costs more than the way to the goal is left alone."""
    cost = dataclasses.replace(COST, contacts=(avoid([(0, 1)], 1e6),))
    plan = planned(PLANNER, model(), state([-0.3, 0.0], [-0.15, 0.0]), cost, IDLE)
    assert np.asarray(plan.beliefs.contact).max() < 0.01
    with_touch = solve(PLANNER, state([-0.3, 0.0], [-0.15, 0.0]))
    assert np.asarray(with_touch.beliefs.contact).max() > 0.5


@cache
def with_a_command():
    config = dataclasses.replace(CONFIG, control_size=3, driving_size=2)
    return ours(config, key=jax.random.key(0))


@pytest.mark.parametrize("command", [-1.0, 1.0])
def test_a_plan_changes_its_commands_only_where_that_pays(command: float) -> None:
    """A body at its goal: all commands cost the same, and those of the running plan go on."""
    commanded = with_a_command()
    begin = state([0.25, 0.0], GOAL)
    begin = ModelState(
        begin.position,
        begin.velocity,
        commanded.initial_belief(begin.position, begin.velocity, NODES),
    )
    limits = ControlLimits(-jnp.ones(3), jnp.ones(3))
    cost = chain_cost((0, 1), *WEIGHTS, GOAL, 2, control_size=3, command_weight=1e-9)
    planner = MultiStartILQR(
        H, 4, limits, proposals=(Approaches(8),), held=(2,), switching_cost=0.1
    )
    # Its hand trembles, which costs a little; shifted, it ends without a command.
    running = jnp.full((H, 3), 0.01).at[:-1, 2].set(command).at[-1].set(0.0)
    guess = AffinePolicy(jnp.zeros((H, 3, 2, 2, 2)), running)
    plan = planned(planner, commanded, begin, cost, guess)
    np.testing.assert_array_equal(plan.controls[:, 2], command)


def test_what_it_cannot_search_with_is_refused():
    with pytest.raises(InvalidInputError, match="starts must be 8"):
        Approaches(4)
    with pytest.raises(InvalidInputError, match="ContactDynamics"):
        planar = state_of([[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0]] * 2)
        PLANNER.solve(StickyBodies(), planar, nodes_of(2, 2), COST)

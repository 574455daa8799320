"""Ticks among the nodes in play answer what ticks about the whole scene answer."""

import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import nodes_of

from contactgraph.control import ILQR, MPC, ActiveSetMPC, ControlLimits, PlanStatus, chain_cost
from contactgraph.data import InvalidInputError, edge_id, pair_indices
from contactgraph.model import MotionNoise, load_model, shipped_model

CAPACITY, HORIZON = 30, 12
LIMITS = ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))
GOAL = np.array([0.5, 0.6])
GRIPPER, TARGET = np.array([-0.7, -0.5]), np.array([0.1, 0.0])


@pytest.fixture(scope="module", autouse=True)
def double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture(scope="module")
def model(double_precision):
    shipped = load_model(shipped_model("pickup")).model
    return jax.tree.map(lambda v: v.astype(float) if eqx.is_inexact_array(v) else v, shipped)


@pytest.fixture(scope="module")
def local(model) -> ActiveSetMPC:
    return ActiveSetMPC(model, ILQR(HORIZON, 5, LIMITS))


@pytest.fixture(scope="module")
def whole(model) -> MPC:
    return MPC(model, ILQR(HORIZON, 5, LIMITS))


def cost(goal=GOAL):
    return chain_cost((0, 1), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, goal, CAPACITY)


def scene(count: int, others=(), seed: int = 0) -> dict[str, np.ndarray]:
    """Gripper, target, ``others``, and far from these as many as it takes to ``count``."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(5)), -1).reshape(-1, 2)
    far = 3.0 + 0.15 * grid + rng.uniform(-0.02, 0.02, grid.shape)
    position = np.array([GRIPPER, TARGET, *others, *far])[:count]
    return {"position": position, "velocity": np.zeros((count, 2))}


def crowd(count: int, seed: int) -> dict[str, np.ndarray]:
    """Bystanders anywhere around the ways, no two bodies within each other."""
    rng = np.random.default_rng(seed)
    placed = [GRIPPER, TARGET]
    half = 2.0 * np.sqrt(count / 30)
    while len(placed) < count:
        point = rng.uniform(-half, half, 2)
        if min(np.linalg.norm(point - other) for other in placed) > 0.12:
            placed.append(point)
    return {"position": np.array(placed), "velocity": np.zeros((count, 2))}


def both(local: ActiveSetMPC, whole: MPC, seen: dict, steps: int) -> list[np.ndarray]:
    """Drives both through the world as the whole plan has it; who was in play at each step."""
    count = len(seen["position"])
    nodes = nodes_of(count, CAPACITY)
    states = [mpc.reset(seen, nodes, cost()) for mpc in (local, whole)]
    in_play = []
    for _ in range(steps):
        contacts = np.linalg.norm(seen["position"][:, None] - seen["position"], axis=-1) < 0.0805
        plans = []
        for index, mpc in enumerate((local, whole)):
            plan, states[index] = mpc.step(seen, contacts, states[index])
            plans.append(plan)
        found, wanted = plans
        who = np.asarray(found.node_ids)
        inside = who[who >= 0]
        in_play.append(inside)
        np.testing.assert_allclose(found.controls, wanted.controls, atol=1e-7)
        np.testing.assert_allclose(found.cost, wanted.cost, rtol=1e-9)
        assert int(found.iterations) == int(wanted.iterations)
        predicted, ours = np.asarray(wanted.states), np.asarray(found.states)[:, : len(inside)]
        np.testing.assert_allclose(ours, predicted[:, inside], atol=1e-7)
        first, second = pair_indices(len(inside)).T
        edge = edge_id(inside[first], inside[second])
        belief = np.asarray(found.beliefs.probability)[:, : len(edge)]
        np.testing.assert_allclose(
            belief, np.asarray(wanted.beliefs.probability)[:, edge], atol=1e-6
        )
        seen = {"position": predicted[1, :count, 0], "velocity": predicted[1, :count, 1]}
    return in_play


@pytest.mark.parametrize("count", [pytest.param(11, marks=pytest.mark.slow), 30])
def test_bystanders_far_away_are_left_out_and_change_nothing(local, whole, count):
    for inside in both(local, whole, scene(count, seed=count), 4):
        assert inside.tolist() == [0, 1]


@pytest.mark.parametrize("count", [11, 30])
def test_in_a_crowd_the_answer_is_that_of_all(local, whole, count):
    most = max(len(inside) for inside in both(local, whole, crowd(count, seed=count), 12))
    assert 2 < most < count


def test_a_bystander_in_the_way_is_in_play_and_matters(local, whole):
    between = 0.5 * (GRIPPER + TARGET)
    in_play = both(local, whole, scene(11, others=[between]), 12)
    assert all(2 in inside for inside in in_play)
    nodes = nodes_of(11, CAPACITY)
    plans = []
    for others in ([between], [between + 5.0]):
        seen = scene(11, others)
        plan, _ = local.step(seen, None, local.reset(seen, nodes, cost()))
        plans.append(plan)
        assert 2 in plan.node_ids.tolist() or others[0][0] > 3.0
    assert np.max(np.abs(plans[0].controls - plans[1].controls)) > 0.1


ALONG, ACROSS = TARGET - GRIPPER, np.array([-0.053, 0.085])
BESIDE = [
    GRIPPER + part * ALONG + side * ACROSS
    for part in (0.12, 0.21, 0.3, 0.39, 0.48, 0.57, 0.66, 0.75, 0.84, 0.93)
    for side in (-1, 1)
]
"""Beside the way to the target, on both sides, 2 cm from being touched."""


@pytest.fixture
def compilations():
    """Counts what XLA compiles."""
    counted = []

    def heard(event: str, seconds: float, **_) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            counted.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(heard)
    return counted


def test_bystanders_far_away_compile_nothing(local, compilations):
    state = local.reset(scene(4), nodes_of(4, CAPACITY), cost())
    _, state = local.step(scene(4), None, state)
    before = len(compilations)
    for count in (11, 30):
        state = local.reset(scene(count), nodes_of(count, CAPACITY), cost())
        for seed in range(3):
            plan, state = local.step(scene(count, seed=seed), np.eye(count), state)
            assert plan.outcome.solved and plan.node_ids.tolist() == [0, 1]
    # Up to eighteen in play, too: `reset` has seen to that.
    joining = scene(30, others=BESIDE[:4])
    plan, state = local.step(joining, None, state)
    assert set(range(6)) <= set(state.node_ids.tolist()) and len(state.node_ids) == 6
    assert len(compilations) == before


def test_room_for_more_is_made_once_and_logged(model, caplog):
    mpc = ActiveSetMPC(model, ILQR(HORIZON, 5, LIMITS))
    crowded = scene(30, others=BESIDE)
    with caplog.at_level(logging.WARNING, logger="contactgraph"):
        state = mpc.reset(scene(30), nodes_of(30, CAPACITY), cost())
        assert not caplog.messages
        for seen in (crowded, scene(30), crowded, scene(30)):
            plan, state = mpc.step(seen, None, state)
            assert plan.outcome.solved
    (message,) = caplog.messages
    assert "up to 30 active nodes; so far there was room for 18" in message


def test_with_a_limit_there_is_never_more_in_play(model):
    mpc = ActiveSetMPC(model, ILQR(HORIZON, 5, LIMITS), max_active_nodes=2)
    nodes, near = nodes_of(11, CAPACITY), scene(11, others=[0.5 * (GRIPPER + TARGET)])
    state = mpc.reset(scene(11), nodes, cost())
    plan, state = mpc.step(scene(11), None, state)
    crowded, after = mpc.step(near, None, state)
    assert crowded.outcome == PlanStatus.CAPACITY_EXCEEDED and "limit" in crowded.outcome.message
    np.testing.assert_array_equal(crowded.controls[:-1], plan.controls[1:])
    np.testing.assert_array_equal(after.last.control, crowded.controls[0])
    assert mpc.step(scene(11), None, after)[0].outcome.solved
    with pytest.raises(InvalidInputError, match=r"max_active_nodes must be at least 3 .* found 2"):
        mpc.reset(near, nodes, cost())
    with pytest.raises(InvalidInputError, match="max_active_nodes must be at least 1, found 0"):
        ActiveSetMPC(model, ILQR(HORIZON), max_active_nodes=0)


def test_whoever_is_left_out_must_be_seen_all_the_same(local):
    state = local.reset(scene(11), nodes_of(11, CAPACITY), cost())
    plan, state = local.step(scene(11), None, state)
    lost = scene(11)
    lost["position"][7, 1] = np.nan
    kept, state = local.step(lost, None, state)
    assert kept.outcome == PlanStatus.BAD_OBSERVATION
    np.testing.assert_array_equal(kept.controls[:-1], plan.controls[1:])
    assert local.step(scene(11), None, state)[0].outcome.solved


def test_what_comes_near_on_its_own_is_in_play(local):
    nodes = nodes_of(11, CAPACITY)
    state = local.reset(scene(11, others=[[-0.7, 1.5]]), nodes, cost())
    assert 2 not in state.node_ids
    coming = scene(11, others=[[-0.7, 1.5]])
    coming["velocity"][2] = [0.0, -2.0]
    plan, state = local.step(coming, None, state)
    assert 2 in plan.node_ids
    for _ in range(2):  # it leaves with the tick after the one that shows that it may
        plan, state = local.step(scene(11), None, state)
    assert state.node_ids.tolist() == [0, 1]


def test_another_cost_is_about_others(local, whole):
    seen, nodes = scene(11, others=[[0.9, -0.8]]), nodes_of(11, CAPACITY)
    other = chain_cost((0, 2), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, GOAL, CAPACITY)
    controls = []
    for mpc in (local, whole):
        state = mpc.reset(seen, nodes, cost())
        _, state = mpc.step(seen, None, state)
        plan, _ = mpc.step(seen, None, state, cost=other)
        controls.append(plan.controls)
    assert {0, 2} <= set(plan.node_ids.tolist())
    np.testing.assert_allclose(*controls, atol=1e-7)


def test_feedback_acts_on_whoever_is_in_play(local, whole):
    seen, nodes = crowd(11, seed=3), nodes_of(11, CAPACITY)
    moved = {**seen, "position": seen["position"] + 0.01 * (np.arange(11) == 0)[:, None]}
    controls = []
    for mpc in (local, whole):
        plan, _ = mpc.step(seen, None, mpc.reset(seen, nodes, cost()))
        controls.append(mpc.control(plan, moved))
    np.testing.assert_allclose(*controls, atol=1e-7)
    assert np.max(np.abs(controls[0] - plan.controls[0])) > 1e-3


@pytest.mark.parametrize("noise", [None, pytest.param(MotionNoise(), marks=pytest.mark.slow)])
def test_between_plans_and_by_motion_the_beliefs_are_those_of_all(model, noise):
    answers = []
    options = {"replan_every": 2, "motion_noise": noise}
    for mpc in (
        ActiveSetMPC(model, ILQR(3, 1), max_active_nodes=4, **options),
        MPC(model, ILQR(3, 1), **options),
    ):
        about = chain_cost((0, 1), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, GOAL, 5)
        seen = scene(5, others=[[-0.4, -0.5]])
        state = mpc.reset(seen, nodes_of(5, 5), about)
        for speed in (0.0, 1.5, 1.5, 1.2, 0.7):
            seen["position"][0, 0] += 0.05 * speed
            seen["velocity"][0, 0] = speed
            plan, state = mpc.step(seen, None, state, np.array([4.0, 0.0]))
        answers.append(
            (plan.controls, state.last.belief.probability[:3], state.last.motion_log_odds[:3])
        )
    assert len(state.node_ids) == 5
    for ours, wanted in zip(*answers, strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-6)


@pytest.mark.slow
def test_of_a_rejected_trial_only_the_steps_count_that_could_have_saved_it(model):
    far = np.array([1.5, 1.0])
    mpc = ActiveSetMPC(model, ILQR(HORIZON, 8, LIMITS))
    seen = scene(11)
    state = mpc.reset(seen, nodes_of(11, CAPACITY), cost(far))
    given_up = []
    for _ in range(25):
        plan, state = mpc.step(seen, None, state)
        known = np.isfinite(np.asarray(plan.swept.lower)[: int(plan.iterations), :, 0, 0])
        assert known[0].all() and (np.diff(known.astype(int), axis=1) <= 0).all()
        given_up.append((~known).any())
        after = np.asarray(plan.states[1])[:2]
        seen["position"][:2], seen["velocity"][:2] = after[:, 0], after[:, 1]
    assert any(given_up) and not all(given_up)

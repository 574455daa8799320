"""MPC on the active set: plans of the whole scene, and none through a body left out."""

import logging
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from control_models import nodes_of

from contactgraph.control import (
    ILQR,
    MPC,
    ActiveSetMPC,
    AffinePolicy,
    ControlLimits,
    MultiStartILQR,
    Plan,
    PlanStatus,
    Routes,
    avoid,
    chain_cost,
    keep_clear,
)
from contactgraph.data import InvalidInputError, edge_id, pair_indices
from contactgraph.model import MotionNoise, load_model, shipped_model
from contactgraph.model.step import rollout
from contactgraph.policies import plan_feedback

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
    return ActiveSetMPC(MPC(model, ILQR(HORIZON, 5, LIMITS)))


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
    """Distractors anywhere around the paths, without overlap."""
    rng = np.random.default_rng(seed)
    placed = [GRIPPER, TARGET]
    half = 2.0 * np.sqrt(count / 30)
    while len(placed) < count:
        point = rng.uniform(-half, half, 2)
        if min(np.linalg.norm(point - other) for other in placed) > 0.12:
            placed.append(point)
    return {"position": np.array(placed), "velocity": np.zeros((count, 2))}


def both(
    local: ActiveSetMPC, whole: MPC, observed: dict, steps: int, clear: float = 0.0
) -> list[np.ndarray]:
    """Runs both along the whole scene's plan; the active nodes of each step.

    ``clear``: m, distance to be kept from distractors.
    """
    count = len(observed["position"])
    nodes = nodes_of(count, CAPACITY)
    given = cost()
    if clear:
        pairs = [(one, other) for one in (0, 1) for other in range(2, count)]
        given = replace(given, contacts=(keep_clear(pairs, clear, 1e4), avoid(pairs, 1.0)))
    states = [mpc.reset(observed, nodes, given) for mpc in (local, whole)]
    in_play = []
    for _ in range(steps):
        contacts = (
            np.linalg.norm(observed["position"][:, None] - observed["position"], axis=-1) < 0.0805
        )
        plans = []
        for index, mpc in enumerate((local, whole)):
            plan, states[index] = mpc.step(observed, contacts, states[index])
            plans.append(plan)
        found, wanted = plans
        active_ids = np.asarray(found.node_ids)
        inside = active_ids[active_ids >= 0]
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
        observed = {"position": predicted[1, :count, 0], "velocity": predicted[1, :count, 1]}
    return in_play


def test_a_dense_scene_gives_the_plan_of_the_whole_scene(local, whole):
    most = max(len(inside) for inside in both(local, whole, crowd(30, seed=30), 12))
    assert 2 < most < 30


def test_a_distractor_on_the_path_is_active_and_matters(local, whole):
    between = 0.5 * (GRIPPER + TARGET)
    in_play = both(local, whole, scene(11, others=[between]), 12)
    assert all(2 in inside for inside in in_play)
    nodes = nodes_of(11, CAPACITY)
    plans = []
    for others in ([between], [between + 5.0]):
        observed = scene(11, others)
        plan, _ = local.step(observed, None, local.reset(observed, nodes, cost()))
        plans.append(plan)
        assert 2 in plan.node_ids.tolist() or others[0][0] > 3.0
    assert np.max(np.abs(plans[0].controls - plans[1].controls)) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("routes", [0, 3])
def test_nodes_to_be_avoided_are_active_and_give_the_plan_of_the_whole_scene(model, routes):
    """The distance to keep is more than that within which bodies touch."""
    planner = ILQR(HORIZON, 5, LIMITS)
    if routes:
        planner = MultiStartILQR(HORIZON, 5, LIMITS, proposals=(Routes(routes),))
    local, whole = ActiveSetMPC(MPC(model, planner)), MPC(model, planner)
    between = 0.5 * (GRIPPER + TARGET) + np.array([-0.15, 0.26])
    in_play = both(local, whole, scene(11, others=[between]), 8, clear=0.4)
    assert any(2 in inside for inside in in_play)
    assert all(len(inside) < 11 for inside in in_play)


ALONG, ACROSS = TARGET - GRIPPER, np.array([-0.053, 0.085])
BESIDE = [
    GRIPPER + part * ALONG + side * ACROSS
    for part in (0.12, 0.21, 0.3, 0.39, 0.48, 0.57, 0.66, 0.75, 0.84, 0.93)
    for side in (-1, 1)
]
"""Beside the path to the target, on both sides, 2 cm from contact."""


@pytest.fixture
def compilations():
    """Counts what XLA compiles."""
    counted = []

    def heard(event: str, seconds: float, **_) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            counted.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(heard)
    return counted


def test_distant_distractors_compile_nothing(local, compilations):
    state = local.reset(scene(4), nodes_of(4, CAPACITY), cost())
    _, state = local.step(scene(4), None, state)
    before = len(compilations)
    for count in (11, 30):
        state = local.reset(scene(count), nodes_of(count, CAPACITY), cost())
        for seed in range(3):
            plan, state = local.step(scene(count, seed=seed), np.eye(count), state)
            assert plan.outcome.solved and plan.node_ids.tolist() == [0, 1]
    # Up to eighteen active ones, too: `reset` compiles that.
    joining = scene(30, others=BESIDE[:4])
    plan, state = local.step(joining, None, state)
    assert set(range(6)) <= set(state.node_ids.tolist()) and len(state.node_ids) == 6
    assert len(compilations) == before


def test_capacity_grows_once_and_is_logged(model, caplog):
    mpc = ActiveSetMPC(MPC(model, ILQR(HORIZON, 5, LIMITS)))
    dense = scene(30, others=BESIDE)
    with caplog.at_level(logging.WARNING, logger="contactgraph"):
        state = mpc.reset(scene(30), nodes_of(30, CAPACITY), cost())
        assert not caplog.messages
        for observed in (dense, scene(30), dense, scene(30)):
            plan, state = mpc.step(observed, None, state)
            assert plan.outcome.solved
    (message,) = caplog.messages
    assert "up to 30 active nodes; so far there was room for 18" in message


def test_a_step_never_compiles_where_reset_has(model, compilations):
    mpc = ActiveSetMPC(MPC(model, ILQR(HORIZON, 5, LIMITS)), ready=CAPACITY)
    state = mpc.reset(scene(30), nodes_of(30, CAPACITY), cost())
    _, state = mpc.step(scene(30), None, state)
    before = len(compilations)
    plan, state = mpc.step(scene(30, others=BESIDE), None, state)
    assert plan.outcome.solved and len(state.node_ids) > 18
    assert len(compilations) == before
    with pytest.raises(InvalidInputError, match="ready must be at least 1, found 0"):
        ActiveSetMPC(MPC(model, ILQR(HORIZON)), ready=0)


def test_inactive_nodes_must_be_observed_too(local):
    state = local.reset(scene(11), nodes_of(11, CAPACITY), cost())
    plan, state = local.step(scene(11), None, state)
    lost = scene(11)
    lost["position"][7, 1] = np.nan
    kept, state = local.step(lost, None, state)
    assert kept.outcome == PlanStatus.BAD_OBSERVATION
    np.testing.assert_array_equal(kept.controls[:-1], plan.controls[1:])
    assert local.step(scene(11), None, state)[0].outcome.solved


def test_an_approaching_node_becomes_active(local):
    nodes = nodes_of(11, CAPACITY)
    state = local.reset(scene(11, others=[[-0.7, 1.5]]), nodes, cost())
    assert 2 not in state.node_ids
    coming = scene(11, others=[[-0.7, 1.5]])
    coming["velocity"][2] = [0.0, -2.0]
    plan, state = local.step(coming, None, state)
    assert 2 in plan.node_ids
    sizes = []
    for _ in range(5):  # it leaves four steps after it first may
        plan, state = local.step(scene(11), None, state)
        sizes.append(len(state.node_ids))
    assert state.node_ids.tolist() == [0, 1] and min(sizes[:-1]) > 2


def test_another_cost_activates_its_nodes(local, whole):
    observed, nodes = scene(11, others=[[0.9, -0.8]]), nodes_of(11, CAPACITY)
    other = chain_cost((0, 2), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, GOAL, CAPACITY)
    controls = []
    for mpc in (local, whole):
        state = mpc.reset(observed, nodes, cost())
        _, state = mpc.step(observed, None, state)
        plan, _ = mpc.step(observed, None, state, cost=other)
        controls.append(plan.controls)
    assert {0, 2} <= set(plan.node_ids.tolist())
    np.testing.assert_allclose(*controls, atol=1e-7)


def test_feedback_acts_on_active_nodes(local, whole):
    observed, nodes = crowd(11, seed=3), nodes_of(11, CAPACITY)
    moved = observed["position"] + 0.01 * (np.arange(11) == 0)[:, None]
    controls = []
    for mpc in (local, whole):
        plan, _ = mpc.step(observed, None, mpc.reset(observed, nodes, cost()))
        feedback = plan_feedback(plan, 0.05, 11, 2)
        controls.append(feedback(0.0, moved, observed["velocity"]))
    np.testing.assert_allclose(*controls, atol=1e-7)
    assert np.max(np.abs(controls[0] - plan.controls[0])) > 1e-3


@pytest.mark.parametrize("noise", [None, pytest.param(MotionNoise(), marks=pytest.mark.slow)])
def test_between_plans_and_by_motion_the_beliefs_are_those_of_all(model, noise):
    answers = []
    options = {"replan_every": 2, "motion_noise": noise}
    for mpc in (
        ActiveSetMPC(MPC(model, ILQR(3, 1), **options)),
        MPC(model, ILQR(3, 1), **options),
    ):
        about = chain_cost((0, 1), [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, GOAL, 5)
        observed = scene(5, others=[[-0.4, -0.5]])
        state = mpc.reset(observed, nodes_of(5, 5), about)
        for speed in (0.0, 1.5, 1.5, 1.2, 0.7):
            observed["position"][0, 0] += 0.05 * speed
            observed["velocity"][0, 0] = speed
            plan, state = mpc.step(observed, None, state, np.array([4.0, 0.0]))
        answers.append((plan.controls, state.last.belief.probability[:3]))
    assert len(state.node_ids) == 5
    for ours, wanted in zip(*answers, strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-6)


class Charge(eqx.Module):
    """A planner that drives the gripper straight at the goal, whatever stands there."""

    horizon: int = eqx.field(static=True)
    limits: ControlLimits

    def solve(self, model, state, nodes, cost, guess=None):
        """See `contactgraph.control.Planner`."""
        away = cost.goal.reshape(-1, len(state.position), 2, 2)[-1, 1, 0] - state.position[0]
        control = 8.0 * away / jnp.linalg.norm(away)
        controls = jnp.broadcast_to(control, (self.horizon, 2))
        after = rollout(model, state, controls, nodes)
        states = jnp.stack([after.position, after.velocity], axis=2)
        start = jnp.stack([state.position, state.velocity], axis=1)
        return Plan(
            states=jnp.concatenate([start[None], states]),
            controls=controls,
            policy=AffinePolicy(jnp.zeros((self.horizon, 2, *start.shape)), controls),
            beliefs=after.belief,
            cost=jnp.zeros(()),
            status=jnp.asarray(PlanStatus.ITERATION_LIMIT, jnp.int32),
            iterations=jnp.ones((), jnp.int32),
            node_ids=jnp.arange(len(start), dtype=jnp.int32),
        )


def test_no_plan_of_any_planner_passes_through_a_body_that_it_does_not_know_of(model, local):
    """In random scenes; bodies touch within 8 cm."""
    charging, struck = ActiveSetMPC(MPC(model, Charge(HORIZON, LIMITS))), 0
    for seed in range(20):
        rng, observed = np.random.default_rng(seed), crowd(30, seed)
        about = cost(rng.uniform(-1.2, 1.2, 2))
        for mpc in (charging, local):
            state = mpc.reset(observed, nodes_of(30, CAPACITY), about)
            plan, _ = mpc.step(observed, None, state)
            ids, paths = np.asarray(plan.node_ids), np.asarray(plan.states)[:, :, 0]
            inside = ids >= 0
            unknown = np.setdiff1d(np.arange(30), ids)
            assert len(unknown)
            moved = np.abs(paths - paths[0]).max(axis=(0, 2)) > 1e-3
            between = np.concatenate([paths, 0.5 * (paths[:-1] + paths[1:])])[:, inside & moved]
            gap = np.linalg.norm(between[:, :, None] - observed["position"][unknown], axis=-1)
            assert gap.min() > 0.08, (seed, mpc)
            struck += int(np.sum(moved[inside] & (ids[inside] > 1)))
    assert struck > 3, "bodies stand in the way"

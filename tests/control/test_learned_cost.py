"""Learning a cost from demonstrations of a task, with a model that was trained on it."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control import (
    ILQR,
    MPC,
    ControlLimits,
    CostLearningConfig,
    LearnedCost,
    learn_cost,
)
from contactgraph.control.contact_cost import KINDS
from contactgraph.control.cost_learner import cost_learner
from contactgraph.control.demonstrations import (
    demonstrations_of,
    filter_demonstrations,
    lasting_contacts,
    task_nodes,
)
from contactgraph.control.learned_cost import isotropic_axes, relative_terms
from contactgraph.data import Dataset, InvalidInputError, Scene, Trajectory
from contactgraph.envs import PickupExpert, PickupTask, RestPolicy
from contactgraph.evaluate import collect, control_task
from contactgraph.model import ContactBelief, load_model, scene_nodes, shipped_model
from contactgraph.policies import Planning, task_policy

RECIPE = CostLearningConfig(steps=50, batch=64)
LIMITS = ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))


@pytest.fixture(scope="module")
def model():
    return load_model(shipped_model("pickup")).model


@pytest.fixture(scope="module")
def runs() -> list[Trajectory]:
    """Five demonstrations of one goal, with two distractors."""
    return collect(
        [partial(PickupTask, 2, fixed_seed=7)], [PickupExpert(noise=0.0)], episodes=5, seed=0
    )


@pytest.fixture(scope="module")
def cost(model, runs) -> LearnedCost:
    return learn_cost(model, Dataset(tuple(runs)), RECIPE, limits=LIMITS)


def test_task_nodes_and_reasons_are_stored(cost):
    assert cost.kept_nodes == ("gripper", "target") and cost.order == (0, 1)
    gripper, target, *others = cost.task_nodes
    assert gripper.actuated and gripper.kept and "actuated" in gripper.reason
    assert target.active_trajectories == target.trajectories == 5
    assert "in contact in 5 of 5" in target.reason
    assert 0.5 < target.first_contact_time == gripper.first_contact_time < 2.0
    assert [(each.name, each.kept, each.active_trajectories) for each in others] == [
        ("distractor-0", False, 0),
        ("distractor-1", False, 0),
    ]


@pytest.mark.slow
def test_distractors_do_not_change_the_learned_cost(model, runs, cost):
    alone = [without(run, ("distractor-0", "distractor-1")) for run in runs]
    learned = learn_cost(model, Dataset(tuple(alone)), RECIPE, limits=LIMITS)
    assert np.allclose(learned.Q, cost.Q, rtol=1e-3, atol=1e-3)


def test_the_demonstrations_are_imitated_better(cost):
    loss = np.asarray(cost.imitation_loss)
    assert loss.shape == (50,) and loss[-10:].mean() < 0.6 * loss[:3].mean()
    assert np.trace(cost.R) == pytest.approx(2.0, rel=1e-5)
    assert np.linalg.eigvalsh(cost.Q)[0] > -1e-4 * np.linalg.eigvalsh(cost.Q)[-1]


def test_terms_stand_for_themselves_and_one_ties_the_gripper_to_the_target(cost):
    W = relative_terms(cost.Q, 2)
    assert np.abs(W[:4, 4:]).max() < 0.05 * np.abs(W).max()
    assert W[0, 0] == pytest.approx(W[1, 1], rel=0.1) and W[4, 4] == pytest.approx(W[5, 5], rel=0.1)
    assert cost.Q[0, 4] < -0.5 * cost.Q[0, 0], "the gripper is drawn to where the target is"


@pytest.mark.slow
def test_it_solves_new_scenes_and_goals(model, cost):
    task = PickupTask(3)
    policy = task_policy(model, task, Planning(horizon=40), cost=cost)
    result = control_task(policy, task, 6, 31)
    metrics, runs = result.metrics, result.trajectories
    assert metrics.success_rate == 1.0
    assert metrics.touched_bystanders == 0
    assert len({tuple(run.scene.goal) for run in runs}) == 6


def test_planners_take_it_like_any_other_cost(model, runs, cost):
    run = runs[0]
    observation = {"position": run.position[3], "velocity": run.velocity[3]}
    nodes = scene_nodes(run.scene)
    mpc = MPC(model, ILQR(horizon=4, iterations=3, limits=LIMITS))
    plans = []
    for wanted in (cost, cost.quadratic(4)):
        plan, _ = mpc.step(observation, None, mpc.reset(observation, nodes, wanted))
        plans.append(plan)
    assert np.array_equal(plans[0].controls, plans[1].controls)
    assert np.abs(plans[0].controls[0]).max() > 0.1

    whole = cost.quadratic(4)
    assert plan.cost == pytest.approx(
        float(whole(plan.states, plan.controls, plan.beliefs)), rel=1e-3
    )
    assert np.array_equal(
        whole.goal.reshape(4, 4)[:2, :2], np.tile(run.scene.goal, (2, 1)).astype("f")
    )
    assert not whole.Q[8:].any() and not whole.goal[8:].any()


def test_it_finds_its_nodes_by_name_and_takes_the_scene_s_goal(runs, cost):
    scene = runs[0].scene
    turned = replace(
        scene,
        node_name=scene.node_name[::-1],
        node_type=scene.node_type[::-1],
        actuated=scene.actuated[::-1],
        goal=np.array([0.1, 0.2]),
    )
    found = cost.in_scene(turned)
    assert found.order == (3, 2) and np.allclose(found.goal, [0.1, 0.2])
    assert found.among([0, 1]).order == (0, 1)
    with pytest.raises(InvalidInputError, match=r"nodes gripper, target, but .* no target"):
        cost.in_scene(without(runs[0], ("target",)).scene)
    with pytest.raises(InvalidInputError, match="the scene has no goal"):
        cost.in_scene(replace(scene, goal=None))
    solid = Scene(("gripper", "target"), ("a", "b"), np.array([1, 0]), 0.05, 3, goal=np.zeros(3))
    with pytest.raises(InvalidInputError, match="for dimension D 2, but the scene has 3"):
        cost.in_scene(solid)
    with pytest.raises(InvalidInputError, match="goal must be 2 finite numbers"):
        cost.with_goal([0.0, np.nan])


def test_the_contact_that_demonstrations_keep_is_learned_as_it_imitates_best(model, runs, cost):
    (found,) = cost.contacts
    assert (found.kind, found.nodes) == ("hold", ("gripper", "target"))
    dataset = Dataset(tuple(runs))
    filtered = filter_demonstrations(model, dataset)
    data = demonstrations_of(dataset, filtered, cost.kept_nodes, limits=LIMITS)
    wanted = lasting_contacts(dataset, filtered, cost.kept_nodes)
    assert wanted.pairs.tolist() == [[0, 1]]
    begin = np.argmax(runs[0].contact[:, 0, 1]) - RECIPE.horizon // 2
    starts = np.array([(number, max(begin, 0)) for number in range(len(runs))])
    learner = cost_learner(data, starts, RECIPE, isotropic_axes(np.zeros(2)), wanted)

    @jax.jit
    def loss(weight):
        contacts = replace(wanted, weight=jnp.atleast_1d(weight))
        return learner.imitation((cost.Q, cost.R, contacts), data, jnp.asarray(starts))

    without, much = loss(0.0), loss(30.0 * found.weight)
    assert loss(found.weight) < min(without, much)


def test_contacts_that_last_are_wanted_of_the_kind_that_is_inferred(model, runs):
    dataset, names = Dataset(tuple(runs)), ("gripper", "target")
    filtered = filter_demonstrations(model, dataset)
    types = np.array(filtered.posterior.type_probability)

    def found(types) -> list[int]:
        changed = replace(filtered, posterior=ContactBelief(jnp.asarray(types)))
        contacts = lasting_contacts(dataset, changed, names)
        assert len(contacts.pairs) == len(contacts.weight)
        return contacts.kind.tolist()

    assert found(types) == [KINDS.index("hold")]
    assert found(types[..., [0, 2, 1]]) == found(types[..., [0, 2]]) == [KINDS.index("touch")]
    ended = types.copy()
    ended[:, 60:, 0] = [1.0, 0.0, 0.0]
    assert found(ended) == []
    rare = types.copy()
    rare[: len(runs) // 2 + 1, :, 0] = [1.0, 0.0, 0.0]
    assert found(rare) == []


def test_a_given_goal_replaces_that_of_the_trajectories(model, runs, cost):
    bare = [replace(run, scene=replace(run.scene, goal=None)) for run in runs]
    learned = learn_cost(
        model, Dataset(tuple(bare)), RECIPE, goal=runs[0].scene.goal, limits=LIMITS
    )
    assert np.allclose(learned.Q, cost.Q) and np.allclose(learned.goal, runs[0].scene.goal)
    with pytest.raises(InvalidInputError, match="goal must be 2 finite numbers"):
        learn_cost(model, Dataset(tuple(bare)), RECIPE, goal=[1.0])


def test_a_control_at_its_limit_is_fixed_in_the_plan(model, runs):
    run = runs[0]
    bound = float(np.abs(run.control).max())
    limits = ControlLimits(jnp.full(2, -bound), jnp.full(2, bound))
    dataset = Dataset((run,))
    followed = filter_demonstrations(model, dataset)
    free = demonstrations_of(dataset, followed, ("gripper", "target"))
    held = demonstrations_of(dataset, followed, ("gripper", "target"), limits=limits)
    at = np.argwhere(np.abs(run.control) >= bound * (1 - 1e-9))
    assert len(at) >= 1
    step, axis = at[0]
    assert not held.B[0, step, :, axis].any() and held.controls[0, step, axis] == 0.0
    # The resulting behaviour is the same.
    for data in (free, held):
        x = data.A[0, step] @ data.states[0, step] + data.offset[0, step]
        moved = x + data.B[0, step] @ data.controls[0, step]
        assert np.allclose(moved, data.states[0, step + 1], atol=0.02)
    others = np.ones((run.steps, 2), bool)
    others[tuple(at.T)] = False
    assert np.array_equal(
        np.asarray(held.controls[0])[others], np.asarray(free.controls[0])[others]
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda run: cut(run, 12),
            "demonstration 1: control must have at least the horizon's 20 steps",
        ),
        (
            lambda run: replace(run, scene=replace(run.scene, goal=None)),
            "demonstration 1: goal is missing",
        ),
        (lambda run: resting(), "demonstration 1: the model infers no contact"),
        (
            lambda run: renamed(run, "target", "cup"),
            "demonstration 1: node_name must have 'target'",
        ),
    ],
)
def test_demonstrations_that_do_not_serve_are_named(model, runs, spoil, message):
    with pytest.raises(InvalidInputError, match=message):
        learn_cost(model, Dataset((runs[0], spoil(runs[1]), *runs[2:])), RECIPE)


def test_no_control_and_another_kind_of_scene_are_named(model, runs):
    blind = [replace(run, control=np.zeros((run.steps, 0))) for run in runs]
    with pytest.raises(
        InvalidInputError, match="demonstration 0: control must have at least one axis"
    ):
        learn_cost(model, Dataset(tuple(blind)), RECIPE)
    wide = [replace(run, control=np.zeros((run.steps, 3))) for run in runs]
    with pytest.raises(InvalidInputError, match="control size U 2, but demonstration 0 has 3"):
        learn_cost(model, Dataset(tuple(wide)), RECIPE)


def test_nodes_join_in_the_order_of_their_contacts(model, runs):
    turned = [reordered(run, (2, 1, 0, 3)) for run in runs]
    found = task_nodes(Dataset(tuple(turned)), filter_demonstrations(model, Dataset(tuple(turned))))
    assert [each.name for each in found[:2]] == ["gripper", "target"]


def cut(run: Trajectory, end: int) -> Trajectory:
    states = {name: getattr(run, name)[: end + 1] for name in ("position", "velocity", "contact")}
    return replace(run, control=run.control[:end], **states)


def resting() -> Trajectory:
    return collect([partial(PickupTask, 2, fixed_seed=7)], [RestPolicy()], episodes=1, seed=0)[0]


def without(run: Trajectory, names: tuple[str, ...]) -> Trajectory:
    kept = [i for i, name in enumerate(run.scene.node_name) if name not in names]
    return reordered(run, tuple(kept))


def reordered(run: Trajectory, order: tuple[int, ...]) -> Trajectory:
    index = list(order)
    scene = replace(
        run.scene,
        node_name=tuple(run.scene.node_name[i] for i in index),
        node_type=tuple(run.scene.node_type[i] for i in index),
        actuated=run.scene.actuated[index],
        mass=run.scene.mass[index],
        radius=run.scene.radius[index],
    )
    return replace(
        run,
        scene=scene,
        position=run.position[:, index],
        velocity=run.velocity[:, index],
        contact=run.contact[:, index][:, :, index],
    )


def renamed(run: Trajectory, old: str, new: str) -> Trajectory:
    names = tuple(new if name == old else name for name in run.scene.node_name)
    return replace(run, scene=replace(run.scene, node_name=names))

"""Public objects print one line of shapes and counts, whatever they hold."""

import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.control import (
    AffinePolicy,
    LearnedCost,
    Plan,
    PlanStatus,
    chain_cost,
)
from contactgraph.data import Dataset, pad_trajectories
from contactgraph.envs import PickupTask, RestPolicy
from contactgraph.evaluate import run_episode
from contactgraph.model import load_model, shipped_model, two_type_belief
from contactgraph.train import FitResult, FitStatus, TrainConfig, initial_state
from contactgraph.train.held_out import HeldOutBaselines
from contactgraph.viz import recorded_scene


def one_of_each() -> dict[str, object]:
    """A public object by its text; no model is compiled."""
    trajectory = run_episode(PickupTask(distractors=2), RestPolicy(), seed=0)
    model = load_model(shipped_model("pickup")).model
    cost = chain_cost([0, 1], [1.0] * 4, [1.0] * 4, 0.1, [0.0, 0.0], 4)
    return {
        "Trajectory(T=200, N=4, D=2, U=2, contact)": trajectory,
        "Scene(1 gripper, 3 object; N=4, D=2, dt=0.05 s)": trajectory.scene,
        "Dataset(2 trajectories, T=200, N=4, D=2, U=2, dt=0.05 s)": Dataset((trajectory,) * 2),
        "ContactDynamics(DurationEdges, D=2, U=2, dt=0.05 s)": model,
        f"StoredModel(model={model!r})": load_model(shipped_model("pickup")),
        "QuadraticCost(Q[16, 16], R[2, 2], goal[16])": cost,
        "LearnedCost(hand, box; Q[8, 8])": LearnedCost(
            cost.Q[:8, :8],
            cost.R,
            np.zeros(2),
            np.arange(2),
            ("hand", "box"),
            np.ones(1),
        ),
        f"FitState(step 0, best_error inf m, {model!r})": initial_state(model, TrainConfig(), 0),
        "TrajectoryBatch(position[1, 201, 4, 2], control[1, 200, 2])": pad_trajectories(
            (trajectory,)
        ),
        f"SceneTrajectory('rest', {trajectory!r}, E=6)": recorded_scene("rest", trajectory),
    }


def test_objects_print_one_line() -> None:
    objects = one_of_each()
    assert [repr(each) for each in objects.values()] == list(objects)


def test_a_plan_and_a_training_print_their_status() -> None:
    H, N = 3, 2
    policy = AffinePolicy(jnp.zeros((H, 2, N, 2, 2)), jnp.zeros((H, 2)))
    status = jnp.asarray(PlanStatus.CONVERGED)
    belief = two_type_belief(jnp.zeros((H, 1)))
    plan = Plan(
        *(jnp.zeros((H + 1, N, 2, 2)), jnp.zeros((H, 2)), policy, belief, jnp.asarray(1.5)),
        *(status, jnp.asarray(2), jnp.arange(N)),
    )
    assert repr(plan) == "Plan(states[4, 2, 2, 2], controls[3, 2], CONVERGED, cost 1.5)"
    traced = []
    jax.eval_shape(lambda each: traced.append(repr(each)), plan)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), plan)
    assert traced == ["Plan(states[4, 2, 2, 2], controls[3, 2])"]
    assert repr(batch) == "Plan(states[2, 4, 2, 2, 2], controls[2, 3, 2])"

    baselines = HeldOutBaselines(0.05, 0.1, True)
    result = FitResult(None, 0.002, FitStatus.finished, None, 61.2, baselines)  # type: ignore[arg-type]
    assert repr(result) == (
        "FitResult(all steps done, held-out error 0.002 m, constant velocity 0.05 m, 61 s)"
    )

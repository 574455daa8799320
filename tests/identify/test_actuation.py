"""Least squares of actuation, from trajectories with known servos and forces."""

import dataclasses

import numpy as np
import pytest

from contactgraph.data import Scene, Trajectory
from contactgraph.envs import CarryExpert, DelayTask
from contactgraph.evaluate import collect
from contactgraph.identify import fit_actuation, fit_theta
from contactgraph.identify.free_motion import driving_components

DT = 0.05
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])


def driven(
    matrix: np.ndarray,
    *,
    stiffness: float = 0.0,
    damping: float = 0.0,
    theta: float = 1.0,
    kind: tuple[str, ...] | None,
    pushes: bool = True,
    seed: int = 0,
) -> Trajectory:
    """A body with these coefficients, which in a fifth of the steps hits another and stops."""
    rng, steps, size = np.random.default_rng(seed), 400, matrix.shape[1]
    position, velocity = np.zeros((steps + 1, 2, 2)), np.zeros((steps + 1, 2, 2))
    position[:, 1] = 5.0
    control = np.repeat(rng.uniform(-1.0, 1.0, (steps // 4, size)), 4, axis=0)
    inertia = 1.0 + theta * damping * DT + theta**2 * stiffness * DT**2
    for step in range(steps):
        x, v = position[step, 0], velocity[step, 0]
        pull = matrix @ control[step] - stiffness * (x + theta * DT * v) - damping * v
        after = v + DT * pull / inertia
        if pushes and step % 5 == 0:
            after = np.zeros(2)
            position[step : step + 2, 1] = x + 0.05
        velocity[step + 1, 0] = after
        position[step + 1, 0] = x + DT * ((1.0 - theta) * v + theta * after)
    names = ("hand", "block")
    scene = Scene(names, names, np.array([True, False]), DT, control_kind=kind)
    return Trajectory(scene, position, velocity, control)


CASES = {
    "force": (TURN * 2.0, 0.0, 0.0, ("force", "force")),
    "position": (100.0 * np.eye(2), 100.0, 15.0, ("position", "position")),
    "displacement": (300.0 * TURN, 0.0, 40.0, ("displacement", "displacement")),
    "velocity": (12.0 * np.eye(2), 0.0, 12.0, ("velocity", "velocity")),
}


@pytest.mark.parametrize("name", CASES)
def test_the_coefficients_of_free_motion_are_found_among_contacts(name: str) -> None:
    matrix, stiffness, damping, kind = CASES[name]
    run = driven(matrix, stiffness=stiffness, damping=damping, kind=kind)
    fit = fit_actuation([run], 1.0)["hand"]
    np.testing.assert_allclose(fit.matrix, matrix, rtol=1e-3, atol=1e-3 * abs(matrix).max())
    assert fit.stiffness == pytest.approx(stiffness, rel=1e-3, abs=1e-6)
    assert fit.damping == pytest.approx(damping, rel=1e-3, abs=1e-6)
    assert fit.residual < 1e-6


def test_steps_in_which_a_body_is_carried_tell_nothing_of_free_motion() -> None:
    run = driven(np.eye(2), kind=("force", "force"), pushes=False)
    position, velocity = run.position.copy(), run.velocity.copy()
    for step in range(20, run.steps):  # both have the same mass
        velocity[step + 1, 0] = velocity[step, 0] + 0.5 * DT * run.control[step]
        position[step + 1, 0] = position[step, 0] + DT * velocity[step + 1, 0]
    velocity[21:, 1] = velocity[21:, 0]
    position[20:, 1] = position[20:, 0] + 0.05
    carried = dataclasses.replace(run, position=position, velocity=velocity)
    fit = fit_actuation([carried], 1.0)["hand"]
    np.testing.assert_allclose(fit.matrix, np.eye(2), atol=1e-3)


@pytest.mark.parametrize(("name", "sprung"), [("position", True), ("displacement", False)])
def test_a_kind_that_is_not_told_is_recognised(name: str, sprung: bool) -> None:
    matrix, stiffness, damping, _ = CASES[name]
    run = driven(matrix, stiffness=stiffness, damping=damping, kind=None)
    fit = fit_actuation([run], 1.0)["hand"]
    assert (fit.stiffness > 0.5 * stiffness) == sprung and (fit.stiffness == 0.0) != sprung
    np.testing.assert_allclose(fit.matrix, matrix, rtol=1e-2, atol=1e-2 * abs(matrix).max())


def test_theta_tells_means_over_a_step_from_velocities_at_its_end() -> None:
    for theta in (0.55, 0.7):
        run = driven(np.eye(2), theta=theta, kind=("force", "force"), pushes=False)
        assert fit_theta([run]) == pytest.approx(theta, abs=1e-3)
    assert fit_theta([driven(np.eye(2), kind=("force", "force"))]) == 0.99


def test_commands_drive_nothing() -> None:
    matrix = np.hstack([np.eye(2), np.zeros((2, 1))])
    run = driven(matrix, kind=("force", "force", "switch"))
    np.testing.assert_array_equal(driving_components([run]), [True, True, False])
    assert fit_actuation([run], 1.0)["hand"].matrix.shape == (2, 2)
    untold = driven(matrix, kind=None)
    np.testing.assert_array_equal(driving_components([untold]), [True, True, False])


def test_a_force_gets_no_damper_from_rounding() -> None:
    runs = collect([DelayTask], [CarryExpert()], episodes=4, seed=0)
    assert runs[0].scene.control_kind is None
    fit = fit_actuation(runs, fit_theta(runs))["gripper"]
    assert (fit.damping, fit.stiffness) == (0.0, 0.0)

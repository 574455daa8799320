"""Frozen contact of bodies on hinges: against a pendulum by hand."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation_worlds import DT, scene_of

from contactgraph.data import Trajectory
from contactgraph.evaluate.baselines import constant_velocity, fixed_contact_oracle

HINGE = np.array([0.3, -0.2])
NOWHERE = [np.nan, np.nan]


def doors(position, velocity, control, touching, anchor=None, **fields) -> Trajectory:
    """A gripper of 1 kg, doors of 4 kg on hinges; states after the first do not matter."""
    count, steps = len(position), len(control)
    anchor = [NOWHERE, *[HINGE] * (count - 1)] if anchor is None else anchor
    mass = np.array([1.0, *[4.0] * (count - 1)])
    contact = np.zeros((steps + 1, count, count), dtype=bool)
    for first, second in touching:
        contact[:, first, second] = contact[:, second, first] = True
    return Trajectory(
        scene_of(count, anchor=np.array(anchor), mass=mass, **fields),
        np.broadcast_to(position, (steps + 1, count, 2)),
        np.broadcast_to(velocity, (steps + 1, count, 2)),
        np.asarray(control, dtype=float),
        contact,
    )


def around(radius, angle):
    return HINGE + radius * np.array([np.cos(angle), np.sin(angle)])


def test_an_untouched_door_turns_evenly_and_the_gripper_flies_on():
    rate = 2.0
    trajectory = doors(
        [[1.0, 1.0], around(0.5, 0.4)],
        [[0.3, 0.1], 0.5 * rate * np.array([-np.sin(0.4), np.cos(0.4)])],
        np.ones((6, 2)),
        [],
    )
    found = fixed_contact_oracle(trajectory, 6)[0]
    expected = [around(0.5, 0.4 + rate * DT * step) for step in range(1, 7)]
    assert np.allclose(found[:, 1], expected, atol=1e-12)
    assert np.linalg.norm(constant_velocity(trajectory, 6)[0, -1, 1] - expected[-1]) > 0.05
    free = replace(trajectory, scene=replace(trajectory.scene, anchor=None))
    assert np.array_equal(found[:, 0], fixed_contact_oracle(free, 6)[0, :, 0])


@pytest.mark.parametrize(("substeps", "tolerance"), [(None, 1e-4), (4, 1e-12)])
def test_attached_bodies_rotate_together(substeps, tolerance):
    """Against a loop: of the simulator's own substeps, or of very fine ones."""
    rng = np.random.default_rng(3)
    control = 20.0 * rng.normal(size=(8, 2)) + [10.0, -10.0]
    fields = {} if substeps is None else {"metadata": {"substeps": substeps}}
    places = [around(0.8, 0.9), around(0.5, 1.0)]
    speeds = np.array([[0.4, -0.2], [-0.1, 0.3]])
    trajectory = doors(places, speeds, control, [(0, 1)], **fields)
    arms = np.array(places) - HINGE
    # A bar of length 1 about its end, and the gripper's mass at its arm.
    inertia = 4.0 * 1.0**2 / 3.0 + 1.0 * 0.8**2
    moments = arms[:, 0] * speeds[:, 1] - arms[:, 1] * speeds[:, 0]
    rate = (4.0 / 3.0 / 0.25 * moments[1] + moments[0]) / inertia
    angle, expected = 0.0, []
    fine = substeps or 20_000
    for force in control:
        for _ in range(fine):
            x, y = 0.8 * np.cos(0.9 + angle), 0.8 * np.sin(0.9 + angle)
            rate += DT / fine * (x * force[1] - y * force[0]) / inertia
            angle += DT / fine * rate
        expected.append([around(0.8, 0.9 + angle), around(0.5, 1.0 + angle)])
    assert abs(angle) > 0.1
    assert np.allclose(fixed_contact_oracle(trajectory, 8)[0], expected, atol=tolerance)


def test_two_hinges_lock_and_one_shared_hinge_does_not():
    places = [around(0.8, 0.9), around(0.5, 1.0), around(0.5, 0.8)]
    push = 5.0 * np.ones((4, 2)) * [1, -1]
    both = [(0, 1), (0, 2)]
    shared = fixed_contact_oracle(doors(places, np.zeros((3, 2)), push, both), 4)[0]
    assert np.linalg.norm(shared[-1, 0] - places[0]) > 0.01
    anchor = [NOWHERE, HINGE, HINGE + 1.0]
    locked = fixed_contact_oracle(doors(places, np.zeros((3, 2)), push, both, anchor), 4)[0]
    assert np.allclose(locked, np.array(places), atol=1e-12)
    # Another, untouched door has no effect.
    apart = fixed_contact_oracle(doors(places, np.zeros((3, 2)), push, [(0, 1)], anchor), 4)[0]
    assert np.linalg.norm(apart[-1, 0] - places[0]) > 0.01
    assert np.allclose(apart[:, 2], places[2])


def test_a_body_in_its_own_hinge_stays():
    found = fixed_contact_oracle(
        doors([HINGE, HINGE], np.ones((2, 2)), np.ones((3, 2)), [(0, 1)]), 3
    )
    assert np.allclose(found, HINGE)

from dataclasses import replace

import numpy as np
import pytest
from evaluation_worlds import DT, random_run, scene_of

from contactgraph.data import Scene, Trajectory
from contactgraph.envs import DoorExpert, DoorTask, PickupExpert, PickupTask
from contactgraph.evaluate import collect
from contactgraph.evaluate.baselines import (
    constant_velocity,
    fixed_contact_oracle,
    joined,
    standing_still,
)


def test_predictions_without_forces_by_hand():
    trajectory = random_run(2, 6, 0)
    flying, still = constant_velocity(trajectory, 3), standing_still(trajectory, 3)
    assert flying.shape == still.shape == (4, 3, 2, 2)
    assert np.allclose(flying[2, 1], trajectory.position[2] + 2 * DT * trajectory.velocity[2])
    assert np.array_equal(still, np.repeat(trajectory.position[:4, None], 3, axis=1))


def test_joined_through_others():
    contact = np.zeros((1, 6, 6), dtype=bool)
    for first, second in ((0, 1), (1, 2), (2, 3), (4, 5)):
        contact[0, first, second] = contact[0, second, first] = True
    blocks = np.kron(np.eye(2), np.ones((4, 4)))[:6, :6]
    assert np.array_equal(joined(contact)[0], blocks)


@pytest.mark.parametrize("substeps", [1, 4])
def test_frozen_contact_against_substeps_of_a_loop(substeps):
    """Masses that differ, a chain of three of which two are pushed, and one that is alone."""
    mass = np.array([1.0, 2.0, 4.0, 3.0])
    scene = replace(
        scene_of(4),
        mass=mass,
        actuated=np.array([True, False, True, False]),
        metadata={"substeps": substeps},
    )
    contact = np.zeros((6, 4, 4), dtype=bool)
    for first, second in ((0, 1), (1, 2)):
        contact[:, first, second] = contact[:, second, first] = True
    contact[4:] = False  # a change inside the window, which the floor does not know of
    rng = np.random.default_rng(1)
    trajectory = Trajectory(
        scene, rng.normal(size=(6, 4, 2)), rng.normal(size=(6, 4, 2)), rng.normal(size=(5, 2)),
        contact,
    )  # fmt: skip
    position, velocity = trajectory.position[1].copy(), trajectory.velocity[1].copy()
    expected = []
    for control in trajectory.control[1:5]:
        for _ in range(substeps):
            velocity[:3] += DT / substeps * 2 * control / mass[:3].sum()
            position += DT / substeps * velocity
        expected.append(position.copy())
    assert np.allclose(fixed_contact_oracle(trajectory, 4)[1], expected, atol=1e-12)


def test_weight_acts_on_carried_nodes_only():
    """A hand carries a body that holds another; a third rests, and a fourth slides by on it."""
    gravity, mass = np.array([0.3, 0.0, -9.8]), np.array([4.0, 1.0, 2.0, 3.0, 0.5])
    scene = Scene(
        node_name=tuple("abcde"),
        node_type=("hand", *["block"] * 4),
        actuated=np.arange(5) == 0,
        dt=DT,
        dimension=3,
        gravity=gravity,
        mass=mass,
    )
    contact = np.zeros((4, 5, 5), dtype=bool)
    for first, second in ((0, 1), (1, 2), (3, 4)):
        contact[:, first, second] = contact[:, second, first] = True
    rng = np.random.default_rng(2)
    velocity, force = rng.normal(size=(4, 5, 3)), rng.normal(size=(3, 3))
    velocity[:, 3] = 0.0
    trajectory = Trajectory(scene, rng.normal(size=(4, 5, 3)), velocity, force, contact)
    moved = fixed_contact_oracle(trajectory, 1) - constant_velocity(trajectory, 1)
    carried = (force + 3.0 * gravity) / 7.0 * DT**2 / 2
    np.testing.assert_allclose(moved[:, 0, :3], np.repeat(carried[:, None], 3, axis=1), atol=1e-14)
    assert not moved[:, 0, 3:].any()
    planar = replace(trajectory, scene=replace(scene, gravity=None))
    light = fixed_contact_oracle(planar, 1) - constant_velocity(planar, 1)
    np.testing.assert_allclose(light[:, 0, 1], force / 7.0 * DT**2 / 2, atol=1e-14)


def test_without_substeps_the_motion_is_the_exact_one():
    trajectory = Trajectory(
        replace(scene_of(1), mass=np.ones(1)),
        np.zeros((3, 1, 2)), np.zeros((3, 1, 2)), np.ones((2, 2)), np.zeros((3, 1, 1)),
    )  # fmt: skip
    assert np.allclose(
        fixed_contact_oracle(trajectory, 2)[0, :, 0, 0], [DT**2 / 2, (2 * DT) ** 2 / 2]
    )


def test_a_control_of_another_size_than_the_dimension():
    trajectory = random_run(2, 4, 0)
    none = replace(trajectory, control=np.zeros((4, 0)), contact=np.zeros((5, 2, 2)))
    assert np.allclose(fixed_contact_oracle(none, 2), constant_velocity(none, 2))
    more = replace(trajectory, control=np.column_stack([trajectory.control, np.ones(4)]))
    assert np.array_equal(fixed_contact_oracle(more, 2), fixed_contact_oracle(trajectory, 2))


def test_a_static_body_stays_and_holds_its_group():
    """A pillar of no known mass holds the second body; the first is pushed past them."""
    scene = replace(
        scene_of(4),
        mass=np.array([2.0, 1.0, 0.0, 3.0]),
        static=np.array([False, False, True, False]),
        actuated=np.array([True, True, False, False]),
    )
    contact = np.zeros((3, 4, 4), dtype=bool)
    contact[:, 1, 2] = contact[:, 2, 1] = True
    velocity = np.full((3, 4, 2), 0.1)
    run = Trajectory(scene, np.zeros((3, 4, 2)), velocity, np.full((2, 2), 6.0), contact)
    found = fixed_contact_oracle(run, 2)[0, 1]
    free = 2 * DT * 0.1
    assert np.allclose(found[0], free + 3.0 * (2 * DT) ** 2 / 2)
    assert np.allclose(found[1], free) and np.allclose(found[3], free)
    assert not found[2].any()


def test_only_components_that_are_forces_push():
    trajectory = random_run(2, 4, 0)
    scene = trajectory.scene
    control = np.column_stack([np.full(4, 9.0), trajectory.control, np.ones(4)])
    kinds = ("switch", "force", "force", "force")

    def pushed(**fields):
        given = replace(trajectory, control=control, scene=replace(scene, **fields))
        return fixed_contact_oracle(given, 2)

    expected = fixed_contact_oracle(trajectory, 2)
    own = np.array([[True, True, True, False], [False] * 4])
    assert np.allclose(pushed(control_kind=kinds, control_of=own), expected)
    # Without `control_of` component 0, the switch, is that of the first degree of freedom.
    shifted = replace(trajectory, control=np.column_stack([np.zeros(4), control[:, 1]]))
    assert np.allclose(pushed(control_kind=kinds), fixed_contact_oracle(shifted, 2))
    other = own[::-1]
    swapped = replace(trajectory, scene=replace(scene, actuated=np.array([False, True])))
    assert np.allclose(
        pushed(control_kind=kinds, control_of=other), fixed_contact_oracle(swapped, 2)
    )
    for kind in ("position", "displacement", "velocity", "other"):
        assert pushed(control_kind=(*kinds[:3], kind), control_of=own) is None
    passive = {"actuated": np.zeros(2, bool), "control_of": None}
    assert pushed(control_kind=("switch", *["position"] * 3), **passive) is not None


def test_unknown_masses_contacts_or_hinges_in_space_give_none():
    trajectory = random_run(2, 4, 0)
    scene, known = trajectory.scene, fixed_contact_oracle(trajectory, 2)
    assert known is not None
    assert fixed_contact_oracle(replace(trajectory, contact=None), 2) is None
    weightless = replace(trajectory, scene=replace(scene, mass=None))
    assert fixed_contact_oracle(weightless, 2) is None
    deep = replace(scene, dimension=3, anchor=np.zeros((2, 3)))
    still = np.zeros((5, 2, 3))
    in_space = Trajectory(deep, still, still, trajectory.control, trajectory.contact)
    assert fixed_contact_oracle(in_space, 2) is None
    nowhere = replace(trajectory, scene=replace(scene, anchor=np.full((2, 2), np.nan)))
    assert np.array_equal(fixed_contact_oracle(nowhere, 2), known)


@pytest.mark.parametrize(
    ("task", "expert", "tolerance", "least"),
    [(PickupTask, PickupExpert, 1e-4, 0.03), (DoorTask, DoorExpert, 1e-3, 0.01)],
)
def test_in_the_simulator_only_changes_of_contact_are_hard(task, expert, tolerance, least):
    (trajectory,) = collect([task], [expert()], 1, 0)
    starts = trajectory.steps - 9
    windows = np.arange(starts)[:, None] + np.arange(11)
    change = (trajectory.contact[windows] != trajectory.contact[windows[:, :1]]).any(axis=(1, 2, 3))
    assert change.any() and not change.all()

    def rmse(baseline, chosen):
        errors = baseline(trajectory, 10) - trajectory.position[windows[:, 1:]]
        return np.sqrt(np.mean(np.sum(errors[chosen] ** 2, axis=-1)))

    assert rmse(fixed_contact_oracle, ~change) < tolerance
    assert rmse(fixed_contact_oracle, change) > least
    assert rmse(constant_velocity, ~change) > 0.01

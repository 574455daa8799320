"""Distances, time of impact, prior and cutoff of an edge."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from model_scenes import DT, geometry_of

from contactgraph.bodies.geometry import Geometry
from contactgraph.data.graph import pair_indices
from contactgraph.model import (
    ClosestApproachPrior,
    DistancePrior,
    InvariantFeatures,
    NoCutoff,
    SmoothCutoff,
)

TOUCH = 0.08


@jax.jit
def from_origin(*moved) -> Geometry:
    moved = [jnp.stack([jnp.zeros(len(value)), value]) for value in moved]
    return geometry_of(*moved[:2], jnp.asarray(pair_indices(2)).T, DT, TOUCH, *moved[2:])


def between(displacement, velocity, control_displacement=None) -> Geometry:
    """Of one edge: the second node lies at `displacement`, moves with `velocity`, and is pushed."""
    given = displacement, velocity, control_displacement
    moved = [value for value in given if value is not None]
    return from_origin(*(np.array(value) if isinstance(value, list) else value for value in moved))


def test_an_edge_by_hand() -> None:
    found = between([0.3, 0.4], [-2.0, 0.0])
    np.testing.assert_allclose(found.distance, [0.5], rtol=1e-6)
    np.testing.assert_allclose(found.direction, [[0.6, 0.8]], rtol=1e-6)
    np.testing.assert_allclose(found.closest_approach, [np.hypot(0.2, 0.4)], rtol=1e-6)
    assert found.fraction_after_impact == 0


def test_closest_approach_is_the_least_distance_within_the_step() -> None:
    """A body that passes by within the step is farther away at both of its ends."""
    passing = between([0.03, 0.04], [-1.2, 0.0])
    np.testing.assert_allclose(passing.closest_approach, [0.04], rtol=1e-5)
    leaving = between([0.03, 0.04], [1.2, 0.0])
    np.testing.assert_allclose(leaving.closest_approach, leaving.distance)
    pushed = between([0.03, 0.04], [0.0, 0.0], control_displacement=[-0.02, 0.0])
    np.testing.assert_allclose(pushed.closest_approach, [np.hypot(0.01, 0.04)], rtol=1e-5)


coordinate = st.floats(-0.3, 0.3)
speed = st.floats(-4.0, 4.0)


@pytest.mark.usefixtures("double_precision")
@settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(x=coordinate, y=coordinate, v=speed, w=speed)
def test_the_fraction_after_impact_is_that_of_a_numeric_root(x, y, v, w) -> None:
    r, u = np.array([x, y]), np.array([v, w])
    share = float(between(r, u).fraction_after_impact[0])

    def gap(time):
        return np.linalg.norm(r + u * time) - TOUCH

    square = u @ u
    damped = square / (square + 0.01**2)
    nearest = -(r @ u) / square if square > 1e-12 else 0.0
    graze = abs(gap(max(nearest, 0.0))) < 1e-6 or abs(gap(0.0)) < 1e-9
    if graze or square < 1e-6 or abs(nearest) < 1e-9:
        assert 0 <= share <= 1  # Whether they touch, or approach, is a matter of rounding.
    elif gap(0.0) < 0:
        # They overlap already: all of the step comes after, if they still approach.
        assert abs(share - (damped if r @ u < 0 else 0.0)) < 1e-9
    elif nearest <= 0 or gap(nearest) > 0:
        assert share == 0
    else:
        touch = scipy.optimize.brentq(gap, 0.0, nearest, xtol=1e-14)
        assert abs(share - damped * np.clip(1 - touch / DT, 0, 1)) < 1e-7


@pytest.mark.usefixtures("double_precision")
def test_under_a_control_displacement_the_fraction_is_nearly_that_of_a_numeric_root() -> None:
    """A constant force has done a part squared of its work: |r + v t + a t^2 / 2| = touch.

    Three refinements take the force's part at the last guess, so the root is met to a hundredth of
    a step or two, not exactly.
    """
    rng, count = np.random.default_rng(0), 3000
    r = np.stack([TOUCH + rng.uniform(0.0, 0.1, count), rng.uniform(-0.05, 0.05, count)], axis=-1)
    u = np.stack([rng.uniform(-4.0, -1.0, count), rng.uniform(-1.0, 1.0, count)], axis=-1)
    control_displacement = rng.uniform(-0.01, 0.01, (count, 2))
    edges = jax.jit(jax.vmap(between))(r, u, control_displacement)
    part = np.linspace(0.0, 1.0, 2001)[:, None, None]
    distance = np.linalg.norm(r + part * DT * u + part**2 * control_displacement, axis=-1)
    touches = distance.min(axis=0) < TOUCH
    expected = np.where(touches, 1.0 - part[np.argmax(distance < TOUCH, axis=0), 0, 0], 0.0)
    error = np.abs(np.asarray(edges.fraction_after_impact[:, 0]) - expected)
    assert 0.3 < touches.mean() < 0.9
    assert error.max() < 0.03 and np.quantile(error, 0.99) < 0.003
    np.testing.assert_allclose(edges.closest_approach[:, 0], distance.min(axis=0), atol=1e-4)
    # Without its force the touch is elsewhere.
    blind = jax.jit(jax.vmap(between))(r, u).fraction_after_impact[:, 0]
    assert np.quantile(np.abs(blind - expected), 0.99) > 0.1


@jax.jit
def quantities_and_slopes(position, velocity, contact_distance):
    given = position, velocity, contact_distance
    return scene_quantities(*given), jax.jacrev(scene_quantities, argnums=(0, 1, 2))(*given)


def scene_quantities(position, velocity, contact_distance, control_displacement=None):
    pairs = jnp.asarray(pair_indices(len(position)))
    edges = geometry_of(position, velocity, pairs.T, DT, contact_distance, control_displacement)
    features = InvariantFeatures(length=TOUCH)
    # Nothing learns where bodies touch from what is only a guess at it.
    guess = jnp.full_like(edges.distance, TOUCH)
    guessed = dataclasses.replace(edges, contact_distance=guess)
    return (
        edges.distance,
        edges.direction,
        edges.fraction_after_impact,
        features.edge(guessed),
        edges.closest_approach,
        SmoothCutoff()(edges),
        DistancePrior()(edges),
        ClosestApproachPrior()(guessed),
    )


@pytest.mark.slow
@pytest.mark.usefixtures("double_precision")
def test_derivatives_against_finite_differences() -> None:
    # One pair meets within the step, one approaches, one overlaps: all away from the kinks.
    position = jnp.array([[0.0, 0.0], [0.11, 0.01], [-0.13, 0.02], [0.02, -0.06]])
    velocity = jnp.array([[0.4, 0.1], [-1.0, 0.2], [0.1, 0.3], [0.0, 0.5]])
    control_displacement = jnp.array([[0.004, 0.001], [-0.006, 0.002], [0.0, 0.0], [0.003, -0.002]])
    shares = scene_quantities(position, velocity, TOUCH, control_displacement)[3]
    assert np.sum((shares > 0.05) & (shares < 0.95)) >= 1
    for values in ((position, velocity, TOUCH), (position, velocity, TOUCH, control_displacement)):
        check_grads(jax.jit(scene_quantities), values, order=1, eps=1e-6)


def test_no_prior_teaches_where_bodies_touch() -> None:
    for prior in (DistancePrior(threshold=0.085), ClosestApproachPrior()):
        edges = between([0.082, 0.0], [0.0, 0.0])

        def active(touch: jax.Array) -> jax.Array:
            touching = jnp.broadcast_to(touch, 1)
            return prior(dataclasses.replace(edges, contact_distance=touching))[0]  # noqa: B023

        slope = jax.jit(jax.grad(active))
        assert slope(TOUCH) == 0.0
    features = InvariantFeatures(length=TOUCH)
    edges = between([0.082, 0.0], [0.0, 0.0])
    total = eqx.filter_grad(lambda features: jnp.sum(features.edge(edges)))
    slopes = eqx.filter_jit(total)(features)
    assert slopes.contact_distance == 0.0


@pytest.mark.parametrize(
    ("displacement", "velocity"),
    [
        ([0.0, 0.0], [0.0, 0.0]),  # Two nodes in one place: padding.
        ([0.0, 0.0], [1.0, 0.0]),
        ([0.1, 0.0], [0.0, 0.0]),
        ([0.05, 0.0], [0.0, 0.0]),
        ([0.08, 0.0], [-1.0, 0.0]),  # Exactly in touch.
        ([0.1, 0.08], [-1.0, 0.0]),  # A graze.
        ([0.13, 0.0], [-1.0, 0.0]),  # A touch exactly at the end of the step.
        ([1e-20, 0.0], [1e-20, 0.0]),
        ([1e4, 1e4], [-1e4, 1e4]),
    ],
)
def test_values_and_gradients_are_finite_everywhere(displacement, velocity) -> None:
    states = np.array([[0.0, 0.0], displacement]), np.array([[0.0, 0.0], velocity])
    for leaf in jax.tree.leaves(quantities_and_slopes(*states, TOUCH)):
        assert np.all(np.isfinite(leaf))


def test_bodies_in_contact_that_a_force_presses_together_meet_at_once() -> None:
    """They drift apart by 1 mm, and the control moves one by 3 mm towards the other."""
    pushed, alone = (
        between([0.079, 0.0], [0.001 / DT, 0.0], control) for control in ([-0.003, 0.0], [0.0, 0.0])
    )
    assert pushed.fraction_after_impact[0] > 0.9 and alone.fraction_after_impact[0] == 0.0


def test_attached_bodies_have_no_impact() -> None:
    assert between([0.0799, 0.0], [-1e-4, 0.0]).fraction_after_impact[0] < 1e-3
    assert between([0.0799, 0.0], [-1.0, 0.0]).fraction_after_impact[0] > 0.99


def paper_prior(distance: float, threshold: float) -> float:
    return float(jax.nn.softmax(jnp.array([threshold - distance, distance - threshold]))[0])


@pytest.mark.parametrize("distance", [0.01, 0.09, 0.1, 0.3, 2.0])
def test_the_papers_prior_is_a_setting_of_ours(distance: float) -> None:
    approaching = between([distance, 0.0], [-1.0, 0.0])
    paper = DistancePrior(threshold=0.1, inside=1.0, outside=1.0)
    expected = paper_prior(distance, 0.1)
    np.testing.assert_allclose(paper(approaching)[0], expected, atol=1e-6)
    # The authors' code multiplies the scores by 10 inside the threshold, as `paper_literal` does.
    times = 10 if distance < 0.1 else 1
    margin = times * (0.1 - distance)
    np.testing.assert_allclose(
        DistancePrior(threshold=0.1)(approaching)[0],
        jax.nn.softmax(jnp.array([margin, -margin]))[0],
        atol=1e-6,
    )


@pytest.mark.parametrize("touch", [0.08, 0.3])
def test_the_closest_approach_prior_is_sharp_at_the_contact_distance(touch: float) -> None:
    prior, still = ClosestApproachPrior(), [0.0, 0.0]

    def at(distances_of_touch: float) -> float:
        edges = between([distances_of_touch * touch, 0.0], still)
        return float(prior(dataclasses.replace(edges, contact_distance=jnp.full(1, touch)))[0])

    assert at(1.003) == pytest.approx(0.5, abs=1e-4)
    expected = 1e-4 + 0.9998 / (1 + np.exp(-2 * 0.001 / 0.002))
    assert at(1.002) == pytest.approx(expected, abs=1e-4)
    assert at(1.0) > 0.9 and at(1.01) < 0.02
    assert at(0.2) == pytest.approx(0.9999, abs=1e-6)
    assert at(5.0) == pytest.approx(1e-4, abs=1e-6)


def test_the_closest_approach_prior_covers_the_whole_next_step() -> None:
    prior = ClosestApproachPrior()
    assert prior(between([0.2, 0.0], [-3.0, 0.0]))[0] > 0.9
    assert prior(between([0.2, 0.0], [3.0, 0.0]))[0] < 0.02
    # What leaves contact has its distance now; what only passes by touches in between.
    assert prior(between([0.05, 0.0], [3.0, 0.0]))[0] > 0.9
    assert prior(between([0.09, 0.06], [-3.6, 0.0]))[0] > 0.9
    # And a control_displacement decides whether it gets there.
    near = [0.1, 0.0], [0.0, 0.0]
    assert prior(between(*near))[0] < 0.02
    assert prior(between(*near, control_displacement=[-0.02, 0.0]))[0] > 0.8


def test_cutoff_is_one_near_and_exactly_zero_far() -> None:
    reach = SmoothCutoff(inner=0.15, outer=0.25)
    still = [0.0, 0.0]
    assert reach(between([0.15, 0.0], still))[0] == 1
    assert reach(between([0.25, 0.0], still))[0] == 0
    assert reach(between([0.2, 0.0], still))[0] == pytest.approx(0.5, abs=1e-5)
    weights = [float(reach(between([d, 0.0], still))[0]) for d in np.linspace(0.1, 0.3, 41)]
    assert weights == sorted(weights, reverse=True)
    assert NoCutoff()(between([9.0, 0.0], still))[0] == 1

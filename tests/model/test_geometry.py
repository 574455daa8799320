"""Distances, the moment of touch, the prior and the reach of an edge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from model_scenes import DT

from contactgraph.data.graph import pair_indices
from contactgraph.model import DistancePrior, Everywhere, InvariantFeatures, Reach
from contactgraph.model.geometry import Geometry, geometry

TOUCH = 0.08


def between(displacement, velocity, touch_distance=TOUCH) -> Geometry:
    """Of one edge: the second node lies at `displacement` and moves with `velocity`."""
    displacement, velocity = jnp.asarray(displacement), jnp.asarray(velocity)
    zero = jnp.zeros_like(displacement)
    pairs = jnp.asarray(pair_indices(2))
    states = jnp.stack([zero, displacement]), jnp.stack([zero, velocity])
    return geometry(*states, pairs, DT, touch_distance)


def test_an_edge_by_hand() -> None:
    found = between([0.3, 0.4], [-2.0, 0.0])
    np.testing.assert_allclose(found.distance, [0.5], rtol=1e-6)
    np.testing.assert_allclose(found.direction, [[0.6, 0.8]], rtol=1e-6)
    np.testing.assert_allclose(found.coming_distance, [np.hypot(0.2, 0.4)], rtol=1e-6)
    np.testing.assert_allclose(found.nearest, found.coming_distance)
    assert found.share_after_touch == 0


coordinate = st.floats(-0.3, 0.3)
speed = st.floats(-4.0, 4.0)


@pytest.mark.usefixtures("double_precision")
@settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(x=coordinate, y=coordinate, v=speed, w=speed)
def test_the_share_after_touch_is_that_of_a_numeric_root(x, y, v, w) -> None:
    r, u = np.array([x, y]), np.array([v, w])
    share = float(between(r, u).share_after_touch[0])

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


def scene_quantities(position, velocity, touch_distance):
    seen = geometry(
        position, velocity, jnp.asarray(pair_indices(len(position))), DT, touch_distance
    )
    features = InvariantFeatures(length=TOUCH)
    return (
        seen.distance,
        seen.coming_distance,
        seen.direction,
        seen.share_after_touch,
        features.edge(seen),
        Reach()(seen),
        DistancePrior()(seen),
    )


@pytest.mark.usefixtures("double_precision")
def test_derivatives_against_finite_differences() -> None:
    # One pair meets within the step, one approaches, one overlaps: all away from the kinks.
    position = jnp.array([[0.0, 0.0], [0.11, 0.01], [-0.13, 0.02], [0.02, -0.06]])
    velocity = jnp.array([[0.4, 0.1], [-1.0, 0.2], [0.1, 0.3], [0.0, 0.5]])
    shares = scene_quantities(position, velocity, TOUCH)[3]
    assert np.sum((shares > 0.05) & (shares < 0.95)) >= 1
    # Compiled, because check_grads calls with numpy arrays, which the annotations refuse.
    check_grads(jax.jit(scene_quantities), (position, velocity, TOUCH), order=1, eps=1e-6)


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
    states = jnp.array([[0.0, 0.0], displacement]), jnp.array([[0.0, 0.0], velocity])
    found = scene_quantities(*states, jnp.asarray(TOUCH))
    slopes = jax.jacrev(scene_quantities, argnums=(0, 1, 2))(*states, jnp.asarray(TOUCH))
    for leaf in jax.tree.leaves((found, slopes)):
        assert np.all(np.isfinite(leaf))


def test_bodies_that_hold_together_have_no_impact() -> None:
    assert between([0.0799, 0.0], [-1e-4, 0.0]).share_after_touch[0] < 1e-3
    assert between([0.0799, 0.0], [-1.0, 0.0]).share_after_touch[0] > 0.99


def paper_prior(distance: float, threshold: float) -> float:
    return float(jax.nn.softmax(jnp.array([threshold - distance, distance - threshold]))[0])


@pytest.mark.parametrize("distance", [0.01, 0.09, 0.1, 0.3, 2.0])
def test_the_papers_prior_is_a_setting_of_ours(distance: float) -> None:
    approaching = between([distance, 0.0], [-1.0, 0.0])
    paper = DistancePrior(threshold=0.1, inside=1.0, outside=1.0, look_ahead=False)
    np.testing.assert_allclose(paper(approaching)[0], paper_prior(distance, 0.1), atol=1e-6)
    # The authors' code multiplies the scores by 10 inside the threshold.
    sharper = DistancePrior(threshold=0.1, inside=0.1, outside=1.0, look_ahead=False)
    times = 10 if distance < 0.1 else 1
    margin = times * (0.1 - distance)
    np.testing.assert_allclose(
        sharper(approaching)[0], jax.nn.softmax(jnp.array([margin, -margin]))[0], atol=1e-6
    )


def test_the_prior_looks_one_step_ahead() -> None:
    prior = DistancePrior(threshold=0.1)
    assert prior(between([0.2, 0.0], [-3.0, 0.0]))[0] > 0.9
    assert prior(between([0.2, 0.0], [3.0, 0.0]))[0] < 0.1
    # What leaves contact has its distance now.
    assert prior(between([0.05, 0.0], [3.0, 0.0]))[0] > 0.9


def test_reach_is_one_near_and_exactly_zero_far() -> None:
    reach = Reach(near=0.15, far=0.25)
    still = [0.0, 0.0]
    assert reach(between([0.15, 0.0], still))[0] == 1
    assert reach(between([0.25, 0.0], still))[0] == 0
    assert reach(between([0.2, 0.0], still))[0] == pytest.approx(0.5, abs=1e-5)
    weights = [float(reach(between([d, 0.0], still))[0]) for d in np.linspace(0.1, 0.3, 41)]
    assert weights == sorted(weights, reverse=True)
    assert Everywhere()(between([9.0, 0.0], still))[0] == 1

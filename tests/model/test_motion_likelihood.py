"""Evidence of contact from motion: by hand, without information, and bounded."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, compiled, nodes_of, preset, with_random_weights
from motion_worlds import Keeps, in_a_row, observed_after, rigid_world

from contactgraph.data import InvalidInputError
from contactgraph.inference.motion_noise import PredictionNoise
from contactgraph.model import (
    ContactBelief,
    ModelConfig,
    ModelState,
    MotionNoise,
    check_motion_model,
    correct_by_motion,
    ours,
    two_type_belief,
    usual_edge_types,
)
from contactgraph.model.motion_likelihood import edge_log_ratios, most_probable

NOISE = MotionNoise()
REST = jnp.zeros(2)
PUSH = jnp.array([4.0, 0.0])  # N, along the row
ONE = nodes_of(1)


class Judged(NamedTuple):
    predicted: ContactBelief
    log_ratio: jax.Array
    """Of each edge: active throughout the step, less inactive throughout."""
    corrected: ContactBelief


@eqx.filter_jit
def _judge(model, state, control, observed, nodes, noise) -> Judged:
    """`correct_by_motion`, and the evidence for it."""
    graph = model.encode_state(state, control, nodes)
    predicted, joint = model.predict_joint(state.belief, graph)
    first = most_probable(ContactBelief(jnp.sum(joint, axis=1)))
    ratios = edge_log_ratios(model, graph, joint, observed, noise, first)
    corrected = correct_by_motion(model, predicted, state, control, observed, nodes, noise)
    return Judged(predicted, ratios[:, 1, 1] - ratios[:, 0, 0], corrected)


def judged(state, control, observed, noise=NOISE, model=None, nodes=None) -> Judged:
    nodes = nodes_of(len(state.position)) if nodes is None else nodes
    # Python numbers would be constants of the program: one program for each noise.
    noise = jax.tree.map(np.asarray, noise)
    return _judge(model or rigid_world(), state, control, observed, nodes, noise)


def log_likelihood(noise, effect, off):
    """Of one body whose velocity [m/s] contact changes by ``effect``, and which is ``off``."""
    variance_v = noise.model_velocity**2 + (noise.type_share * effect) ** 2
    variance_x = noise.model_position**2 + 2 * (noise.type_share * DT * effect) ** 2
    error = off**2 / variance_v + (DT * off) ** 2 / variance_x
    spread = np.log(variance_v) + np.log(variance_x)
    return -(noise.tail + 4) / 2 * np.log1p(error / noise.tail) - spread


def by_hand(noise, effect, moved):
    """Of two bodies that contact moves by ``effect`` and that moved by ``moved`` [m/s]."""
    contrast = (effect / noise.model_velocity) ** 2 + (DT * effect / noise.model_position) ** 2
    active = log_likelihood(noise, effect, moved - effect)
    return 2 * (1 - 2 / contrast) * (active - log_likelihood(noise, 0.0, moved))


@pytest.mark.parametrize("moved", [0.5, 0.4, 0.0])
def test_an_impact_by_hand(moved) -> None:
    # One body runs into another: together they go on at half its speed, or past it.
    noise = MotionNoise(max_log_ratio=100.0)
    state = in_a_row(2, [1.0, 0.0], 0.2)
    found = judged(state, REST, observed_after(state, [1.0 - moved, moved]), noise)
    assert found.log_ratio[0] == pytest.approx(by_hand(noise, 0.5, moved), rel=1e-3)
    # Odds are those before, times the likelihoods' ratio.
    odds = 0.25 * np.exp(float(found.log_ratio[0]))
    assert found.corrected.probability[0] == pytest.approx(odds / (1 + odds), abs=1e-5)
    assert (found.corrected.probability[0] < 0.01) == (moved == 0.0)


def test_equal_predictions_give_a_log_ratio_of_exactly_zero() -> None:
    state = in_a_row(2, [0.7, 0.7], 0.3)
    found = judged(state, REST, observed_after(state, [0.7, 0.7]))
    assert found.log_ratio[0] == 0.0
    np.testing.assert_array_equal(
        found.corrected.type_probability, found.predicted.type_probability
    )
    # Nor does what happens to bodies out of each other's reach.
    far = in_a_row(2, [1.0, 0.0], 0.3, gap=0.5)
    found = judged(far, REST, observed_after(far, [0.5, 0.5]))
    assert found.log_ratio[0] == 0.0 and found.corrected.probability[0] == 0.0


@pytest.mark.parametrize(("velocity", "holds"), [([0.1, 0.1], True), ([0.2, 0.0], False)])
def test_a_load_is_evidence_of_contact(velocity, holds) -> None:
    # 4 N for 0.05 s on 1 kg, or on 2 kg.
    state = in_a_row(2, [0.0, 0.0], 0.5)
    found = judged(state, PUSH, observed_after(state, velocity))
    assert (found.corrected.probability[0] > 0.9) == holds
    assert (found.corrected.probability[0] < 0.1) != holds


def test_a_break_is_detected_at_once() -> None:
    state = in_a_row(2, [0.5, 0.5], 0.9999)
    found = judged(state, -PUSH, observed_after(state, [0.3, 0.5]))
    assert found.predicted.probability[0] > 0.98 and found.corrected.probability[0] < 0.5


def test_unexplained_motion_is_weak_evidence() -> None:
    state = in_a_row(2, [0.5, 0.5], 0.95)
    position, velocity = observed_after(state, [0.6, 0.6])
    unbounded = MotionNoise(type_share=0.01, max_log_ratio=100.0)
    fits = judged(state, PUSH, (position, velocity), unbounded).log_ratio[0]
    # One body is observed far off: only the other one's evidence is left.
    wild = position.at[1].add(jnp.array([3.0, -2.0])), velocity.at[1].add(20.0)
    found = judged(state, PUSH, wild, unbounded)
    assert 0.4 * fits < found.log_ratio[0] < 0.6 * fits
    # Both are.
    found = judged(state, PUSH, (position + 3.0, velocity - 20.0), unbounded)
    assert abs(found.log_ratio[0]) < 0.05 * fits and found.corrected.probability[0] > 0.9
    # The step after: it begins where nothing was.
    jumped = dataclasses.replace(state, position=state.position + 3.0)
    found = judged(jumped, PUSH, (position, velocity), unbounded)
    assert abs(found.log_ratio[0]) < 0.05 * fits and found.corrected.probability[0] > 0.9


def test_one_frame_never_saturates() -> None:
    state = in_a_row(2, [5.0, 0.0], 0.0001)
    for velocity in ([2.5, 2.5], [5.0, 0.0]):
        found = judged(state, REST, observed_after(state, velocity))
        assert abs(found.log_ratio[0]) == NOISE.max_log_ratio
    # A belief that motion contradicts counts as no surer than 1 in 100.
    odds = 0.01 / 0.99 * np.exp(NOISE.max_log_ratio)
    found = judged(state, REST, observed_after(state, [2.5, 2.5]))
    assert found.corrected.probability[0] == pytest.approx(odds / (1 + odds), rel=1e-3)


def test_differences_within_the_noise_are_none() -> None:
    noise = MotionNoise(position=1e-3, velocity=0.02)
    state = in_a_row(2, [0.01, -0.01], 0.3)
    assert judged(state, REST, observed_after(state, [0.0, 0.0]), noise).log_ratio[0] == 0.0
    assert judged(state, REST, observed_after(state, [0.0, 0.0])).log_ratio[0] != 0.0


def test_explained_motion_is_no_evidence_for_another_contact() -> None:
    state = in_a_row(3, [0.0, 0.0, 0.0], 0.3, gap=0.06)
    third = DT * 4.0 / 3
    found = judged(state, PUSH, observed_after(state, [third] * 3))
    # Edges 0-1, 0-2, 1-2: the row holds together by its neighbours.
    assert found.log_ratio[0] > 2 and found.log_ratio[2] > 2
    assert found.log_ratio[1] == 0.0
    np.testing.assert_array_equal(found.corrected.probability > 0.5, [True, False, True])


@pytest.mark.parametrize("place", ["before", "after"])
def test_a_step_with_an_invalid_observation_is_no_evidence(place) -> None:
    state = in_a_row(2, [1.0, 0.0], 0.4)
    position, velocity = observed_after(state, [0.5, 0.5])
    if place == "before":
        state = dataclasses.replace(state, velocity=state.velocity.at[0, 0].set(jnp.nan))
    else:
        position = position.at[1, 1].set(jnp.inf)
    carried = two_type_belief(jnp.array([0.25]))
    arguments = (carried, state, REST, (position, velocity), nodes_of(2), NOISE)
    belief = eqx.filter_jit(correct_by_motion)(rigid_world(), *arguments)
    np.testing.assert_array_equal(belief.probability, [0.25])


def test_padding_changes_nothing() -> None:
    state, padded = in_a_row(2, [1.0, 0.0], 0.3), in_a_row(4, [1.0, 0.0, 0.0, 0.0], 0.3)
    observed, more = observed_after(state, [0.6, 0.4]), observed_after(padded, [0.6, 0.4, 9.0, 9.0])
    one = judged(state, REST, observed)
    other = judged(padded, REST, more, nodes=nodes_of(2, 4))
    assert other.log_ratio[0] == pytest.approx(float(one.log_ratio[0]), rel=1e-5)
    assert np.all(other.log_ratio[1:] == 0)


def test_a_single_body_has_no_edge_to_judge() -> None:
    config = ModelConfig(2, 2, DT, width=4)
    model = with_random_weights(lambda: ours(config, key=jax.random.PRNGKey(0)))
    position, velocity = jnp.zeros((1, 2)), jnp.ones((1, 2))
    state = ModelState(position, velocity, compiled(model.initial_belief, position, velocity, ONE))
    found = judged(state, PUSH, (position, velocity), model=model, nodes=ONE)
    assert found.log_ratio.shape == (0,)
    assert found.corrected.type_probability.shape == (0, 3)
    assert found.corrected.memory.age.shape == found.predicted.memory.age.shape == (0, 3, 44)


@pytest.mark.slow
@pytest.mark.usefixtures("double_precision")
def test_double_precision() -> None:
    state = in_a_row(3, [1.0, 0.0, 0.0], 0.3)
    for model in (rigid_world(), preset("recurrent")):
        found = judged(state, PUSH, observed_after(state, [0.6, 0.6, 0.0]), model=model)
        kinds = {leaf.dtype for leaf in jax.tree.leaves(found)}
        assert kinds == {jnp.dtype(jnp.float64)}
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))


@pytest.mark.parametrize("name", ["paper_literal_no_gim", "full_ab"])
def test_every_kind_of_local_dynamics_gives_finite_evidence(name) -> None:
    state = in_a_row(3, [1.0, 0.0, 0.0], 0.3)
    found = judged(state, PUSH, observed_after(state, [0.6, 0.6, 0.0]), model=preset(name))
    assert np.all(np.isfinite(found.log_ratio))
    assert np.all((found.corrected.probability >= 0) & (found.corrected.probability <= 1))


def test_arguments() -> None:
    with pytest.raises(InvalidInputError, match=r"velocity must be at least 0.*found -0.1"):
        MotionNoise(velocity=-0.1)
    with pytest.raises(InvalidInputError, match="position and model_position must not both be 0"):
        MotionNoise(model_position=0.0)
    with pytest.raises(InvalidInputError, match=r"must be a ContactDynamics.*found Keeps"):
        check_motion_model(Keeps())


def pair_log_ratios(share: float, parts: tuple[float, float], touch: bool = False) -> np.ndarray:
    """Of a node at rest where it is free, which did parts of what it does where it is held."""
    position, velocity = (size * np.arange(2) for size in (0.05, 1.0))
    if touch:  # that does half of it
        position, velocity = np.insert(position, 1, 0.025), np.insert(velocity, 1, 0.5)
    noise = MotionNoise(
        model_position=1e-3,
        model_velocity=2e-2,
        type_share=share,
        max_log_ratio=1e3,
    )
    predictions = tuple(jnp.stack([each, 0 * each], -1)[:, None] for each in (position, velocity))
    observed = tuple(part * each[-1] for part, each in zip(parts, predictions, strict=True))
    types = usual_edge_types(3 if touch else 2)
    return np.asarray(noise.log_ratios(predictions, observed, jnp.ones(1, bool), 0.05, types))


@pytest.mark.parametrize(
    ("parts", "likeliest"),
    [((0.0, 0.0), (0, 0)), ((0.5, 1.0), (0, 1)), ((0.5, 0.5), (1, 0)), ((1.0, 1.0), (1, 1))],
)
def test_pairs_of_types_by_hand(parts, likeliest) -> None:
    """What is grasped in a step moves in the end as if always held; what is let go, in between."""
    found = pair_log_ratios(0.1, parts)
    expected, contrast = np.zeros((2, 2)), np.zeros((2, 2))

    def expected_parts(first: int, last: int) -> np.ndarray:
        middle = 0.5 * (first + last)
        return np.array([middle, float(last) if last > first else middle])

    for first, last in np.ndindex(2, 2):
        effect = np.array([first, last]) * 0.1**2
        change = (first != last) / 12.0
        share_v = effect[1] if last > first else effect.mean() + change
        variance_v = 2e-2**2 + share_v
        variance_x = 1e-3**2 + (effect.mean() + change) * 0.05**2
        variance_x += 0.05**2 * (effect.mean() + change)
        off = np.array(parts) - expected_parts(first, last)
        error = (0.05 * off[0]) ** 2 / variance_x + off[1] ** 2 / variance_v
        expected[first, last] = -4.0 * np.log1p(error / 4.0) - np.log(variance_x * variance_v)
        away = expected_parts(first, last) - expected_parts(*likeliest)
        contrast[first, last] = (0.05 * away[0] / 1e-3) ** 2 + (away[1] / 2e-2) ** 2
    # Bodies meet as foreseen, or at any time of the step; a hold ends then or in the last instant.
    expected[[0, 1], [1, 0]] = np.logaddexp(expected[[0, 1], [1, 0]], expected[1, 1]) - np.log(2.0)
    assert np.unravel_index(np.argmax(expected), (2, 2)) == likeliest
    by_hand = (1.0 - 2.0 / np.maximum(contrast, 2.0)) * (expected - expected[likeliest])
    np.testing.assert_allclose(found, by_hand, rtol=1e-4, atol=1e-4)


def test_a_hold_may_begin_after_a_touch_that_fills_the_step() -> None:
    """Bodies that meet late in a step move as if they only touched; the next step tells."""
    whole = pair_log_ratios(0.02, (0.5, 0.5), touch=True)
    np.testing.assert_allclose(whole[:2, 2], whole[:2, 1] - np.log(2.0), atol=0.05)
    assert whole[2, 2] < -5.0, "what was held before is none"


def test_a_hold_that_is_a_little_off_is_no_touch_and_hold_in_turn() -> None:
    off = pair_log_ratios(0.1, (0.9, 0.9), touch=True)
    assert off[2, 2] == 0.0 and off[1, 2] + off[2, 1] < -2.0, "the likeliest"


def test_a_model_learns_how_exact_its_motion_and_its_effects_are() -> None:
    """Residuals of 0 would shrink both."""
    moved, still = jnp.ones((1, 2)), jnp.zeros((1, 2))

    def score(noise: PredictionNoise) -> jax.Array:
        motions = (moved, moved), (still, still), (moved, moved)
        return jnp.sum(noise.score(*motions, jnp.ones(1), 0.1))

    noise = PredictionNoise()
    gradient = jax.grad(score)(noise)
    assert gradient.log_velocity > 0.0 and gradient.log_share > 0.0
    assert noise.share.shape == (), "of two, that of touches would grow until they fit any motion"
    exact = eqx.tree_at(lambda each: each.log_share, noise, noise.log_share - 9.0)
    assert exact.share == pytest.approx(0.01), "never certain"


def test_bodies_that_are_apart_after_a_step_have_not_met_in_it() -> None:
    """A hand comes to a body, as geometry sees it; both then have one velocity, as a hold has it.
    But where they end, whatever stopped them, tells whether they have met: unless they come from
    each other, as after a bounce."""
    model = ours(ModelConfig(2, 2, DT, width=8), key=jax.random.PRNGKey(0))
    touch, nodes = float(model.features.contact_distance), nodes_of(2)
    position = jnp.array([[0.0, 0.0], [1.2 * touch, 0.0]])
    velocity = jnp.array([[1.0, 0.0], [0.0, 0.0]])

    @eqx.filter_jit
    def begins(gap: float, parting: float) -> jax.Array:
        """Evidence of a touch and of a hold that begin; m/s."""
        belief = model.initial_belief(position, velocity, nodes)
        graph = model.encode_state(ModelState(position, velocity, belief), REST, nodes)
        joint = model.predict_joint(belief, graph)[1]
        after = jnp.array([[0.4 * touch, 0.0], [(1.4 + gap) * touch, 0.0]])
        observed = after, jnp.array([[0.5 - parting, 0.0], [0.5 + parting, 0.0]])
        types = jnp.array([[1.0, 0.0, 0.0]])
        return edge_log_ratios(model, graph, joint, observed, NOISE, types)[0, 0, 1:]

    assert float(begins(0.0, 0.0)[1]) > 2.0
    assert float(begins(0.1, 0.0).max()) < -2.0 * NOISE.max_log_ratio
    assert float(begins(0.1, 0.2 * touch / DT)[0]) > -NOISE.max_log_ratio

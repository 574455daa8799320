"""The theta method: stable for theta >= 1/2, the paper's own step at 0, and of the right order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from contactgraph.data import InvalidInputError
from contactgraph.model import SpringMassDamper, ThetaMethod, from_physical

pytestmark = pytest.mark.usefixtures("double_precision")
DT = 0.05
DRAWS = 100_000


def log_uniform(rng: np.random.Generator, shape: tuple[int, ...], low=-4.5, high=4.5):
    """Numbers spread evenly over nine decades."""
    return 10.0 ** rng.uniform(low, high, shape)


def random_parameters(seed: int) -> SpringMassDamper:
    """[DRAWS, 1] inverse masses, stiffnesses and dampings, one in ten of them 0."""
    rng = np.random.default_rng(seed)
    inverse_mass, stiffness, damping = (
        jnp.asarray(log_uniform(rng, (DRAWS, 1)) * (rng.random((DRAWS, 1)) > 0.1)) for _ in range(3)
    )
    return from_physical(inverse_mass, stiffness, damping, jnp.zeros((DRAWS, 1)))


def spectral_radius(A: np.ndarray) -> np.ndarray:
    """[…] of blocks [..., 2, 2], from the roots of their characteristic polynomials.

    Where the two coincide, rounding of the entries (1e-16) moves them by its root (1e-8): such
    pairs are taken as one root, and the energy norm below judges them.
    """
    mean = (A[..., 0, 0] + A[..., 1, 1]) / 2
    discriminant = ((A[..., 0, 0] - A[..., 1, 1]) / 2) ** 2 + A[..., 0, 1] * A[..., 1, 0]
    root = np.sqrt(np.abs(np.where(np.abs(discriminant) < 1e-14, 0, discriminant)))
    return np.where(discriminant > 0, np.abs(mean) + root, np.hypot(mean, root))


def energy_norm(A: np.ndarray, stiffness_rate: np.ndarray) -> np.ndarray:
    """The largest growth in a step of sqrt(k/m x^2 + v^2); 1 or less means stable."""
    frequency = np.sqrt(np.maximum(stiffness_rate, 1e-30))
    scaled = A.copy()
    scaled[..., 0, 1] *= frequency
    scaled[..., 1, 0] /= frequency
    return np.linalg.norm(scaled, ord=2, axis=(-2, -1))


def test_the_radius_is_that_of_a_library():
    A = np.random.default_rng(0).normal(size=(100, 2, 2))
    expected = np.abs(np.linalg.eigvals(A)).max(axis=-1)
    np.testing.assert_allclose(spectral_radius(A), expected, rtol=1e-9)


def step(theta: float, parameters: SpringMassDamper, dt: float = DT):
    return ThetaMethod(theta, learned=False)(parameters, dt, 1)


def worst(theta: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Spectral radii and energy norms of all draws."""
    parameters = random_parameters(seed)
    A = np.asarray(step(theta, parameters).A)
    return spectral_radius(A), energy_norm(A, np.asarray(parameters.stiffness_rate))


@pytest.mark.parametrize("theta", [0.5, 0.55, 0.6, 0.75, 1.0])
def test_no_draw_is_unstable_from_one_half_on(theta):
    radius, norm = worst(theta, seed=int(1000 * theta))
    assert radius.max() <= 1 + 1e-9
    assert norm.max() <= 1 + 1e-9


@pytest.mark.parametrize("theta", [0.0, 0.25, 0.49])
def test_below_one_half_the_same_test_fails(theta):
    radius, norm = worst(theta, seed=1)
    assert np.mean(radius > 1 + 1e-9) > 0.2
    assert np.mean(norm > 1 + 1e-9) > 0.2


def test_explicit_euler_diverges_where_damping_is_less_than_stiffness_times_dt():
    # det A = 1 - (c - k dt) dt / m: the counterexample of docs/stability.md.
    unit = jnp.ones((1, 1))
    for damping, grows in ((0.4, True), (0.6, False)):
        A = step(0.0, from_physical(unit, 10 * unit, damping * unit, 0 * unit)).A
        assert (spectral_radius(np.asarray(A))[0, 0] > 1) == grows


def test_zero_is_the_papers_step_exactly():
    rng = np.random.default_rng(2)
    w, k, c, rest = (jnp.asarray(rng.uniform(0, 5, (7, 2))) for _ in range(4))
    found = step(0.0, from_physical(w, k, c, rest))
    one, zero = jnp.ones_like(w), jnp.zeros_like(w)
    A = jnp.stack(
        [jnp.stack([one, DT * one], -1), jnp.stack([-(w * k * DT), 1 - w * c * DT], -1)], -2
    )
    np.testing.assert_array_equal(found.A, A)
    np.testing.assert_array_equal(found.B[:, 0, :, 0], jnp.stack([zero, w * DT], -1)[:, 0])
    np.testing.assert_array_equal(found.offset, jnp.stack([zero, w * k * DT * rest], -1))


def test_each_degree_of_freedom_takes_its_own_control():
    ones = jnp.ones((3, 2))
    B = ThetaMethod()(from_physical(ones, ones, ones, ones), DT, 2).B
    assert B.shape == (3, 2, 2, 2)
    assert np.all(B[:, 0, :, 0] > 0) and np.all(B[:, 1, :, 1] > 0)
    assert np.all(B[:, 0, :, 1] == 0) and np.all(B[:, 1, :, 0] == 0)


def exact(time: float, mass=2.0, stiffness=3.0, damping=0.7, rest=0.4, force=1.5) -> np.ndarray:
    """State at `time` of a spring-mass-damper that starts at 0.3 m and -0.2 m/s."""
    generator = np.zeros((3, 3))
    generator[0, 1] = 1
    generator[1] = [-stiffness / mass, -damping / mass, (stiffness * rest + force) / mass]
    return (scipy.linalg.expm(generator * time) @ [0.3, -0.2, 1.0])[:2]


def integrated(theta: float, steps: int, time: float) -> np.ndarray:
    one = jnp.ones((1, 1))
    linear = step(theta, from_physical(one / 2, 3 * one, 0.7 * one, 0.4 * one), time / steps)
    A, B, offset = (np.asarray(leaf)[0, 0] for leaf in (linear.A, linear.B, linear.offset))
    state = np.array([0.3, -0.2])
    for _ in range(steps):
        state = A @ state + B[:, 0] * 1.5 + offset
    return state


@pytest.mark.parametrize(("theta", "order"), [(0.0, 1), (0.5, 2), (0.6, 1), (0.75, 1), (1.0, 1)])
def test_order_of_convergence(theta, order):
    error = [np.linalg.norm(integrated(theta, steps, 2.0) - exact(2.0)) for steps in (400, 800)]
    assert abs(np.log2(error[0] / error[1]) - order) < 0.1


@pytest.mark.parametrize("substeps", [1, 2, 5, 10])
def test_a_constant_force_moves_a_body_as_that_many_symplectic_substeps_do(substeps):
    mass, force, start, velocity = 1.7, 2.3, 0.1, -0.4
    x, v = start, velocity
    for _ in range(substeps):
        v += force / mass * DT / substeps
        x += v * DT / substeps
    one, zero = jnp.ones((1, 1)), jnp.zeros((1, 1))
    linear = step((substeps + 1) / (2 * substeps), from_physical(one / mass, zero, zero, zero))
    moved = linear(start * one, velocity * one, jnp.array([force]))
    np.testing.assert_allclose(np.ravel(moved), [x, v], rtol=0, atol=1e-15)


def test_products_of_different_stable_steps_can_grow_but_not_at_random():
    """What docs/stability.md reports: a bound on each step is none on their product."""
    one, zero = jnp.ones((1, 1)), jnp.zeros((1, 1))
    A = [
        np.asarray(step(0.5, from_physical(one, stiffness * one, zero, zero)).A)[0, 0]
        for stiffness in (0.2, 200.0)
    ]
    assert max(spectral_radius(np.stack(A))) <= 1 + 1e-9
    # A quarter of a period of each in turn, the worst switching of a lossless oscillator.
    quarter = [round(np.pi / 2 / np.arccos(np.trace(each) / 2)) for each in A]
    product = np.linalg.matrix_power(A[1], quarter[1]) @ np.linalg.matrix_power(A[0], quarter[0])
    assert spectral_radius(product) > 10


@pytest.mark.parametrize("initial", [0.51, 0.55, 0.9])
def test_a_learned_theta_starts_where_told_and_stays_above_one_half(initial):
    method = ThetaMethod(initial)
    assert abs(float(method.theta) - initial) < 1e-12
    assert 0.5 <= float(jax.tree.map(lambda raw: raw - 100.0, method).theta) < 0.5001


@pytest.mark.parametrize(
    ("initial", "learned", "message"),
    [
        (0.5, True, "a learned theta must start within (0.5, 1), found 0.5"),
        (1.1, False, "theta must lie in [0, 1], found 1.1"),
        (float("nan"), False, "theta must lie in [0, 1], found nan"),
    ],
)
def test_a_theta_out_of_range_is_refused(initial, learned, message):
    with pytest.raises(InvalidInputError) as caught:
        ThetaMethod(initial, learned)
    assert message in str(caught.value)

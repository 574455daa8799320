"""The theta method: stable for theta >= 1/2, the paper's own step at 0, and of the right order."""

from functools import partial

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
    return ThetaMethod(theta, learned=False)(parameters, dt)


jitted_step = jax.jit(step, static_argnums=0)


def worst(theta: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Spectral radii and energy norms of all draws."""
    parameters = random_parameters(seed)
    A = np.asarray(jitted_step(theta, parameters).A)
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


@partial(jax.jit, static_argnums=0)
def body_step(theta: float, unit, k, c):
    return step(theta, from_physical(unit, k, c, 0 * unit))


def blocks(theta: float, stiffness_rate: np.ndarray, damping_rate: np.ndarray) -> np.ndarray:
    """A [n, 2, 2] of n bodies of 1 kg."""
    k, c = stiffness_rate[:, None], damping_rate[:, None]
    return np.asarray(body_step(theta, np.ones(k.shape), k, c).A)[:, 0]


def product_radii(theta: float, draw_stiffness, draw_damping, count: int = 1000) -> np.ndarray:
    """Spectral radii of products of 200 steps with new parameters in each."""
    product = np.tile(np.eye(2), (count, 1, 1))
    for _ in range(200):
        product = blocks(theta, draw_stiffness(count), draw_damping(count)) @ product
    return np.abs(np.linalg.eigvals(product)).max(axis=-1)


def test_products_shrink_in_energy_while_the_stiffness_rate_stays() -> None:
    rng = np.random.default_rng(0)
    rate = log_uniform(rng, (1000,), -2, 3)
    product = np.tile(np.eye(2), (1000, 1, 1))
    for theta in rng.choice([0.5, 0.6, 0.8, 1.0], 50):
        product = blocks(float(theta), rate, log_uniform(rng, (1000,))) @ product
        assert energy_norm(product, rate).max() <= 1 + 1e-9


@pytest.mark.parametrize(("theta", "growth"), [(0.5, 25), (0.6, 25), (1.0, 15)])
def test_switching_between_two_stable_springs_can_grow(theta, growth) -> None:
    """A bound on each step is none on the product: docs/stability.md."""
    soft, hard = blocks(theta, np.array([0.2, 200.0]), np.zeros(2))
    assert max(spectral_radius(np.stack([soft, hard]))) <= 1 + 1e-9
    # A quarter of a period of each in turn.
    product = np.linalg.matrix_power(hard, 2) @ np.linalg.matrix_power(soft, 70)
    assert spectral_radius(product) > growth


def test_random_products_shrink_if_damped_and_can_grow_if_not() -> None:
    """The observations that docs/stability.md reports, bounds loosened to hold for any seed."""
    rng = np.random.default_rng(0)

    def box(count):
        return rng.uniform(0, 5, count)

    def decades(count):
        return log_uniform(rng, (count,))

    assert product_radii(0.5, box, box).max() < 1e-2
    assert product_radii(0.5, np.zeros, decades).max() <= 1 + 1e-9
    assert np.median(product_radii(0.5, decades, decades)) > 1e6
    assert product_radii(1.0, decades, decades).max() < 1


@pytest.mark.parametrize("initial", [0.51, 0.55, 0.9])
def test_a_learned_theta_starts_as_given_and_stays_above_one_half(initial):
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

"""The one feedback law, on arrays of NumPy and of JAX."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control import AffinePolicy
from contactgraph.feedback import PlanFeedback


@pytest.mark.parametrize("state", [(6,), (20,), (2, 2, 3), (4, 2, 3)])
@pytest.mark.parametrize("steps", [(), (5,)])
def test_a_policy_multiplies_each_step_s_state_in_arrays_of_both_libraries(state, steps):
    rng = np.random.default_rng(0)
    k, K = rng.normal(size=(*steps, 2)), rng.normal(size=(*steps, 2, *state))
    x = rng.normal(size=(*steps, *state))
    flat = K.reshape(*steps, 2, -1), x.reshape(*steps, -1)
    expected = k + np.einsum("...un,...n->...u", *flat)
    ours = AffinePolicy(K, k)(x)
    assert isinstance(ours, np.ndarray)
    np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=1e-12)
    with jax.enable_x64(True):
        policy = AffinePolicy(jnp.asarray(K), jnp.asarray(k))
        jitted = jax.jit(lambda policy, x: policy(x))(policy, jnp.asarray(x))
        np.testing.assert_allclose(jitted, expected, rtol=1e-12, atol=1e-12)


def test_a_policy_around_a_reference_and_a_plan_with_its_gains_agree():
    rng = np.random.default_rng(1)
    states, controls = rng.normal(size=(4, 5, 2, 2)), rng.normal(size=(3, 2))
    gains = rng.normal(size=(3, 2, 5, 2, 2))
    policy = AffinePolicy.around(gains, states[:-1], controls)
    plan = PlanFeedback(states, controls, gains, dt=0.1)
    np.testing.assert_allclose(policy(states[:-1]), controls, rtol=1e-12, atol=1e-12)
    x = rng.normal(size=(5, 2, 2))
    for step in range(3):
        ours = plan.within(step, 0.0, x[:, 0], x[:, 1])
        now = AffinePolicy(policy.K[step], policy.k[step])
        np.testing.assert_allclose(ours, now(x), rtol=1e-12, atol=1e-12)


def test_the_module_does_not_import_jax():
    script = "import sys, contactgraph.feedback; sys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", script], check=True)

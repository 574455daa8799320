"""A, B and the next state against MuJoCo's own step, and its own finite differences of it.

Masses with weight, on springs and dampers, each on its own and in a chain.

MuJoCo's `discrete` integrator solves springs and dampers at the end of the step, which is theta 1.
Its older ones take dampers there but springs where the step begins. That is theta 1 too, with a
damper that is weaker by k dt: a spring taken at the end of the step damps by that much more.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_scenes import geometry_of

from contactgraph.dynamics.contacts import Contacts
from contactgraph.dynamics.free_bodies import FreeBodies
from contactgraph.model import ThetaMethod, from_physical, stack_state

pytestmark = pytest.mark.usefixtures("double_precision")

DT, N, D = 0.01, 3, 3
FORCE = np.array([0.7, -1.1, 0.4])
GRAVITY = np.array([0.5, -2.0, -9.8])
"""Along every axis, so that each counts."""
TOLERANCE = 1e-6
"""They differ by 2e-10, which is what finite differences are good to."""

SPRINGS_AT_THE_END = {"discrete": True, "Euler": False, "implicit": False, "implicitfast": False}
ANY = pytest.mark.parametrize("integrator", SPRINGS_AT_THE_END)


def simulation(xml: str, integrator: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    if integrator == "discrete" and not hasattr(mujoco.mjtIntegrator, "mjINT_DISCRETE"):
        pytest.skip(f"MuJoCo {mujoco.__version__} has no discrete integrator; 3.13 is the first")
    falling = " ".join(map(str, GRAVITY))
    option = f'<option timestep="{DT}" gravity="{falling}" integrator="{integrator}">'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco>{option}<flag contact="disable"/></option>{xml}</mujoco>'
    )
    return model, mujoco.MjData(model)


def slide(name: str, axis: int, stiffness: float, damping: float, rest: float) -> str:
    along = " ".join(str(float(axis == each)) for each in range(3))
    return (
        f'<joint name="{name}" type="slide" axis="{along}" stiffness="{stiffness}" '
        f'damping="{damping}" springref="{rest}"/>'
    )


def body(joints: str, mass: float, carried: str = "") -> str:
    return f'<body>{joints}<geom size="0.1" mass="{mass}"/>{carried}</body>'


def linearised(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """A [2nv, 2nv] and B [2nv, U] at the state and control of `data`; positions come first."""
    A, B = np.zeros((2 * model.nv, 2 * model.nv)), np.zeros((2 * model.nv, model.nu))
    mujoco.mjd_transitionFD(model, data, 1e-6, True, A, B, None, None)
    return A, B


def stepped(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """[2nv]: where one step leads."""
    mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel])


@ANY
@pytest.mark.parametrize("theta", [1.0, 0.9])
def test_every_mass_on_its_own_springs_and_dampers(integrator: str, theta: float) -> None:
    rng = np.random.default_rng(0)
    mass = rng.uniform(0.4, 3.0, N)
    stiffness, damping = rng.uniform(20.0, 90.0, (N, D)), rng.uniform(2.0, 9.0, (N, D))
    rest, position, velocity = rng.normal(size=(3, N, D))
    bodies = [
        body(
            "".join(
                slide(f"{n}{d}", d, stiffness[n, d], damping[n, d], rest[n, d]) for d in range(D)
            ),
            mass[n],
        )
        for n in range(N)
    ]
    # As in the model, one control reaches every node: motor d pulls at axis d of all of them.
    reaches = [
        f'<fixed name="u{d}">'
        + "".join(f'<joint joint="{n}{d}" coef="1"/>' for n in range(N))
        + "</fixed>"
        for d in range(D)
    ]
    motors = "".join(f'<motor tendon="u{d}"/>' for d in range(D))
    model, data = simulation(
        f"<worldbody>{''.join(bodies)}</worldbody><tendon>{''.join(reaches)}</tendon>"
        f"<actuator>{motors}</actuator>",
        integrator,
    )
    data.qpos[:], data.qvel[:], data.ctrl[:] = position.ravel(), velocity.ravel(), FORCE

    if not SPRINGS_AT_THE_END[integrator]:
        damping = damping - DT * stiffness
    inverse_mass = np.broadcast_to(1.0 / mass[:, None], (N, D))
    parameters = from_physical(*map(jnp.asarray, (inverse_mass, stiffness, damping, rest)))
    falling = jnp.broadcast_to(GRAVITY, (N, D))
    parameters = dataclasses.replace(parameters, acceleration=falling)
    step = ThetaMethod(theta, learned=False)(parameters, DT)
    # Into MuJoCo's order, in which all positions come first, through where each number ends up.
    index = np.arange(2 * N * D, dtype=float).reshape(2, N, D)
    order = np.asarray(stack_state(*map(jnp.asarray, index))).astype(int)
    A, B = linearised(model, data)
    ours_A, ours_B, offset = (np.asarray(each) for each in step.stacked())
    state = np.asarray(stack_state(jnp.asarray(position), jnp.asarray(velocity)))
    errors = [
        np.abs(ours_A - A[np.ix_(order, order)]).max(),
        np.abs(ours_B - B[order]).max(),
        np.abs(ours_A @ state + ours_B @ FORCE + offset - stepped(model, data)[order]).max(),
    ]
    if theta == 1.0:
        assert max(errors) < TOLERANCE
    else:
        assert min(errors) > 10 * TOLERANCE, "with another theta all three must tell"


@jax.jit
def moved(
    mass: jax.Array, law: dict[str, jax.Array], state: jax.Array, control: jax.Array
) -> jax.Array:
    """Places and speeds of a row of masses after a step; a force pulls at the last one."""
    pairs = jnp.stack([jnp.arange(N), jnp.arange(N) + 1], axis=1)
    places, speeds = (
        jnp.stack([jnp.array([0.0, *half]), jnp.zeros(N + 1)], axis=1)
        for half in (state[:N], state[N:])
    )
    nothing, along = jnp.zeros(N), jnp.array([1.0, 0.0])
    seen = geometry_of(places, speeds, pairs.T, DT, contact_distance=0.01)
    bodies = FreeBodies(
        mass=mass[:, None] * jnp.ones(2),
        velocity=speeds,
        ground_damper=jnp.zeros(N + 1),
        deceleration=jnp.zeros(N + 1),
        weight=(GRAVITY[0] * mass.at[0].set(0.0)[:, None] * along)[..., None],
        driving=jnp.zeros((N + 1, 2, 1)).at[-1, 0].set(1.0),
        push=jnp.zeros((N + 1, 2, 1)),
    )
    contacts = Contacts(
        geometry=seen.along(nothing + 1.0),
        **law,
        touching=nothing,
        displacing_fraction=nothing,
        acting=nothing + 1.0,
        bounce=nothing,
        friction=nothing,
        until_impact=nothing,
        pinned=nothing,
    )
    motion = contacts.solve(bodies, DT, None, rough=False)
    pulled = motion.acceleration + motion.response @ control
    speeds = speeds + motion.velocity_change + DT * pulled
    places = places + DT * speeds
    return jnp.concatenate([places[1:, 0], speeds[1:, 0]])


derivatives = jax.jit(jax.jacfwd(moved, (2, 3)))


@ANY
def test_a_chain_that_is_coupled(integrator: str) -> None:
    """Three masses in a row from a wall on, neighbours joined by springs and dampers."""
    rng = np.random.default_rng(1)
    mass = rng.uniform(0.4, 3.0, N)
    stiffness, damping, rest = rng.uniform((20.0, 2.0, 0.1), (90.0, 9.0, 0.3), (N, 3)).T
    position, velocity = np.cumsum(rng.uniform(0.1, 0.3, N)), rng.normal(size=N)
    # Each moves along the one before it: MuJoCo's coordinates are the distances of neighbours.
    # Of bodies that do not carry each other it forgets how a damper couples them.
    chain = ""
    for n in reversed(range(N)):
        chain = body(slide(str(n), 0, stiffness[n], damping[n], rest[n]), mass[n], chain)
    ends = "".join(f'<joint joint="{n}" coef="1"/>' for n in range(N))
    model, data = simulation(
        f'<worldbody>{chain}</worldbody><tendon><fixed name="end">{ends}</fixed></tendon>'
        '<actuator><motor tendon="end"/></actuator>',
        integrator,
    )
    data.qpos[:], data.qvel[:] = np.diff(position, prepend=0.0), np.diff(velocity, prepend=0.0)
    data.ctrl[:] = FORCE[:1]

    if not SPRINGS_AT_THE_END[integrator]:
        damping = damping - DT * stiffness
    masses = jnp.array([1e12, *mass])  # The wall is a body that nothing moves.
    law = {
        "damper": DT * jnp.asarray(damping),
        "spring": DT**2 * jnp.asarray(stiffness),
        "rest_length": jnp.asarray(rest),
    }
    state, control = jnp.asarray([*position, *velocity]), jnp.asarray(FORCE[:1])
    ours_A, ours_B = derivatives(masses, law, state, control)
    places = np.kron(np.eye(2), np.tril(np.ones((N, N))))  # From distances.
    A, B = linearised(model, data)
    A, B = places @ A @ np.linalg.inv(places), places @ B
    assert np.abs(A[N, -1]) > 10 * TOLERANCE, "what the last does must reach the first"
    np.testing.assert_allclose(ours_A, A, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(ours_B, B, rtol=0, atol=TOLERANCE)
    reached = places @ stepped(model, data)
    np.testing.assert_allclose(moved(masses, law, state, control), reached, rtol=0, atol=TOLERANCE)

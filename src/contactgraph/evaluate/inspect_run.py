"""What a model believes and which parameters it infers along a recorded run."""

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np

from contactgraph.data import Trajectory, pair_indices
from contactgraph.model import ContactDynamics, ContactSensor, ModelState
from contactgraph.model.follow import follow_run
from contactgraph.model.local_dynamics import SpringMassDamperDynamics
from contactgraph.model.model_fit import check_fit
from contactgraph.model.recording import Recording, number_type, recording
from contactgraph.model.spring_mass_damper import SpringMassDamper

_EXACT = ContactSensor()


@dataclass(frozen=True, eq=False)
class RunInsight:
    """One run of ``T`` steps, as a model sees it; entry t is about the step from t to t + 1."""

    edges: np.ndarray
    """[E, 2] the nodes of each edge."""
    belief: np.ndarray
    """[T, E] probability that each edge is active, predicted from state t."""
    parameters: SpringMassDamper | None
    """Each [T, N, D]. None where the model has no such parameters."""


def inspect_run(
    model: ContactDynamics,
    run: Trajectory,
    *,
    sensor: ContactSensor = _EXACT,
    measured: bool = True,
    node_capacity: int | None = None,
) -> RunInsight:
    """Goes along a run, predicting every step from the recorded state before it.

    ``measured``: whether recorded contacts correct the belief, as they do in closed loop.
    Raises `InvalidInputError` where model and run do not fit, or the run has more nodes than
    ``node_capacity`` (default: no padding).
    """
    check_fit(model, run.scene, run.control_size, "the run")
    count = run.scene.node_count
    capacity = count if node_capacity is None else node_capacity
    padded = recording(run, run.steps, capacity, number_type(model), measured)
    edges = pair_indices(count)
    belief, parameters = _along(model, padded, sensor)
    if parameters is not None:
        parameters = jax.tree.map(lambda leaf: np.asarray(leaf[:-1, :count]), parameters)
    return RunInsight(edges, np.asarray(belief)[:-1, : len(edges)], parameters)


@eqx.filter_jit
def _along(
    model: ContactDynamics, run: Recording, sensor: ContactSensor
) -> tuple[jax.Array, SpringMassDamper | None]:
    carried = follow_run(model, run, sensor)
    parameters = None
    if isinstance(model.local_dynamics, SpringMassDamperDynamics):
        states = ModelState(run.position, run.velocity, carried.now)
        parameters = jax.vmap(lambda state: model.parameters(state, run.nodes))(states)
    return carried.coming.probability, parameters

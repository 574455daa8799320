"""Who takes part in a task: what inference says of all demonstrations of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.control.learned_cost import Participant
from contactgraph.data import Dataset, InvalidInputError, pair_indices
from contactgraph.model import ContactSensor, StepModel
from contactgraph.model.follow import FollowedRun, follow_run
from contactgraph.model.model_fit import check_fit
from contactgraph.model.recording import Recording, number_type, recording

_EXACT = ContactSensor()


def follow_all(model: StepModel, demonstrations: Dataset) -> FollowedRun:
    """[runs, T, …] What the model infers along every run, padded to the longest and the largest.

    Contacts correct the beliefs where they were recorded. Raises `InvalidInputError`, naming the
    run, where one has no control or does not fit the model.
    """
    for number, run in enumerate(demonstrations):
        if run.control_size == 0:
            raise InvalidInputError(
                f"run {number}: control must have at least one axis, found none"
            )
        check_fit(model, run.scene, run.control_size, f"run {number}")
    steps = max(run.steps for run in demonstrations)
    capacity = max(run.scene.node_count for run in demonstrations)
    dtype = number_type(model)
    padded = [recording(run, steps, capacity, dtype, True) for run in demonstrations]
    return _followed(model, jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded))


def participants(demonstrations: Dataset, followed: FollowedRun) -> tuple[Participant, ...]:
    """What the runs tell of every node, by name; kept ones first, in the order of their contacts.

    An edge is active where its probability is above 1/2. The paper drops a node that is not
    actuated and has no active edge in any demonstration at any step. Raises `InvalidInputError`,
    naming the run, where nothing touches or a node that takes part is missing.
    """
    probability = np.asarray(followed.now.probability)
    joins: dict[str, list[float]] = {}
    seen: dict[str, int] = {}
    actuated: set[str] = set()
    for number, run in enumerate(demonstrations):
        count = run.scene.node_count
        pairs = pair_indices(count)
        active = probability[number, : run.steps + 1, : len(pairs)] > 0.5
        if not active.any():
            raise InvalidInputError(
                f"run {number}: contact is never made, as the model infers it; a demonstration "
                "must touch what it is about"
            )
        for node, name in enumerate(run.scene.node_name):
            seen[name] = seen.get(name, 0) + 1
            joins.setdefault(name, [])
            touching = active[:, (pairs == node).any(axis=1)].any(axis=1)
            if touching.any():
                joins[name].append(float(np.argmax(touching)) * run.scene.dt)
            if run.scene.actuated[node]:
                actuated.add(name)
    found = [
        Participant(
            name=name,
            actuated=name in actuated,
            runs=seen[name],
            active_runs=len(times),
            joins_s=float(np.median(times)) if times else None,
        )
        for name, times in joins.items()
    ]
    for each in found:
        _check_everywhere(each, demonstrations)
    return tuple(sorted(found, key=_in_order))


def _in_order(each: Participant) -> tuple[bool, bool, float]:
    joins = np.inf if each.joins_s is None else each.joins_s
    return not each.kept, not each.actuated, joins


def _check_everywhere(each: Participant, demonstrations: Dataset) -> None:
    if not each.kept or each.runs == len(demonstrations):
        return
    for number, run in enumerate(demonstrations):
        if each.name not in run.scene.node_name:
            raise InvalidInputError(
                f"run {number}: node_name must have {each.name!r}, which takes part in other runs; "
                f"found {', '.join(run.scene.node_name)}"
            )


@eqx.filter_jit
def _followed(model: StepModel, runs: Recording) -> FollowedRun:
    return jax.lax.map(lambda run: follow_run(model, run, _EXACT), runs)

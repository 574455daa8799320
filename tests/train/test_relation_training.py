import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.data import Dataset, pad_trajectories
from contactgraph.data.graph import pair_indices
from contactgraph.envs import RestPolicy, SpringsTask
from contactgraph.envs.episodes import collect
from contactgraph.envs.relation_tasks import SPRING_DT, SPRING_STIFFNESS
from contactgraph.identify import relation_facts
from contactgraph.model import HOLD, ModelConfig
from contactgraph.model.scene import on_device
from contactgraph.relations import relations, trajectory_belief
from contactgraph.train import TrainConfig, fit, initial_state


@pytest.fixture(scope="module")
def runs():
    return collect([SpringsTask], [RestPolicy()], 24, 0)


def test_the_unit_of_distances_is_their_median(runs):
    first, second = np.triu_indices(5, 1)
    apart = [np.linalg.norm(e.position[:, first] - e.position[:, second], axis=-1) for e in runs]
    found = relation_facts(Dataset(tuple(runs), {})).config.contact_distance
    assert found == pytest.approx(np.median(apart))


def test_training_without_labels_finds_stiffness_and_springs(runs):
    bare = [dataclasses.replace(each, contact=None) for each in runs]
    train, held_out = Dataset(tuple(bare[:20]), {}), Dataset(tuple(bare[20:]), {})
    model_config = ModelConfig(
        2, 0, SPRING_DT, contact_distance=1.0, width=16, edge_types=(HOLD,), node_types=("ball",)
    )
    config = TrainConfig(
        steps=100, batch_size=8, check_every=100, learning_rate=1e-2, rollout_from=0.0
    )
    fresh = relations(model_config, key=jax.random.key(0))
    checks = []
    result = fit(initial_state(fresh, config, 0), train, held_out, config, checks.append)
    assert checks[-1].terms["rollout"] == 0.0
    law = result.model.local_dynamics.message_passing
    found = jax.vmap(law.types[0])(jnp.array([0.5, 1.0, 1.5])) * law.share[0, 0, 0]
    np.testing.assert_allclose(found, SPRING_STIFFNESS, rtol=0.1)
    assert result.held_out_rmse_m < 0.2 * result.baselines.constant_velocity_rmse_m
    batch = on_device(pad_trajectories(bare[20:], contacts=False), np.dtype(np.float32))
    belief = jax.vmap(partial(trajectory_belief, result.model))(batch)
    believed = np.asarray(belief.probability) > 0.5
    first, second = pair_indices(5).T
    joined = [each.contact[0][first, second] for each in runs[20:]]
    assert np.mean(believed == np.stack(joined)) >= 0.975

"""A model composed of other parts; every part is a constructor argument.

Usage: python examples/06_compose_a_model.py

This one has three edge types (inactive, touch and hold, the last two with a message network each),
the paper's memoryless edges, coupled bodies, and a fixed discretization.
"""

import jax

from contactgraph.data import Dataset, split_by_trajectory
from contactgraph.envs import ExplorationPolicy, PickupExpert, PickupTask
from contactgraph.evaluate import collect, evaluate_open_loop
from contactgraph.model import (
    HOLD,
    TOUCH,
    Actuation,
    ArgmaxSample,
    ContactDynamics,
    ContactLaw,
    DistancePrior,
    InvariantFeatures,
    MemorylessEdges,
    MessagePassing,
    SmoothCutoff,
    SpringMassDamperDynamics,
    ThetaMethod,
    TypedMessagePassing,
)
from contactgraph.train import TrainConfig, fit, initial_state

DISTANCE, WIDTH, DT = 0.08, 16, 0.05  # m centre to centre where bodies touch, -, s
edges_key, output_key, *type_keys, head_key = jax.random.split(jax.random.key(0), 5)
features = InvariantFeatures(length=DISTANCE)


def messages(key: jax.Array) -> MessagePassing:
    return MessagePassing(features.node_size(2), features.edge_size(2), WIDTH, rounds=1, key=key)


model = ContactDynamics(
    inference=MemorylessEdges(messages(edges_key), edge_types=(TOUCH, HOLD), key=output_key),
    local_dynamics=SpringMassDamperDynamics(
        message_passing=TypedMessagePassing([messages(key) for key in type_keys]),
        head=ContactLaw(WIDTH, 2, length=DISTANCE, actuation=Actuation(2, 2, 2), key=head_key),
        discretization=ThetaMethod(0.55, learned=False),  # ten symplectic substeps: (n+1)/2n
    ),
    features=features,
    prior=DistancePrior(threshold=DISTANCE),
    cutoff=SmoothCutoff(inner=1.5 * DISTANCE, outer=2.5 * DISTANCE),
    sample=ArgmaxSample(),
    dt=DT,
    dimension=2,
    control_size=2,
)

policies = [PickupExpert(), PickupExpert(), ExplorationPolicy()]
train, held_out = split_by_trajectory(
    Dataset(tuple(collect([PickupTask], policies, 12, seed=0))), 0.2, 0
)
config = TrainConfig(
    steps=600, check_every=600, batch_size=16, learning_rate=5e-3, window_length=4, rollout_from=1.0
)  # no rollout loss, as in the first example
result = fit(initial_state(model, config, seed=0), train, held_out, config)

metrics = evaluate_open_loop(result.model, held_out)
own = 100 * metrics["n_step_rmse_moving_m"]
print(f"{result.status.value}; half a second ahead, bodies that move: {own:.2f} cm")
for name in ("constant_velocity", "standing_still", "frozen_contact"):
    print(f"  {name}: {100 * metrics[f'{name}_rmse_moving_m']:.2f} cm")

"""The preset `relations`: bodies that act on each other without contact."""

from jaxtyping import PRNGKeyArray

from contactgraph.model.collision import DistancePrior, NoCutoff
from contactgraph.model.contact_dynamics import ContactDynamics
from contactgraph.model.features import InvariantFeatures
from contactgraph.model.force_laws import ExpectedTypes, RelationDynamics
from contactgraph.model.presets import ModelConfig
from contactgraph.model.relations import StaticEdges

_EVERYWHERE = 1e9
"""Scale of the distance prior, m: 1/2 at every distance."""


def relations(config: ModelConfig, *, key: PRNGKeyArray) -> ContactDynamics:
    """Force laws along all pairs that last for a trajectory: see `RelationDynamics`.

    ``config.contact_distance`` [m] is the unit of distances, about that of the bodies. Hinges,
    planes and impacts do not act in it.
    """
    types = config.node_types or ("object", "actuated")
    features = InvariantFeatures(
        config.contact_distance, hinges=config.hinges, learned=False, types=types
    )
    return ContactDynamics(
        inference=StaticEdges(len(types), config.edge_types),
        local_dynamics=RelationDynamics(
            config.contact_distance, len(types), config.edge_types, config.width or 32, key=key
        ),
        features=features,
        prior=DistancePrior(0.0, _EVERYWHERE, _EVERYWHERE),
        cutoff=NoCutoff(),
        sample=ExpectedTypes(),
        dt=config.dt,
        dimension=config.dimension,
        control_size=config.control_size,
    )

"""Facts that recordings tell before training: actuation, sliding, impacts, shapes and units."""

from contactgraph.identify.facts import Facts as Facts
from contactgraph.identify.facts import Units as Units
from contactgraph.identify.facts import identify as identify
from contactgraph.identify.facts import in_units as in_units
from contactgraph.identify.facts import relation_facts as relation_facts
from contactgraph.identify.facts import scene_facts as scene_facts
from contactgraph.identify.free_motion import fit_actuation as fit_actuation
from contactgraph.identify.free_motion import fit_slowing as fit_slowing
from contactgraph.identify.free_motion import fit_theta as fit_theta
from contactgraph.identify.impacts import fit_impacts as fit_impacts

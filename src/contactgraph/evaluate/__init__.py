"""Running episodes, and the metrics over what was recorded."""

from contactgraph.evaluate.run_episode import collect as collect
from contactgraph.evaluate.run_episode import run_episode as run_episode

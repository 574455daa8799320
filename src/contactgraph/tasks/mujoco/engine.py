"""The one file that imports MuJoCo for simulation, and what is common to all that uses it."""

from contactgraph.data import InvalidInputError

try:
    import mujoco as mujoco
except ImportError as error:
    raise InvalidInputError("franka needs MuJoCo: pip install 'contactgraph[mujoco]'") from error

SIMULATOR = f"mujoco {mujoco.__version__}"
JOINTS = 7
"""Of the arm."""

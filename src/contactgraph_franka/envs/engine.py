"""The one file that imports MuJoCo for simulation, and what is common to all that uses it."""

import os

from contactgraph.data import InvalidInputError

try:
    import mujoco as mujoco
except ModuleNotFoundError as error:
    raise InvalidInputError("franka needs MuJoCo: pip install 'contactgraph[mujoco]'") from error
except (AttributeError, ImportError, RuntimeError) as error:
    # As it is imported it loads the OpenGL that it is told to, and fails in many ways.
    raise InvalidInputError(
        f"MuJoCo cannot load the OpenGL of MUJOCO_GL={os.environ.get('MUJOCO_GL')}: unset it, or "
        "name one that is there (egl, osmesa or glfw)"
    ) from error

SIMULATOR = f"mujoco {mujoco.__version__}"
JOINTS = 7
"""Of the arm."""

"""Boxes that turn in a vertical plane, on MuJoCo. Only this file imports it.

Each box has two slides and a hinge in the plane, x to the right and y up, above a floor at y = 0.
MuJoCo's contacts are springs with dampers. Here they are critically damped, with a time constant
of 0.7 ms for tosses: a corner that strikes the floor at 3 m/s enters it by 1 mm and leaves it at
about a tenth of its speed; a box at rest lies some um deep. Friction is Coulomb's, with elliptic
cones. MuJoCo's convex contacts lift what slides, so that it hops: with a twentieth of the time
constant as the substep by some 0.2 mm at 1 m/s, with a seventh by 0.5 mm.
"""

import math
import os
from collections.abc import Sequence

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.envs.planar.body import PlanarBody

try:
    import mujoco as mujoco
except ModuleNotFoundError as error:
    raise InvalidInputError(
        "MuJoCo is not installed: pip install 'contactgraph[mujoco]'"
    ) from error
except (AttributeError, ImportError, RuntimeError) as error:
    # MuJoCo loads OpenGL during its import.
    raise InvalidInputError(
        f"MuJoCo cannot load the OpenGL of MUJOCO_GL={os.environ.get('MUJOCO_GL')}: unset it, or "
        "name one that is there (egl, osmesa or glfw)"
    ) from error

SIMULATOR = f"mujoco {mujoco.__version__}"
GRAVITY = np.array([0.0, -9.81])
"""m/s^2"""
_FINENESS = 20
"""Substeps in the time constant of a contact, at least."""
_LOOK_EVERY = 10
"""Substeps from one look at contacts to the next; no impact is over in less."""
_HALF_DEPTH = 0.05
"""Half of every box's side across the plane, m; the same for all, so that faces meet in full."""


class VerticalWorld:
    """``N`` boxes above a floor, under gravity.

    ``dt`` s is the time that a call of `step` takes, ``contact_time`` s the time constant of
    contacts. Each box needs a ``half_size``; its ``friction`` counts, of two the larger one, and
    the floor has none of its own. Raises `InvalidInputError` for a body that is no box.
    """

    def __init__(self, boxes: Sequence[PlanarBody], dt: float, contact_time: float = 7e-4) -> None:
        self._looks = math.ceil(dt / contact_time * _FINENESS / _LOOK_EVERY)
        self.substeps = self._looks * _LOOK_EVERY
        """Equal parts of a step."""
        self._model = mujoco.MjModel.from_xml_string(_xml(boxes, dt / self.substeps, contact_time))
        self._data = mujoco.MjData(self._model)
        self._count = len(boxes)
        self._touched = np.zeros((self._count, self._count), dtype=bool)
        self._data.qpos[:] = np.ravel([[*box.position, box.angle] for box in boxes])
        self._data.qvel[:] = np.ravel([[*box.velocity, box.spin] for box in boxes])
        mujoco.mj_forward(self._model, self._data)
        self._look()

    @property
    def metadata(self) -> dict[str, str | int]:
        """Simulator and substeps, for a scene's metadata."""
        return {"simulator": SIMULATOR, "substeps": self.substeps}

    @property
    def position(self) -> np.ndarray:
        """``[N, 2]`` m, of the boxes' middles."""
        return self._data.qpos.reshape(self._count, 3)[:, :2].copy()

    @property
    def velocity(self) -> np.ndarray:
        """``[N, 2]`` m/s of the same points."""
        return self._data.qvel.reshape(self._count, 3)[:, :2].copy()

    @property
    def angle(self) -> np.ndarray:
        """``[N]`` rad, counter-clockwise, not wrapped."""
        return self._data.qpos[2::3].copy()

    @property
    def angular_velocity(self) -> np.ndarray:
        """``[N]`` rad/s."""
        return self._data.qvel[2::3].copy()

    @property
    def contact(self) -> np.ndarray:
        """``[N, N]`` bool, symmetric: pairs that touched at any time during the last step."""
        return self._touched.copy()

    def step(self, force: np.ndarray) -> None:
        """Advances by ``dt`` under a constant ``force`` ``[N, 2]`` N on the boxes' middles."""
        self._data.qfrc_applied.reshape(self._count, 3)[:, :2] = force
        self._touched[:] = False
        for _ in range(self._looks):
            mujoco.mj_step(self._model, self._data, _LOOK_EVERY)
            self._look()

    def _look(self) -> None:
        """Notes the pairs of boxes that MuJoCo has in contact; the floor is geometry 0."""
        if self._data.ncon and self._count > 1:
            first, second = self._data.contact.geom.T - 1
            boxes = (first >= 0) & (second >= 0)
            self._touched[first[boxes], second[boxes]] = True
            self._touched[second[boxes], first[boxes]] = True


def _xml(boxes: Sequence[PlanarBody], substep: float, contact_time: float) -> str:
    """The MJCF of the world; times in s."""
    bodies = []
    for box in boxes:
        if box.half_size is None:
            raise InvalidInputError("a body of a vertical world must be a box, found a disc")
        width, height = box.half_size
        bodies.append(
            "<body><joint type='slide' axis='1 0 0'/><joint type='slide' axis='0 1 0'/>"
            f"<joint type='hinge' axis='0 0 1'/><geom type='box' mass='{box.mass}' "
            f"size='{width} {height} {_HALF_DEPTH}' friction='{box.friction} 0 0'/></body>"
        )
    return (
        f"<mujoco><option timestep='{substep}' gravity='{GRAVITY[0]} {GRAVITY[1]} 0' "
        "cone='elliptic' impratio='10'/>"
        f"<default><geom solref='{contact_time} 1' solimp='0.95 0.99 0.0001'/></default>"
        "<worldbody><geom type='plane' size='5 5 1' zaxis='0 1 0' friction='0 0 0'/>"
        f"{''.join(bodies)}</worldbody></mujoco>"
    )

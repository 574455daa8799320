"""A disc or a box of a `PlanarWorld`: its shape, its mass and the laws of its contacts."""

from dataclasses import dataclass, field

import numpy as np

from contactgraph.data.errors import InvalidInputError

GRAVITY = 9.81
"""m/s^2, of the friction with the ground."""


@dataclass(frozen=True, eq=False)
class PlanarBody:
    """A disc or a box in the plane.

    Raises `InvalidInputError` where a number is out of range, or where not exactly one of
    ``radius`` and ``half_size`` is given.
    """

    position: np.ndarray
    """[2] m, of its middle."""
    mass: float
    """kg, spread evenly; without meaning for a static body."""
    radius: float | None = None
    """Of a disc, m."""
    half_size: np.ndarray | None = None
    """[2] of a box, m; its corners are rounded by 0.3 mm."""
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """[2] m/s at the start, of its middle."""
    angle: float = 0.0
    """rad at the start, counter-clockwise."""
    angular_velocity: float = 0.0
    """rad/s at the start, of a body that rotates; a hinged one turns as ``velocity`` says."""
    static: bool = False
    """Whether it never moves."""
    anchor: np.ndarray | None = None
    """[2] m: a hinge about which it turns freely, its only motion. None: none."""
    rotates: bool = False
    """Whether a body without a hinge may turn."""
    restitution: float = 0.0
    """In [0, 1]; of two bodies the larger counts, and of a wall the body's."""
    friction: float = 0.0
    """Coulomb's coefficient between bodies; of two bodies the geometric mean counts."""
    ground_friction: float = 0.0
    """Coulomb's coefficient with the ground that a body slides on, which cannot rotate."""
    damping: float = 0.0
    """1/s, of the velocity and the angular velocity: v' = -damping v."""
    group: int = 0
    """Bodies of the same negative group pass through one another."""

    def __post_init__(self) -> None:
        if (self.radius is None) == (self.half_size is None):
            raise InvalidInputError("a body needs either a radius or a half_size")
        size = self.size
        for name, valid, good in [
            ("mass", "above 0 kg", self.mass > 0.0),
            ("size", "at least 0.001 m", bool(np.all(size >= 1e-3))),
            ("restitution", "in 0 to 1", 0.0 <= self.restitution <= 1.0),
            ("friction", "at least 0", self.friction >= 0.0),
            ("ground_friction", "at least 0", self.ground_friction >= 0.0),
            ("damping", "at least 0 1/s", self.damping >= 0.0),
        ]:
            if not good:
                found = size.tolist() if name == "size" else getattr(self, name)
                raise InvalidInputError(f"{name} of a body must be {valid}, found {found}")
        if self.ground_friction and (self.static or self.rotates or self.anchor is not None):
            raise InvalidInputError("ground_friction is for bodies that move and cannot rotate")

    @property
    def size(self) -> np.ndarray:
        """[1] m, the radius, or [2] m, the half size."""
        size = np.nan if self.half_size is None else self.half_size
        return np.ravel(np.asarray(size if self.radius is None else self.radius, dtype=np.float64))

    @property
    def arm(self) -> np.ndarray:
        """[2] m, from the hinge to the middle in the body's frame; zeros without a hinge."""
        x, y = np.zeros(2) if self.anchor is None else np.asarray(self.position) - self.anchor
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return np.array([cos * x + sin * y, cos * y - sin * x])

    @property
    def inertia(self) -> float:
        """kg m^2, about the hinge, else about the middle."""
        own = float(self.size @ self.size) / (3.0 if self.radius is None else 2.0)
        return self.mass * (own + float(self.arm @ self.arm))

    @property
    def spin(self) -> float:
        """rad/s at the start; of a hinged body by the velocity of its middle."""
        if self.anchor is None:
            return self.angular_velocity if self.rotates else 0.0
        arm = np.asarray(self.position) - self.anchor
        return float(arm[0] * self.velocity[1] - arm[1] * self.velocity[0]) / float(arm @ arm)

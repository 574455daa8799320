"""One trajectory of a scene with the model's beliefs and parameters."""

from dataclasses import dataclass

import numpy as np

from contactgraph.data import InvalidInputError, Scene, Trajectory
from contactgraph.evaluate import model_diagnostics
from contactgraph.model import ContactDynamics
from contactgraph.viz.projection import Projection, projection_of

_DEFAULT_RADIUS = 0.04
_DEFAULT_GOAL_RADIUS = 0.1


@dataclass(frozen=True, eq=False)
class SceneTrajectory:
    """A drawn trajectory: ``T`` steps, ``N`` nodes, ``D`` degrees of freedom, ``E`` edges.

    Pictures show the first three degrees of freedom; see `projection`. Numbers that are not finite
    are drawn as gaps.
    Raises `InvalidInputError` where a shape does not fit.
    """

    name: str
    """The label, e.g. ``"3 distractors"``."""
    dt: float
    """Time between two steps, s."""
    node_name: tuple[str, ...]
    """[N]"""
    node_type: tuple[str, ...]
    """[N]"""
    actuated: np.ndarray
    """[N] bool: nodes on which the control acts; the force is drawn there."""
    radius: np.ndarray
    """[N] m; for nodes with a size, the thickness of edges and arrows."""
    position: np.ndarray
    """[T+1, N, D] m, D >= 2."""
    velocity: np.ndarray
    """[T+1, N, D] m/s."""
    control: np.ndarray
    """[T, U] N, component d along degree of freedom d; drawn as an arrow where U >= 2."""
    edges: np.ndarray
    """[E, 2] int: the two nodes of each edge."""
    belief: np.ndarray
    """[T, E] probability that the edge is active in step ``t``, which leads from state t to t+1."""
    goal: np.ndarray | None = None
    """[D] m"""
    goal_radius: float = _DEFAULT_GOAL_RADIUS
    """m: radius of the goal region."""
    contact: np.ndarray | None = None
    """[T+1, E] bool: true contact at each state. None: not known."""
    inverse_mass: np.ndarray | None = None
    """[T, N, D] 1/kg, learned."""
    stiffness: np.ndarray | None = None
    """[T, N, D] k/m, 1/s^2, learned."""
    damping: np.ndarray | None = None
    """[T, N, D] c/m, 1/s, learned."""
    plan: np.ndarray | None = None
    """[T, H+1, N, D] m: planned positions by the plan of step t; NaN without a plan."""
    anchor: np.ndarray | None = None
    """[N, D] m: hinge of a node, NaN without one; see `bar`. None: no node has one."""
    size: np.ndarray | None = None
    """[N, D] m: sides of a box drawn instead of a ball; NaN for a ball. None: only balls."""
    link_positions: np.ndarray | None = None
    """[T+1, P, D] m: joints of a drawn body that is no node. None: there is none."""

    def __post_init__(self) -> None:
        for name in ("radius", "position", "velocity", "control", "belief"):
            self._set(name, np.asarray(getattr(self, name), dtype=np.float64))
        self._set("actuated", np.asarray(self.actuated, dtype=bool))
        self._set("edges", np.asarray(self.edges, dtype=np.int64).reshape(-1, 2))
        optional = ("goal", "inverse_mass", "stiffness", "damping", "plan", "anchor", "size")
        for name in (*optional, "link_positions"):
            if getattr(self, name) is not None:
                self._set(name, np.asarray(getattr(self, name), dtype=np.float64))
        if self.contact is not None:
            self._set("contact", np.asarray(self.contact, dtype=bool))
        self._check()

    def _set(self, name: str, value: np.ndarray) -> None:
        object.__setattr__(self, name, value)

    def _check(self) -> None:
        shape = self.position.shape
        if len(shape) != 3 or shape[0] < 2 or shape[1] < 1 or shape[2] < 2:
            raise InvalidInputError(
                f"scene {self.name!r}: position must have shape (T+1, N, D) with T >= 1, N >= 1 "
                f"and D >= 2, found {shape}"
            )
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InvalidInputError(
                f"scene {self.name!r}: dt must be a positive number of seconds, found {self.dt}"
            )
        steps, nodes, dimension = self.steps, self.node_count, self.dimension
        shapes = {
            "actuated": (nodes,),
            "radius": (nodes,),
            "velocity": (steps + 1, nodes, dimension),
            "control": (steps, *self.control.shape[1:2]),
            "belief": (steps, self.edge_count),
            "goal": (dimension,),
            "contact": (steps + 1, self.edge_count),
            "anchor": (nodes, dimension),
            "size": (nodes, dimension),
            "inverse_mass": (steps, nodes, dimension),
            "stiffness": (steps, nodes, dimension),
            "damping": (steps, nodes, dimension),
        }
        if self.plan is not None:
            shapes["plan"] = (steps, *self.plan.shape[1:2], nodes, dimension)
        if self.link_positions is not None:
            shapes["link_positions"] = (steps + 1, *self.link_positions.shape[1:2], dimension)
        for name, valid in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != valid:
                raise InvalidInputError(
                    f"scene {self.name!r}: {name} must have shape {valid}, found {value.shape}"
                )
        for name in ("node_name", "node_type"):
            if len(getattr(self, name)) != nodes:
                raise InvalidInputError(
                    f"scene {self.name!r}: {name} must have one entry a node ({nodes}), "
                    f"found {len(getattr(self, name))}"
                )
        if self.edges.size and (self.edges.min() < 0 or self.edges.max() >= nodes):
            raise InvalidInputError(f"scene {self.name!r}: edges must name nodes 0 to {nodes - 1}")

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return self.position.shape[0] - 1

    @property
    def node_count(self) -> int:
        """N, the number of nodes."""
        return self.position.shape[1]

    @property
    def dimension(self) -> int:
        """D, degrees of freedom a node."""
        return self.position.shape[2]

    @property
    def half_size(self) -> np.ndarray:
        """[N, D] m: half extent of each node along every degree of freedom, box or ball."""
        ball = np.broadcast_to(self.radius[:, None], (self.node_count, self.dimension))
        return ball if self.size is None else np.where(np.isnan(self.size), ball, 0.5 * self.size)

    @property
    def half_picture(self) -> np.ndarray:
        """[N, 2] m: half extent of each node to the right and up in the picture, box or ball."""
        ball = np.broadcast_to(self.radius[:, None], (self.node_count, 2))
        if self.size is None:
            return ball
        return np.where(np.isnan(self.size[:, :1]), ball, self.projection.half_extent(self.size))

    @property
    def projection(self) -> Projection:
        """The view: from above in 2D, from the side in 3D."""
        return projection_of(self.dimension)

    def box(self, node: int) -> np.ndarray | None:
        """[D] m: the sides of a node that is a box; None for any other node."""
        if self.size is None or not np.isfinite(self.size[node]).all():
            return None
        return self.size[node]

    @property
    def edge_count(self) -> int:
        """E, the number of edges."""
        return self.edges.shape[0]

    def bar(self, node: int) -> np.ndarray | None:
        """[T+1, 2, D] m: hinge and tip of a node on a hinge; None for any other node.

        Its position is the bar's middle, its radius half the bar's thickness.
        """
        if self.anchor is None or not np.isfinite(self.anchor[node]).all():
            return None
        hinge = np.broadcast_to(self.anchor[node], (self.steps + 1, self.dimension))
        return np.stack([hinge, 2.0 * self.position[:, node] - hinge], axis=1)

    def edge_name(self, edge: int) -> str:
        """The names of an edge's two nodes."""
        first, second = self.edges[edge]
        return f"{self.node_name[first]} and {self.node_name[second]}"

    @classmethod
    def from_trajectory(
        cls,
        name: str,
        trajectory: Trajectory,
        edges: np.ndarray,
        belief: np.ndarray,
        *,
        inverse_mass: np.ndarray | None = None,
        stiffness: np.ndarray | None = None,
        damping: np.ndarray | None = None,
        plan: np.ndarray | None = None,
    ) -> "SceneTrajectory":
        """A recorded trajectory with a model's estimates; see the fields for shapes and units.

        Where the scene has no radius, balls of 0.04 m are drawn, or less where boxes are thinner.
        The goal radius is ``goal_radius`` m in its metadata, or 0.1 m.
        """
        scene = trajectory.scene
        edges = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
        contact = trajectory.contact
        return cls(
            name=name,
            dt=scene.dt,
            node_name=scene.node_name,
            node_type=scene.node_type,
            actuated=scene.actuated,
            radius=_default_radius(scene) if scene.radius is None else scene.radius,
            position=trajectory.position,
            velocity=trajectory.velocity,
            control=trajectory.control,
            edges=edges,
            belief=belief,
            goal=scene.goal,
            goal_radius=_goal_radius(scene),
            contact=None if contact is None else contact[:, edges[:, 0], edges[:, 1]],
            inverse_mass=inverse_mass,
            stiffness=stiffness,
            damping=damping,
            plan=plan,
            anchor=scene.anchor,
            size=scene.size,
            link_positions=trajectory.link_positions,
        )


def _default_radius(scene: Scene) -> np.ndarray:
    sides = np.array([]) if scene.size is None else scene.size[np.isfinite(scene.size)]
    return np.full(scene.node_count, np.min(0.5 * sides, initial=_DEFAULT_RADIUS))


def _goal_radius(scene: Scene) -> float:
    radius = scene.metadata.get("goal_radius")
    if isinstance(radius, int | float) and np.isfinite(radius) and radius > 0:
        return float(radius)
    return _DEFAULT_GOAL_RADIUS


def scene_trajectory(
    model: ContactDynamics, name: str, trajectory: Trajectory, plan: np.ndarray | None = None
) -> SceneTrajectory:
    """A trajectory with the model's beliefs, corrected by measured contacts, and parameters.

    ``plan`` [T, H+1, N, D] m holds the positions that a controller planned at each step.
    """
    insight = model_diagnostics(model, trajectory)
    learned = insight.parameters
    return SceneTrajectory.from_trajectory(
        name,
        trajectory,
        insight.edges,
        insight.belief,
        inverse_mass=None if learned is None else np.asarray(learned.inverse_mass),
        stiffness=None if learned is None else np.asarray(learned.stiffness_rate),
        damping=None if learned is None else np.asarray(learned.damping_rate),
        plan=plan,
    )

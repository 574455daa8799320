"""One trajectory of a scene with the model's beliefs and parameters."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Trajectory,
    pair_indices,
    with_edge_labels,
)
from contactgraph.evaluate import model_diagnostics
from contactgraph.model import ContactDynamics
from contactgraph.viz.projection import Projection, projection_of

_DEFAULT_RADIUS = 0.04
_DEFAULT_GOAL_RADIUS = 0.1


@dataclass(frozen=True, eq=False)
class SceneTrajectory:
    """A drawn trajectory: ``T`` steps, ``N`` nodes, ``D`` degrees of freedom, ``E`` edges.

    Pictures show the first three degrees of freedom; see `projection`. Beliefs, parameters and
    plans that are not finite are drawn as gaps.
    Raises `InvalidInputError` where a shape does not fit.
    """

    name: str
    """The label, e.g. ``"3 distractors"``."""
    trajectory: Trajectory
    """D >= 2. Its control is drawn as an arrow at actuated nodes, where it is a force: see
    `force_size`."""
    edges: np.ndarray
    """[E, 2] int: the two nodes of each edge."""
    belief: np.ndarray
    """[T, E] probability that the edge is active in step ``t``, which leads from state t to t+1."""
    inverse_mass: np.ndarray | None = None
    """[T, N, D] 1/kg, learned."""
    stiffness: np.ndarray | None = None
    """[T, N, D] k/m, 1/s^2, learned."""
    damping: np.ndarray | None = None
    """[T, N, D] c/m, 1/s, learned."""
    plan: np.ndarray | None = None
    """[T, H+1, N, D] m: planned positions by the plan of step t; NaN without a plan."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", np.asarray(self.edges, dtype=np.int64).reshape(-1, 2))
        steps, nodes, dimension = self.steps, self.node_count, self.dimension
        if dimension < 2:
            raise InvalidInputError(f"scene {self.name!r}: D must be at least 2, found {dimension}")
        if self.edges.size and (self.edges.min() < 0 or self.edges.max() >= nodes):
            raise InvalidInputError(f"scene {self.name!r}: edges must name nodes 0 to {nodes - 1}")
        parameters = ("inverse_mass", "stiffness", "damping")
        shapes: dict[str, tuple[int, ...]] = {"belief": (steps, self.edge_count)}
        shapes |= dict.fromkeys(parameters, (steps, nodes, dimension))
        if self.plan is not None:
            shapes["plan"] = (steps, *self.plan.shape[1:2], nodes, dimension)
        for name, valid in shapes.items():
            if getattr(self, name) is None:
                continue
            value = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, value)
            if value.shape != valid:
                raise InvalidInputError(
                    f"scene {self.name!r}: {name} must have shape {valid}, found {value.shape}"
                )

    def __repr__(self) -> str:
        return f"SceneTrajectory({self.name!r}, {self.trajectory!r}, E={self.edge_count})"

    @property
    def position(self) -> np.ndarray:
        """[T+1, N, D] m."""
        return self.trajectory.position

    @property
    def link_positions(self) -> np.ndarray | None:
        """[T+1, P, D] m: joints of a drawn body that is no node. None: there is none."""
        return self.trajectory.link_positions

    @property
    def node_name(self) -> tuple[str, ...]:
        """[N]"""
        return self.trajectory.scene.node_name

    @property
    def actuated(self) -> np.ndarray:
        """[N] bool: nodes on which the control acts."""
        return self.trajectory.scene.actuated

    @property
    def goal(self) -> np.ndarray | None:
        """[D] m"""
        return self.trajectory.scene.goal

    @property
    def time(self) -> np.ndarray:
        """[T+1] s"""
        return np.arange(self.steps + 1) * self.dt

    @property
    def dt(self) -> float:
        """Time between two steps, s."""
        return self.trajectory.scene.dt

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return self.trajectory.steps

    @property
    def node_count(self) -> int:
        """N, the number of nodes."""
        return self.trajectory.scene.node_count

    @property
    def dimension(self) -> int:
        """D, degrees of freedom a node."""
        return self.trajectory.scene.dimension

    @property
    def edge_count(self) -> int:
        """E, the number of edges."""
        return self.edges.shape[0]

    @property
    def force_size(self) -> int:
        """U where the first D components of the control are forces, else 0."""
        kinds = self.trajectory.scene.control_kind
        other = set(kinds[: self.dimension]) - {"force"} if kinds else set()
        return 0 if other else self.trajectory.control_size

    @cached_property
    def contact(self) -> np.ndarray | None:
        """[T+1, E] bool: true label of each edge at each state. None: not known."""
        contact = self.trajectory.contact
        return None if contact is None else contact[:, self.edges[:, 0], self.edges[:, 1]]

    @cached_property
    def radius(self) -> np.ndarray:
        """[N] m: of balls; half the thickness of bars, edges and arrows.

        Where it is not known, 0.04 m, or less where boxes, or a node's outlines, are thinner.
        """
        scene = self.trajectory.scene
        if scene.radius is not None:
            return scene.radius
        sides = scene.size[np.isfinite(scene.size)]
        radius = np.full(self.node_count, np.min(0.5 * sides, initial=_DEFAULT_RADIUS))
        for node in range(self.node_count):
            for outline in scene.outlines_of(node):
                radius[node] = min(radius[node], 0.5 * np.ptp(outline, axis=0).min())
        return radius

    @property
    def goal_radius(self) -> float:
        """m: radius of the goal region, ``goal_radius`` in the scene's metadata, or 0.1."""
        radius = self.trajectory.scene.metadata.get("goal_radius")
        if isinstance(radius, int | float) and np.isfinite(radius) and radius > 0:
            return float(radius)
        return _DEFAULT_GOAL_RADIUS

    @property
    def half_size(self) -> np.ndarray:
        """[N, D] m: half extent of each node along every degree of freedom, box or ball."""
        ball = np.broadcast_to(self.radius[:, None], (self.node_count, self.dimension))
        size = self.trajectory.scene.size
        return np.where(np.isnan(size), ball, 0.5 * size)

    @property
    def half_picture(self) -> np.ndarray:
        """[N, 2] m: half extent of each node to the right and up in the picture, box or ball."""
        ball = np.broadcast_to(self.radius[:, None], (self.node_count, 2))
        size = self.trajectory.scene.size
        return np.where(np.isnan(size[:, :1]), ball, self.projection.half_extent(size))

    @property
    def projection(self) -> Projection:
        """The view: from above in 2D, from the side in 3D."""
        return projection_of(self.dimension)

    def box(self, node: int) -> np.ndarray | None:
        """[D] m: the sides of a node that is a box; None for any other node."""
        size = self.trajectory.scene.size
        return None if np.isnan(size[node]).any() else size[node]

    def bar(self, node: int) -> np.ndarray | None:
        """[T+1, 2, D] m: hinge and tip of a node on a hinge; None for any other node.

        Its position is the bar's middle, its radius half the bar's thickness.
        """
        scene = self.trajectory.scene
        if not scene.hinged[node]:
            return None
        hinge = np.broadcast_to(scene.anchor[node], (self.steps + 1, self.dimension))
        return np.stack([hinge, 2.0 * self.position[:, node] - hinge], axis=1)

    def edge_name(self, edge: int) -> str:
        """The names of an edge's two nodes."""
        first, second = self.edges[edge]
        return f"{self.node_name[first]} and {self.node_name[second]}"


def scene_trajectory(
    model: ContactDynamics, name: str, trajectory: Trajectory, plan: np.ndarray | None = None
) -> SceneTrajectory:
    """A trajectory `with_edge_labels`, the model's beliefs, corrected by them, and parameters.

    ``plan`` [T, H+1, N, D] m holds the positions that a controller planned at each step.
    """
    (trajectory,) = with_edge_labels(Dataset((trajectory,)))
    diagnostics = model_diagnostics(model, trajectory)
    learned = {}
    if diagnostics.parameters is not None:
        learned = {
            "inverse_mass": np.asarray(diagnostics.parameters.inverse_mass),
            "stiffness": np.asarray(diagnostics.parameters.stiffness_rate),
            "damping": np.asarray(diagnostics.parameters.damping_rate),
        }
    return SceneTrajectory(
        name, trajectory, diagnostics.edges, diagnostics.belief, plan=plan, **learned
    )


def recorded_scene(name: str, trajectory: Trajectory) -> SceneTrajectory:
    """A trajectory with its recorded contacts in place of a model's beliefs."""
    edges = pair_indices(trajectory.scene.node_count)
    belief = np.zeros((trajectory.steps, len(edges)))
    if trajectory.contact is not None:
        belief = trajectory.contact[1:, edges[:, 0], edges[:, 1]].astype(np.float64)
    return SceneTrajectory(name, trajectory, edges, belief)

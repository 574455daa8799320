"""The contracts of tasks and policies, and the cost that a task has."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene

Observation = dict[str, np.ndarray]
"""One step of a task.

=============  ==========  ========  ====================================================
key            shape       unit
=============  ==========  ========  ====================================================
``position``   ``[N, D]``  m
``velocity``   ``[N, D]``  m/s
``contact``    ``[N, N]``  0 or 1    int8, symmetric, zero diagonal: touching or holding
``goal``       ``[D]``     m
=============  ==========  ========  ====================================================

A task may observe more, and then does so at every step:

====================  =============  ========  ==================================================
key                   shape          unit
====================  =============  ========  ==================================================
``holding``           ``[N, N]``     0 or 1    as ``contact``, which it implies: tied together
``orientation``       ``[N, 1]``     rad       in space ``[N, 4]``, unit quaternions (w, x, y, z)
``angular_velocity``  ``[N, 1]``     rad/s     in space ``[N, 3]``, in the world's axes
====================  =============  ========  ==================================================
"""


class Task(Protocol):
    """A Gymnasium environment in which a control moves nodes that may touch.

    A task is a `gymnasium.Env` whose observation is an `Observation`, whose action is the control
    ``[U]`` N in a bounded `gymnasium.spaces.Box`, and which has the members below. A control
    outside the box acts as the nearest one inside. The same seed gives the same episode to the
    last bit. `check_task` tests all of this on any task.
    """

    observation_space: gymnasium.spaces.Space[Any]
    action_space: gymnasium.spaces.Space[Any]
    max_steps: int
    """T, the steps after which an episode is truncated."""

    @property
    def scene(self) -> Scene:
        """The current episode's scene, known from `reset` on."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode; returns the first observation and an info dict."""

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advances by ``scene.dt``: observation, reward, terminated, truncated, info."""

    def success(self) -> bool:
        """Whether the episode has ended as the task demands."""

    def cost_terms(self) -> "ChainCost":
        """The task as a cost, in plain numbers."""


@runtime_checkable
class Renderable(Protocol):
    """An optional extension of `Task`: a body to draw that is no node, such as an arm."""

    def link_positions(self) -> np.ndarray:
        """[P, D] m: the body's current points, to be joined by lines in their order.

        ``P``, at least 2, never changes.
        """


@runtime_checkable
class ScoredTask(Protocol):
    """A task that also tells how well an episode has gone, the more the better."""

    def best_score(self) -> float | None:
        """The best of all steps of the episode. None: it has no scores."""


@runtime_checkable
class DisturbableTask(Protocol):
    """A task whose goal may be moved, and whose bodies may be pushed, within an episode."""

    def move_goal(self, goal: np.ndarray) -> None:
        """``goal`` ``[D]`` m is the scene's from now on."""

    def disturb(self, force: np.ndarray) -> None:
        """Adds ``force`` ``[N, D]`` N on the nodes to all that acts in the next step."""


class Policy(Protocol):
    """A controller of a task."""

    def reset(self, scene: Scene, seed: int) -> None:
        """Prepares for an episode in ``scene``; all randomness comes from ``seed``."""

    def __call__(self, observation: Observation) -> np.ndarray:
        """The control ``[U]`` N for the coming step; the task clips it to its bounds."""


PolicyFactory = Callable[[], Policy]
"""A class of policies, or a function that makes one."""
Conditions = tuple[tuple[str, Mapping[str, Any]], ...]
"""Scenes of a task to test models in, by name and options."""

Feedback = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
"""The control ``[U]`` N within a step, from what part of it has passed, in [0, 1), and from
position and velocity ``[N, D]`` m, m/s at that moment."""


@runtime_checkable
class FeedbackTask(Protocol):
    """A task whose control may change within a step, at the rate of its plant's controller."""

    def step_under(
        self, feedback: Feedback
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """As `Task.step`; ``info["control"]`` ``[U]`` N is the mean of what was applied."""


@runtime_checkable
class FeedbackPolicy(Protocol):
    """A policy that also reacts to the motion within a step."""

    def feedback(self) -> Feedback:
        """The feedback for the step of its last control."""


@runtime_checkable
class InformedPolicy(Protocol):
    """A policy that uses the control that the task really applied."""

    def applied(self, control: np.ndarray) -> None:
        """Receives after every step the mean control ``[U]`` N that the task applied."""


@dataclass(frozen=True, eq=False)
class ChainCost:
    r"""A quadratic cost that ties nodes together, one after the other, and the last to the goal.

    With $s_n$ the state (position, velocity) of node $n$ and $s_g$ the goal at
    rest, a step costs

    $$ \sum_{(n, m)\,\text{along chain}} \|s_n - s_m\|^2_{pick}
       + \|s_{last} - s_g\|^2_{goal} + w_u \|u\|^2. $$

    Raises `InvalidInputError` where shapes do not fit or a weight is negative.
    """

    chain: tuple[int, ...]
    """Node indices, e.g. gripper, first object, second object."""
    pick_weights: np.ndarray
    """[2D] on the difference of neighbours: D for position (1/m^2), then D for velocity."""
    goal_weights: np.ndarray
    """[2D] on the difference of the last node and the goal at rest."""
    control_weight: float
    """On the squared control, 1/N^2."""
    command_weight: float | None = None
    """On the squares of its components beyond D, such as a switch. None: `control_weight`."""
    terminal_weight: float = 1.0
    """Factor on the cost of the last state of a plan: where only the end counts."""
    switching_cost: float = 0.0
    """Added each time that a plan changes a command: against chattering."""
    goal_angle: float | None = None
    """rad; of the last node at the goal, any turns of 2 pi from it. None: any angle."""
    angle_weight: float = 0.0
    """On the squared difference of its angle from there, 1/rad^2."""
    candidates: tuple[int, ...] = ()
    """Nodes, the same in all scenes, of which any may stand in the chain's last place, where it is
    not known which one can be carried; the controller tries them. Empty: the last node alone."""
    placed_radius: float = 0.0
    """m; nothing is left to be picked up, and `pick_weights` count as 0, while the last node is
    nearer to the goal: otherwise what has put it down would go on touching it."""

    def __post_init__(self) -> None:
        if not self.chain or len(set(self.chain)) != len(self.chain) or min(self.chain) < 0:
            raise InvalidInputError(f"chain must be different node indices, found {self.chain}")
        if self.candidates and self.chain[-1] not in self.candidates:
            raise InvalidInputError(
                f"candidates must have the chain's last node {self.chain[-1]} among them, found "
                f"{self.candidates}"
            )
        for name in ("pick_weights", "goal_weights"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, value)
            if value.ndim != 1 or value.size % 2 or not np.all(value >= 0.0):
                raise InvalidInputError(
                    f"{name} must be 2D weights of at least 0, found {value.tolist()}"
                )
        if self.pick_weights.shape != self.goal_weights.shape:
            raise InvalidInputError(
                f"pick_weights and goal_weights must be equally long, found "
                f"{self.pick_weights.size} and {self.goal_weights.size}"
            )
        if not self.control_weight > 0.0:
            raise InvalidInputError(f"control_weight must be positive, found {self.control_weight}")
        if not (self.command_weight is None or self.command_weight > 0.0):
            raise InvalidInputError(f"command_weight must be positive, found {self.command_weight}")
        for name in ("switching_cost", "placed_radius", "angle_weight"):
            if not getattr(self, name) >= 0.0:
                raise InvalidInputError(f"{name} must be at least 0, found {getattr(self, name)}")

    def ending_nearest(self, position: np.ndarray, goal: np.ndarray) -> tuple[int, ...]:
        """The chain with the candidate in its last place that is nearest to the goal.

        ``position`` is ``[N, D]`` m, ``goal`` ``[D]`` m.
        """
        nodes = self.candidates or self.chain[-1:]
        distance = np.linalg.norm(position[list(nodes)] - goal, axis=-1)
        return (*self.chain[:-1], nodes[int(distance.argmin())])

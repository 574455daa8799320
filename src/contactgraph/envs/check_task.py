"""The test of the task contract, for any task."""

from collections.abc import Callable
from typing import Any, NoReturn, cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.envs.contract import Observation, Renderable, Task

_SEEDS = (0, 1, 12345)
_CONTROL_HOLD = 10
"""Steps for which a random control is held: enough to move far and to collide."""
_KEYS = {"position", "velocity", "contact", "goal"}
_OPTIONAL_KEYS = {"holding", "orientation", "angular_velocity"}
_QUATERNION_TOLERANCE = 1e-3


def check_task(task_factory: Callable[[], Task]) -> None:
    """Checks that ``task_factory`` makes tasks that keep the contract of `Task`.

    Runs whole episodes under random controls, two tasks side by side. Gymnasium's own
    `gymnasium.utils.env_checker.check_env` is the complement: it checks the environment's API.

    Raises `InvalidInputError` that states the task's behaviour and the contract's demand.
    """
    for seed in _SEEDS:
        task, twin = task_factory(), task_factory()
        _check_members(task)
        first, _ = task.reset(seed=seed)
        _check_observation(task, first, "reset")
        _check_scene(task, first)
        points = _check_link_positions(task, None, "reset")
        _check_cost(task)
        _check_start(task.scene, first)
        twin_first, _ = twin.reset(seed=seed)
        _check_equal(first, twin_first, f"two tasks reset with seed {seed} must agree")
        _check_episode(task, twin, first, np.random.default_rng(seed))
        _check_link_positions(task, points, "the end of an episode")
        again, _ = task.reset(seed=seed)
        _check_equal(first, again, f"a reset with seed {seed} after an episode must begin it again")


def _check_members(task: Task) -> None:
    if not isinstance(task, gymnasium.Env):
        _fail(f"a task must be a gymnasium.Env, found {type(task).__name__}")
    for name in ("max_steps", "success", "cost_terms"):
        if not hasattr(task, name):
            _fail(f"a task must have the member {name}")
    if not (isinstance(task.max_steps, int) and task.max_steps >= 1):
        _fail(f"max_steps must be an int of at least 1, found {task.max_steps!r}")
    box = task.action_space
    if not (isinstance(box, gymnasium.spaces.Box) and len(box.shape) == 1 and box.is_bounded()):
        _fail(f"action_space must be a bounded Box of shape (U,), found {box}")


def _check_scene(task: Task, observation: Observation) -> None:
    scene, (control_size,) = task.scene, cast(tuple[int], task.action_space.shape)
    if control_size and not scene.actuated.any():
        _fail("scene.actuated must name at least one node that the control acts on")
    for name, found in (("control_kind", scene.control_kind), ("control_of", scene.control_of)):
        size = None if found is None else np.shape(found)[-1]
        if size not in (None, control_size):
            _fail(f"scene.{name} must be of {control_size} components, found {size}")
    if scene.goal is None or not np.array_equal(scene.goal, observation["goal"]):
        _fail(f"scene.goal must be the observed goal, found {scene.goal}")


def _check_cost(task: Task) -> None:
    cost, scene = task.cost_terms(), task.scene
    for name, nodes in (("chain", cost.chain), ("candidates", cost.candidates)):
        if not all(0 <= node < scene.node_count for node in nodes):
            most = scene.node_count - 1
            _fail(f"cost_terms().{name} must name nodes 0 to {most}, found {nodes}")
    if cost.pick_weights.shape != (2 * scene.dimension,):
        _fail(
            f"cost_terms() must have {2 * scene.dimension} weights (position, velocity), "
            f"found {cost.pick_weights.size}"
        )


def _check_start(scene: Scene, observation: Observation) -> None:
    if scene.radius is None:
        return
    position = observation["position"]
    distance = np.linalg.norm(position[:, None] - position, axis=-1)
    gap = distance - scene.radius[:, None] - scene.radius
    np.fill_diagonal(gap, np.inf)
    if gap.min() < 0.0:
        a, b = np.unravel_index(int(gap.argmin()), gap.shape)
        _fail(
            f"nothing may overlap at reset, found {scene.node_name[a]} and {scene.node_name[b]} "
            f"overlapping by {-gap.min():.4f} m"
        )


def _check_episode(task: Task, twin: Task, first: Observation, rng: np.random.Generator) -> None:
    """One episode; the twin gets the same controls, already clipped."""
    box: Any = task.action_space
    previous, done, steps = first, False, 0
    while not done:
        if steps == task.max_steps:
            _fail(
                f"an episode must end after max_steps = {task.max_steps} steps, found it going on"
            )
        if steps % _CONTROL_HOLD == 0:
            control = (box.low + (box.high - box.low) * rng.uniform(-0.5, 1.5, box.shape)).astype(
                box.dtype
            )
        copy = {name: value.copy() for name, value in previous.items()}
        observation, reward, terminated, truncated, _ = task.step(control)
        twin_observation, *_ = twin.step(np.clip(control, box.low, box.high))
        steps += 1
        _check_equal(copy, previous, "a step must not change the observation before it")
        _check_observation(task, observation, f"step {steps}")
        if not np.isfinite(reward):
            _fail(f"the reward must be finite, found {reward} at step {steps}")
        _check_equal(
            observation,
            twin_observation,
            "a control out of bounds must act as the nearest one within, and the same seed and "
            f"controls give the same episode to the last bit: violated at step {steps}",
        )
        previous, done = observation, terminated or truncated
    if not isinstance(task.success(), bool):
        _fail(f"success() must be a bool, found {type(task.success()).__name__}")


def _check_observation(task: Task, observation: Observation, when: str) -> None:
    if not isinstance(task.scene, Scene):
        _fail(f"scene must be a contactgraph.data.Scene, found {type(task.scene).__name__}")
    if not _KEYS <= set(observation) <= _KEYS | _OPTIONAL_KEYS:
        _fail(
            f"an observation must have the keys {sorted(_KEYS)}, may have "
            f"{sorted(_OPTIONAL_KEYS)}, found {sorted(observation)}"
        )
    count, dimension = task.scene.node_count, task.scene.dimension
    shapes = {
        "position": (count, dimension),
        "velocity": (count, dimension),
        "contact": (count, count),
        "goal": (dimension,),
        "holding": (count, count),
        "orientation": (count, 4 if dimension == 3 else 1),
        "angular_velocity": (count, 3 if dimension == 3 else 1),
    }
    for name, value in observation.items():
        shape = shapes[name]
        if value.shape != shape:
            _fail(f"{name} must have the scene's shape {shape}, found {value.shape} at {when}")
        if not np.all(np.isfinite(value)):
            _fail(f"{name} must be finite, found {value.tolist()} at {when}")
    for name in {"contact", "holding"} & set(observation):
        _check_pairs(name, observation[name], when)
    if np.any(observation.get("holding", 0) > observation["contact"]):
        _fail(f"holding must imply contact, violated at {when}")
    if "orientation" in observation and dimension == 3:
        length = np.linalg.norm(observation["orientation"], axis=1)
        if np.any(np.abs(length - 1.0) > _QUATERNION_TOLERANCE):
            _fail(f"orientation must be unit quaternions, found length {length} at {when}")
    if not task.observation_space.contains(observation):
        _fail(f"an observation must lie in observation_space, violated at {when}")


def _check_pairs(name: str, value: np.ndarray, when: str) -> None:
    if value.dtype != np.int8 or not np.all((value == 0) | (value == 1)):
        _fail(f"{name} must be int8, 0 or 1, found {value.dtype} at {when}")
    if not np.array_equal(value, value.T) or value.diagonal().any():
        _fail(f"{name} must be symmetric with a zero diagonal, violated at {when}")


def _check_link_positions(task: Task, points: int | None, when: str) -> int | None:
    """The number of points of a `Renderable` task; ``points`` is that number if already known."""
    if not isinstance(task, Renderable):
        return None
    links, dimension = task.link_positions(), task.scene.dimension
    if links.ndim != 2 or len(links) < 2 or links.shape[1] != dimension:
        _fail(
            f"link_positions() must have shape (P, {dimension}) with P >= 2, found {links.shape} "
            f"at {when}"
        )
    if points not in (None, len(links)):
        _fail(f"link_positions() must keep its {points} points, found {len(links)} at {when}")
    if not np.all(np.isfinite(links)):
        _fail(f"link_positions() must be finite, found {links.tolist()} at {when}")
    return len(links)


def _check_equal(one: Observation, other: Observation, demand: str) -> None:
    for name in one:
        if not np.array_equal(one[name], other[name]):
            _fail(f"{demand} ({name} differs)")


def _fail(message: str) -> NoReturn:
    raise InvalidInputError(f"task contract: {message}")

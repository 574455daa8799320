"""The tasks ``fetch-push``, ``fetch-slide`` and ``fetch-pick-and-place`` of gymnasium-robotics."""

from contextlib import redirect_stderr
from functools import partial
from importlib.metadata import version
from io import StringIO
from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.envs.adapter import AdaptedTask, WatchedContact
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.push_and_pick import PickPolicy, PushPolicy, PushStyle, RandomPushes
from contactgraph.interchange import read_map

NEWEST_MUJOCO = (3, 6)
"""With newer ones the arm of gymnasium-robotics 1.4 starts 1.8 cm elsewhere, or it fails."""
DT = 0.04
MAX_DISPLACEMENT = 0.05
"""m: what the action 1 asks of the hand in one step. It moves by some 0.65 of that."""
_HAND_BODIES = ("gripper_link", "r_gripper_finger_link", "l_gripper_finger_link")


def _make_environment(task: str, environment: str) -> gymnasium.Env[Any, Any]:
    try:
        with redirect_stderr(StringIO()):  # its import prints a note on other environments
            import gymnasium_robotics
    except (ImportError, gymnasium.error.DependencyNotInstalled) as error:
        raise InvalidInputError(
            f"{task} cannot start ({error.__cause__ or error}): pip install 'contactgraph[fetch]'"
        ) from error
    found = version("mujoco")
    if tuple(map(int, found.split(".")[:2])) > NEWEST_MUJOCO:
        raise InvalidInputError(
            f"{task} needs a MuJoCo below 3.7, found {found}: pip install 'contactgraph[fetch]'"
        )
    gymnasium.register_envs(gymnasium_robotics)
    return _WatchedContact(gymnasium.make(environment, disable_env_checker=True))


class _WatchedContact(WatchedContact):
    """Watches gripper and object in 20 substeps a step."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Starts an episode; `touched` tells whether they touch."""
        found = super().reset(**options)
        self.touched = _touching(self.unwrapped)
        return found

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Makes a step, in which MuJoCo calls back once it knows the contacts of a substep."""
        inner: Any = self.unwrapped
        self.touched, mujoco = False, inner._mujoco

        def watch(model: Any, data: Any) -> None:
            self.touched = self.touched or _touching(inner)

        mujoco.set_mjcb_control(watch)
        try:
            return super().step(action)
        finally:
            mujoco.set_mjcb_control(None)


def _touching(inner: Any) -> bool:
    """Whether MuJoCo has a contact between the gripper and the object."""
    model, contacts = inner.model, inner.data.contact
    hand = [model.body(f"robot0:{name}").id for name in _HAND_BODIES]
    bodies = model.geom_bodyid[contacts.geom]
    of_hand, of_object = np.isin(bodies, hand), bodies == model.body("object0").id
    return bool(np.any(of_hand & of_object[:, ::-1]))


LEAD = DT / 0.65
"""s: the hand covers 0.65 of the displacement that it is told, in a step."""
_SPEED = 0.6


def _style(task: str, approach: float) -> PushStyle:
    reach = read_map(task).bodies[0].bounds
    assert reach is not None
    margin = 0.02  # m: noise must not take the hand out of its reach
    return PushStyle(
        clearance=0.09,
        speed=_SPEED,
        lead=LEAD,
        near_enough=0.01,
        steering=5.0,
        approach=approach,
        height=0.005,  # the closed fingers' tips are 2 cm below the hand, and the table 2.5 cm
        reach=reach[:, :2] + np.array([[margin], [-margin]]),
    )


class FetchTask(AdaptedTask):
    """An environment of the Fetch arm; the base of its tasks.

    Nodes are the gripper and the object, in space. The control ``[3]`` m is a displacement of the
    gripper; for pick-and-place a fourth component opens (1) or closes (-1) the fingers. Velocities
    are backward differences: the environment's own are those of the joints at the end of a step,
    times its duration, the object's relative to the hand. Success is the environment's own: the
    object within 5 cm of the goal at the end. Raises `InvalidInputError` without
    gymnasium-robotics.
    """

    name: str
    """Of the task, and of its map."""
    environment_name: str
    horizon, starts = 30, 32
    max_force: float | None = MAX_DISPLACEMENT

    def __init__(self) -> None:
        super().__init__(
            partial(_make_environment, self.name, self.environment_name),
            self.name,
            name=self.name,
            cost=ChainCost(
                (0, 1),
                np.array([0.03, 0.03, 0.03, 0.002, 0.002, 0.002]),
                np.array([50.0, 50.0, 50.0, 1.0, 1.0, 1.0]),
                0.01,
                command_weight=1e-6,  # to hold costs no more than to let go
                switching_cost=0.01,
            ),
            max_steps=50,
            success_key="is_success",
            contact=WatchedContact.contact,
            packages=("gymnasium-robotics", "mujoco"),
            scene_metadata={"environment": self.environment_name},
        )


class FetchPushTask(FetchTask):
    """An arm pushes a block to a goal (gymnasium-robotics, MuJoCo)."""

    name, environment_name = "fetch-push", "FetchPush-v4"
    style = _style("fetch-push", approach=5.0)
    expert = partial(PushPolicy, style, noise=0.004, variety=0.4)
    fixed_start = demonstrator = partial(PushPolicy, style)
    explorer = partial(RandomPushes, style, noise=0.01, seconds=1.0)


class FetchSlideTask(FetchTask):
    """An arm strikes a puck that slides to a goal beyond its reach (MuJoCo)."""

    name, environment_name = "fetch-slide", "FetchSlide-v4"
    style = _style("fetch-slide", approach=2.0)
    expert = partial(PushPolicy, style, noise=0.004, variety=0.4)
    fixed_start = demonstrator = partial(PushPolicy, style)
    explorer = partial(RandomPushes, style, noise=0.01, seconds=1.0)


class FetchPickAndPlaceTask(FetchTask):
    """An arm grasps a block, lifts it and takes it to a goal in the air (MuJoCo)."""

    name, environment_name = "fetch-pick-and-place", "FetchPickAndPlace-v4"
    max_force = None
    expert = partial(PickPolicy, _SPEED, LEAD, noise=0.003, variety=0.3)
    fixed_start = demonstrator = partial(PickPolicy, _SPEED, LEAD)
    explorer = partial(PickPolicy, _SPEED, LEAD, noise=0.02, variety=0.5)
    """Noise as large as this misses many grasps, and pushes and drops the object."""

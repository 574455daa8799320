"""The tasks ``fetch-push``, ``fetch-slide`` and ``fetch-pick-and-place`` of gymnasium-robotics."""

from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from io import StringIO
from typing import Any

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.envs.adapter import AdaptedTask, WatchedContact, watched_contact
from contactgraph.envs.contract import ChainCost
from contactgraph.envs.environment_map import Entries, EnvironmentMap, MappedBody, MappedControl
from contactgraph.envs.push_and_pick import PickPolicy, PushPolicy, PushStyle, RandomPushes

NEWEST_MUJOCO = (3, 6)
"""With newer ones the arm of gymnasium-robotics 1.4 starts 1.8 cm elsewhere, or it fails."""
DT = 0.04
MAX_DISPLACEMENT = 0.05
"""m: what the action 1 asks of the hand in one step. It moves by some 0.65 of that."""
_HAND_BODIES = ("gripper_link", "r_gripper_finger_link", "l_gripper_finger_link")
_DOWN = (float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)), 0.0)
"""The orientation (w, x, y, z) at which the environments keep the gripper."""


@dataclass(frozen=True, eq=False)
class FetchEnvironment:
    """The differences between the environments."""

    task: str
    identifier: str
    table: np.ndarray
    """[2, 3] m: corners of the space above the table, in which the object's centre stays."""
    reach: np.ndarray
    """[2, 3] m: corners of the space in which the arm follows its commands."""
    size: tuple[float, ...] | None
    """[3] m: sides of a box."""
    polygons: tuple[np.ndarray, ...] = ()
    """Corners of the object, where it turns."""
    grips: bool = False
    """Whether the control also moves the fingers."""


def _box(sides: tuple[float, ...], centre: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """[8, 3] m: the corners of a box."""
    return np.array(centre) + 0.5 * np.array(sides) * (
        2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
    )


_FINGERS = _box((0.077, 0.03, 0.027), (-0.02, 0.0, 0.0))
"""Corners of both fingers, closed, in the frame of the gripper, which points down along x."""
_LOW, _HIGH = 0.4, 1.0
"""m: heights of the tables' tops and of the highest goals' reach."""
PUSH = FetchEnvironment(
    "fetch-push",
    "FetchPush-v4",
    table=np.array([[1.05, 0.4, _LOW], [1.55, 1.1, _HIGH]]),
    reach=np.array([[0.95, 0.3, 0.38], [1.6, 1.2, _HIGH]]),
    size=(0.05, 0.05, 0.05),
    polygons=(_box((0.05, 0.05, 0.05)),),
)
SLIDE = FetchEnvironment(
    "fetch-slide",
    "FetchSlide-v4",
    table=np.array([[0.7, 0.3, _LOW], [1.95, 1.2, _HIGH]]),
    reach=np.array([[0.6, 0.3, 0.38], [1.25, 1.2, _HIGH]]),
    size=None,
)
PICK_AND_PLACE = FetchEnvironment(
    "fetch-pick-and-place",
    "FetchPickAndPlace-v4",
    table=PUSH.table,
    reach=PUSH.reach,
    size=PUSH.size,
    grips=True,
)


def fetch_task(which: FetchEnvironment) -> AdaptedTask:
    """An environment of the Fetch arm; raises `InvalidInputError` without gymnasium-robotics.

    Nodes are the gripper and the object, in space. The control ``[3]`` m is a displacement of the
    gripper; for pick-and-place a fourth component opens (1) or closes (-1) the fingers. Velocities
    are backward differences: the environment's own are those of the joints at the end of a step,
    times its duration, the object's relative to the hand. Success is the environment's own: the
    object within 5 cm of the goal at the end.
    """
    return AdaptedTask(partial(_make_environment, which.task, which.identifier), _fetch_map(which))


def _make_environment(task: str, identifier: str) -> gymnasium.Env[Any, Any]:
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
    return _WatchedContact(gymnasium.make(identifier, disable_env_checker=True))


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


def _fetch_map(which: FetchEnvironment) -> EnvironmentMap:
    axes, fingers = 3, int(which.grips)
    return EnvironmentMap(
        name=which.task,
        dt=DT,
        dimension=3,
        bodies=(
            MappedBody(
                name="gripper",
                type="gripper",
                position=Entries(0, 3, "observation"),
                orientation=_DOWN,
                polygons=(_FINGERS,) if which.polygons else (),
                actuated=True,
                bounds=which.reach,
            ),
            MappedBody(
                name="object",
                type="object",
                position=Entries(3, 6, "observation"),
                orientation=Entries(11, 14, "observation"),
                euler="XYZ",
                bounds=which.table,
                size=which.size,
                polygons=which.polygons,
            ),
        ),
        control=MappedControl(
            kind=("displacement",) * axes + ("other",) * fingers,
            body=("gripper",) * (axes + fingers),
            entries=tuple(range(axes + fingers)),
            scale=(MAX_DISPLACEMENT,) * axes + (1.0,) * fingers,
        ),
        goal=Entries(0, 3, "desired_goal"),
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
        contact=watched_contact,
        planes=np.array([[0.0, 0.0, 1.0, _LOW]]),
        gravity=(0.0, 0.0, -9.81),
        metadata={"environment": which.identifier},
    )


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


def _style(which: FetchEnvironment, approach: float) -> PushStyle:
    margin = 0.02  # m: noise must not take the hand out of its reach
    return PushStyle(
        clearance=0.09,
        speed=_SPEED,
        lead=LEAD,
        near_enough=0.01,
        steering=5.0,
        approach=approach,
        height=0.005,  # the closed fingers' tips are 2 cm below the hand, and the table 2.5 cm
        reach=which.reach[:, :2] + np.array([[margin], [-margin]]),
    )


PUSH_STYLE = _style(PUSH, approach=5.0)
SLIDE_STYLE = _style(SLIDE, approach=2.0)
push_fixed_start = partial(PushPolicy, PUSH_STYLE)
push_expert = partial(PushPolicy, PUSH_STYLE, noise=0.004, variety=0.4)
push_explorer = partial(RandomPushes, PUSH_STYLE, noise=0.01, seconds=1.0)
slide_fixed_start = partial(PushPolicy, SLIDE_STYLE)
slide_expert = partial(PushPolicy, SLIDE_STYLE, noise=0.004, variety=0.4)
slide_explorer = partial(RandomPushes, SLIDE_STYLE, noise=0.01, seconds=1.0)
pick_fixed_start = partial(PickPolicy, _SPEED, LEAD)
pick_expert = partial(PickPolicy, _SPEED, LEAD, noise=0.003, variety=0.3)
pick_explorer = partial(PickPolicy, _SPEED, LEAD, noise=0.02, variety=0.5)
"""Noise as large as this misses many grasps, and pushes and drops the object."""

"""Recorded simulations of the arm, and worlds with a given hand position."""

import mujoco
import numpy as np

from contactgraph_franka.envs.arm_model import inverse_kinematics
from contactgraph_franka.envs.arm_world import ArmWorld
from contactgraph_franka.envs.franka_task import DT, FrankaTask
from contactgraph_franka.envs.pickup import Grasp

TORQUE = np.array([87.0] * 4 + [12.0] * 3)
"""The maker's, N m."""
LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""The maker's, rad."""
PADS = ("left_pad", "right_pad")


class Watched:
    """An `Impedance` that records torques and joint positions in every cycle."""

    def __init__(self, world):
        self._world, self._inner = world, world.impedance
        self.torque, self.joints, self.turn_angle, self.contacts = [], [], [], []

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def __call__(self, force):
        self.contacts.append(self._world.data.contact.geom.tolist())
        return self._inner(force)

    def observe(self, before):
        self._inner.observe(before)
        data = self._world.data
        self.torque.append(data.qfrc_actuator[:7].copy())
        self.joints.append(data.qpos[:7].copy())
        self.turn_angle.append(np.degrees(np.linalg.norm(self._inner.turn)))


class WatchedTask(FrankaTask):
    """The arm's task; `watched` holds the internals of its last episode."""

    def begin(self, seed):
        scene, world = super().begin(seed)
        self.watched = world.impedance = Watched(world)
        return scene, world


def pads_touching(world, contacts=None):
    """Names of the finger pads that touch block 0, now or by the pairs of geoms in ``contacts``."""
    pairs = world.data.contact.geom.tolist() if contacts is None else contacts
    block = world.model.geom("block0").id
    return {pad for pad in PADS if any({world.model.geom(pad).id, block} == {*p} for p in pairs)}


def world_with_hand_at(point, yaw=0.7, block=(0.6, -0.3, 0.05), turned=0.0, grasp=Grasp.FRICTION):
    """At rest, with one block."""
    arm = FrankaTask().begin(0)[1].model
    joints = inverse_kinematics(arm, np.asarray(point), yaw)
    return ArmWorld(joints, np.array([block]), np.array([turned]), DT, grasp)


def step_once(world, force, fingers=0.03):
    """One millisecond with the given finger command."""
    data = world.data
    data.ctrl[:7] = world.impedance(np.asarray(force, float))
    data.ctrl[7] = fingers
    before = data.qvel.copy()
    mujoco.mj_step2(world.model, data)
    world.impedance.observe(before)
    mujoco.mj_step1(world.model, data)


def push(force):
    """[2, 3] N of a world with one block: the force is the hand's."""
    return np.array([force, [0.0, 0.0, 0.0]], float)

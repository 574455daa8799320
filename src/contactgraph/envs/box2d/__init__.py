"""Worlds on Box2D: bodies in the plane that collide purely inelastically and then hold."""

from contactgraph.envs.box2d.circle_world import CircleWorld as CircleWorld
from contactgraph.envs.box2d.door_world import DoorWorld as DoorWorld
from contactgraph.envs.box2d.engine import SIMULATOR as SIMULATOR

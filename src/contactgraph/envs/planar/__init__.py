"""Worlds of bodies in the plane, on Box2D or on pymunk."""

"""Geometry of bodies: their shapes, where and when they meet, and what moves there."""

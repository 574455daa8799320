"""The scene that an import map describes."""

from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError, Scene
from contactgraph.interchange.measurements import MappedEpisode
from contactgraph.interchange.scene_map import SceneMap


def map_scene(mapped: MappedEpisode, widths: list[int]) -> Scene:
    """The scene of the map, with the goal of the episode.

    ``widths`` are the numbers of components of the map's controls.
    """
    found = mapped.map
    bodies = found.bodies
    outlines = [(index, each) for index, body in enumerate(bodies) for each in body.polygons]
    constants: dict[str, Any] = {
        name: _constant(name, found)
        for name in ("mass", "radius", "size", "anchor", "reach")
        if any(name in body.constants for body in bodies)
    }
    goal = None if found.goal is None else found.goal.read(mapped.episode, found.dimension).values
    if goal is not None:
        goal = goal[np.isfinite(goal).all(axis=1)]
        if not len(goal):
            raise InvalidInputError(f"{found.where}: goal: must have numbers, found none")
    scene: dict[str, Any] = {
        name: value.astype(np.int64) if name in ("pins", "candidate_edges") else value
        for name, value in found.scene.items()
    }
    components = [
        each for each, width in zip(found.controls, widths, strict=True) for _ in range(width)
    ]
    acting = [[body.name in each.bodies for each in components] for body in bodies]
    return Scene(
        node_name=tuple(body.name for body in bodies),
        node_type=tuple(body.type for body in bodies),
        actuated=np.array([body.actuated for body in bodies]),
        dt=mapped.dt,
        dimension=found.dimension,
        goal=None if goal is None else goal[0],
        static=None
        if all(body.static is None for body in bodies)
        else np.array([bool(body.static) for body in bodies]),
        control_kind=tuple(each.kind for each in components),
        control_of=np.array(acting).reshape(len(bodies), sum(widths)),
        polygons=tuple(each for _, each in outlines) or None,
        polygon_of=np.array([index for index, _ in outlines]) if outlines else None,
        **constants,
        **scene,
    )


def _constant(name: str, found: SceneMap) -> np.ndarray:
    """[N, …] of a constant that some bodies have; NaN for the others."""
    shape = {
        "mass": (),
        "radius": (),
        "size": (found.dimension,),
        "anchor": (found.dimension,),
        "reach": (2, found.dimension),
    }[name]
    rows = []
    for body in found.bodies:
        value = body.constants.get(name, np.full(shape, np.nan))
        if not shape and name not in body.constants:
            raise InvalidInputError(
                f"{found.where}: {body.name}: {name} must be given, as another body's is"
            )
        if value.shape != shape:
            raise InvalidInputError(
                f"{found.where}: {body.name}: {name} must have shape {shape}, found {value.shape}"
            )
        rows.append(value)
    return np.stack(rows)

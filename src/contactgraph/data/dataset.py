"""Trajectories that belong together: split for training, subsampled, checked."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from contactgraph.data.errors import InvalidInputError
from contactgraph.data.schema import ABSENT, Field, changed
from contactgraph.data.trajectory import Scene, Trajectory

Metadata = dict[str, str | int | float | bool]

_FAR = 50.0
"""m, of a coordinate, from which on the errors of 32 bits, 4 um and more, would show."""
_HEAVIER = 1.02
"""Ratio of the masses of one type from which they differ."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Trajectories that one model can be trained on.

    The number of steps and of nodes may differ between trajectories; degrees of freedom, time step
    and control size may not. Raises `InvalidInputError` naming the first trajectory that disagrees.
    """

    trajectories: tuple[Trajectory, ...]
    metadata: Metadata = field(default_factory=dict)
    """Free-form, about all trajectories: task, seed, simulator version, …"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "trajectories", tuple(self.trajectories))
        if not self.trajectories:
            raise InvalidInputError("a dataset needs at least one trajectory, found none")
        for index, each in enumerate(self.trajectories):
            _check_agreement("dimension D", index, each.scene.dimension, self.dimension)
            _check_agreement("control size U", index, each.control_size, self.control_size)
            if not np.isclose(each.scene.dt, self.dt, rtol=1e-6, atol=0.0):
                _check_agreement("dt in s", index, each.scene.dt, self.dt)

    def __repr__(self) -> str:
        nodes = {each.scene.node_count for each in self}
        steps = {each.steps for each in self}
        ranges = [f"{min(each)}" + f" to {max(each)}" * (len(each) > 1) for each in (steps, nodes)]
        sizes = f"T={ranges[0]}, N={ranges[1]}, D={self.dimension}, U={self.control_size}"
        return f"Dataset({len(self)} trajectories, {sizes}, dt={self.dt:g} s)"

    def __len__(self) -> int:
        return len(self.trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    def map(self, change: Callable[[Trajectory], Trajectory]) -> "Dataset":
        """The dataset with ``change`` of each of its trajectories."""
        return replace(self, trajectories=tuple(map(change, self)))

    @property
    def dimension(self) -> int:
        """D, degrees of freedom a node."""
        return self.trajectories[0].scene.dimension

    @property
    def control_size(self) -> int:
        """U, the size of the control."""
        return self.trajectories[0].control_size

    @property
    def dt(self) -> float:
        """Time between two steps, s."""
        return self.trajectories[0].scene.dt


def _check_agreement(what: str, index: int, value: float, first: float) -> None:
    if value != first:
        raise InvalidInputError(
            f"trajectory {index}: {what} is {value}, but {first} in trajectory 0; all must agree"
        )


def split_by_trajectory(
    dataset: Dataset, held_out_fraction: float, seed: int
) -> tuple[Dataset, Dataset]:
    """Split whole trajectories into (train, held out), at least one each, in their order.

    Windows of one trajectory resemble each other, so a split within trajectories would
    underestimate the error. The same seed gives the same split. Raises `InvalidInputError` for
    fewer than two trajectories or a fraction outside (0, 1).
    """
    if not 0.0 < held_out_fraction < 1.0:
        raise InvalidInputError(
            f"held_out_fraction must lie between 0 and 1, found {held_out_fraction}"
        )
    if len(dataset) < 2:
        raise InvalidInputError("a held-out split needs at least 2 trajectories, found 1")
    count = int(np.clip(round(held_out_fraction * len(dataset)), 1, len(dataset) - 1))
    chosen = np.random.default_rng(seed).permutation(len(dataset))[:count]
    held_out = np.isin(np.arange(len(dataset)), chosen)
    every = dataset.trajectories
    return (
        Dataset(tuple(every[i] for i in np.flatnonzero(~held_out)), dataset.metadata),
        Dataset(tuple(every[i] for i in np.flatnonzero(held_out)), dataset.metadata),
    )


def strip_contacts(dataset: Dataset) -> Dataset:
    """The same trajectories without contact labels, as recorded without contact sensors."""
    return dataset.map(lambda each: replace(each, contact=None, holding=None))


def with_edge_labels(dataset: Dataset) -> Dataset:
    """The same trajectories with the labels of the contact graph's edges as their contacts.

    An edge joins two nodes that move together: those that hold each other, where every trajectory
    records it and some pair holds somewhere; else those in contact.
    """
    holding = [each.holding for each in dataset]
    if any(each is None for each in holding) or not any(np.any(each) for each in holding):
        return dataset
    return dataset.map(lambda each: replace(each, contact=each.holding))


def without_turns(dataset: Dataset) -> Dataset:
    """The same trajectories without orientations, angular velocities, outlines and pins."""

    def stripped(each: Trajectory) -> Trajectory:
        scene = replace(
            each.scene, polygons=ABSENT, polygon_of=ABSENT, pins=ABSENT, pin_points=ABSENT
        )
        return replace(each, scene=scene, orientation=ABSENT, angular_velocity=ABSENT)

    return dataset.map(stripped)


def subsample(dataset: Dataset, every: int) -> Dataset:
    """The same trajectories with every ``every``-th state, and controls averaged in between.

    Two nodes touch, or hold each other, in a step if they do at any of the states within it.
    States after the last whole step are dropped.
    Raises `InvalidInputError` where ``every`` is below 1, or a trajectory has fewer steps.
    """
    if every < 1:
        raise InvalidInputError(f"every must be at least 1, found {every}")
    return dataset if every == 1 else dataset.map(lambda each: _subsampled(each, every))


def _subsampled(trajectory: Trajectory, every: int) -> Trajectory:
    steps = trajectory.steps // every
    if steps < 1:
        raise InvalidInputError(
            f"every must be 1 to {trajectory.steps}, a trajectory's steps, found {every}"
        )

    def longer(field: Field, value: np.ndarray) -> np.ndarray:
        first = 0 if field.axis[0] == "T" else 1  # A step leads to the state after it.
        within = value[first : steps * every + first].reshape(steps, every, *value.shape[1:])
        if field.axis[0] == "T":
            return within.mean(axis=1)
        pairs = field.axis[1:] == ("N", "N")
        return np.concatenate([value[:1], within.any(axis=1) if pairs else within[:, -1]])

    scene = trajectory.scene
    return changed(trajectory, longer, scene=replace(scene, dt=every * scene.dt))


def masses_vary(dataset: Dataset) -> bool:
    """Whether the scenes tell masses that differ between passive bodies of one type."""
    found: dict[str, set[float]] = {}
    for each in dataset:
        scene = each.scene
        if scene.mass is not None:
            for node in np.flatnonzero(scene.passive):
                found.setdefault(scene.node_type[node], set()).add(float(scene.mass[node]))
    return any(max(masses) > _HEAVIER * min(masses) for masses in found.values())


def far_origin(scene: Scene, position: np.ndarray) -> np.ndarray | None:
    """[D] m: a point near bodies at ``position`` [N, D] m that are all far from the origin.

    None where one is near, or where the control is a position in the world.
    """
    nearest = np.abs(position).max(axis=1).min()
    if "position" in (scene.control_kind or ()) or not nearest > _FAR:
        return None
    return np.round(position.mean(axis=0))


def near_origin(dataset: Dataset) -> Dataset:
    """The same trajectories, each about a point near its first state if that is far away."""

    def near(each: Trajectory) -> Trajectory:
        origin = far_origin(each.scene, each.position[0])
        if origin is None:
            return each
        return changed(each, _about(origin), scene=scene_about(each.scene, origin))

    return dataset.map(near)


def scene_about(scene: Scene, origin: np.ndarray) -> Scene:
    """The same scene in coordinates about ``origin`` [D] m."""
    normal, offset = scene.planes[:, :-1], scene.planes[:, -1:]
    planes = np.concatenate([normal, offset - normal @ origin[:, None]], axis=1)
    return changed(scene, _about(origin), planes=planes)


def _about(origin: np.ndarray) -> Callable[[Field, np.ndarray], np.ndarray]:
    return lambda field, value: value - origin if field.place else value

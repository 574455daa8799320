"""Inputs of the interaction network: what it knows of a scene, and the windows it learns from."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from contactgraph.data import (
    Dataset,
    Scene,
    TrajectoryBatch,
    candidate_pairs,
    pad_trajectories,
    pair_indices,
)
from contactgraph.identify import scene_facts
from contactgraph.identify.shapes import with_turning
from contactgraph.train import TrainConfig
from contactgraph.train.batch import (
    WindowSource,
    add_distractor,
    has_resting_bodies,
    window_source,
)

_WINDOW = 8
"""Steps of a rollout in training."""
_FARTHEST = 12.0
"""Greatest distance of a distractor, in least distances: a network has no cutoff, and where it has
seen distractors near by only, those far away disturb it."""


class SceneInputs(eqx.Module):
    """What a network knows of the bodies of a scene, with leading batch axes."""

    features: Float[Array, "*B N F"]
    """Type, one-hot, and whether a body is actuated, static, on a hinge."""
    acts: Float[Array, "*B N U"]
    """1 where a component of the control acts on a body, else 0."""
    anchor: Float[Array, "*B N D"]
    """Hinge, m; 0 where a body has none."""
    exists: Bool[Array, "*B N"]
    """False for padding."""
    linked: Bool[Array, "*B N N"]
    """Pairs that send each other messages."""
    movable: Bool[Array, "*B N"]
    """Bodies that exist and are not static."""


def scene_inputs(
    scene: Scene, control_size: int, types: Sequence[str], capacity: int
) -> SceneInputs:
    """The inputs of a scene, padded to ``capacity`` bodies; types not among ``types`` are blank."""
    count, static, hinged = scene.node_count, scene.static, scene.hinged
    one_hot = np.array(scene.node_type)[:, None] == np.array(types)
    flags = np.stack([scene.actuated, static, hinged], axis=1)
    acts = scene.control_of
    if acts is None:
        acts = np.repeat(scene.actuated[:, None], control_size, axis=1)
    linked = np.zeros((capacity, capacity), dtype=bool)
    first, second = pair_indices(capacity)[candidate_pairs(scene, capacity)].T
    linked[first, second] = linked[second, first] = True

    def padded(value: np.ndarray) -> Array:
        wide = np.zeros((capacity, *value.shape[1:]), np.float32)
        wide[:count] = value
        return jnp.asarray(wide)

    return SceneInputs(
        features=padded(np.concatenate([one_hot, flags], axis=1)),
        acts=padded(acts),
        anchor=padded(np.where(hinged[:, None], scene.anchor, 0.0)),
        exists=padded(np.ones(count)) > 0,
        linked=jnp.asarray(linked),
        movable=padded(~static) > 0,
    )


class InputScales(eqx.Module):
    """Typical sizes in the training data, so that the network works with numbers about 1."""

    contact_distance: float
    """m"""
    position: float
    """Spread of positions, m."""
    speed: float
    """m/s"""
    speed_change: float
    """In a step, m/s."""
    control: tuple[float, ...]
    """[U]"""
    dt: float
    """s"""
    turn_length: float | None = None
    """See `generalized_coordinates`. None: no body turns in the plane."""


class NetworkWindows(eqx.Module):
    """Windows to draw, and the scenes that they are from."""

    source: WindowSource
    scenes: SceneInputs
    """[R, …]"""
    distractors: int = eqx.field(static=True)
    nearest: float = eqx.field(static=True)
    """Least distance of a distractor from other bodies, m."""

    def draw(self, count: int, key: PRNGKeyArray) -> tuple[TrajectoryBatch[Array], SceneInputs]:
        """``count`` windows with distractors, as the training of our model adds them."""
        draw_key, *place_keys = jax.random.split(key, 1 + self.distractors)
        trajectory, start = self.source.draw_starts(count, draw_key)
        windows = self.source.take(trajectory, start)
        scenes = jax.tree.map(lambda leaf: leaf[trajectory], self.scenes)
        for place_key in place_keys:
            windows = add_distractor(windows, self.nearest, _FARTHEST * self.nearest, place_key)
            scenes = jax.vmap(_with_distractor)(scenes, jnp.asarray(windows.nodes.mask)[:, -1])
        return windows, scenes


def _with_distractor(scene: SceneInputs, placed: Array) -> SceneInputs:
    """The scene with one more body at rest, like the first that can move and is not actuated."""
    free = scene.movable & (jnp.sum(scene.acts, axis=-1) == 0.0)
    like = jnp.where(jnp.any(free), scene.features[jnp.argmax(free)], 0.0)
    exists = jnp.append(scene.exists, placed)
    to_new = jnp.arange(len(exists)) == len(exists) - 1
    new_pairs = (to_new[:, None] != to_new[None]) & exists[:, None] & exists[None]
    return SceneInputs(
        features=jnp.concatenate([scene.features, like[None]]),
        acts=jnp.pad(scene.acts, ((0, 1), (0, 0))),
        anchor=jnp.pad(scene.anchor, ((0, 1), (0, 0))),
        exists=exists,
        linked=jnp.pad(scene.linked, (0, 1)) | new_pairs,
        movable=jnp.append(scene.movable, placed),
    )


def network_windows(dataset: Dataset, types: Sequence[str]) -> NetworkWindows:
    """The windows of a dataset, drawn as our model's training draws them."""
    batch = pad_trajectories(dataset, contacts=False, turn_length=turn_length(dataset))
    capacity = batch.position.shape[2]
    inputs = [scene_inputs(each.scene, each.control_size, types, capacity) for each in dataset]
    length = min(_WINDOW, int(batch.steps.max()))
    return NetworkWindows(
        source=window_source(batch, length, TrainConfig().event_fraction),
        scenes=jax.tree.map(lambda *leaves: jnp.stack(leaves), *inputs),
        distractors=TrainConfig().bystanders if has_resting_bodies(batch) else 0,
        nearest=1.03 * scene_facts(dataset).config.contact_distance,
    )


def turn_length(dataset: Dataset) -> float | None:
    """Length by which the network counts angles, m; None: no body turns in the plane."""
    told = scene_facts(dataset).config
    return with_turning(told, dataset).turn_length if dataset.dimension == 2 else None


def input_scales(dataset: Dataset) -> InputScales:
    """Root mean squares over all trajectories, bodies and steps."""
    position = np.concatenate([each.position.reshape(-1) for each in dataset])
    velocity = np.concatenate([each.velocity.reshape(-1) for each in dataset])
    change = np.concatenate([np.diff(each.velocity, axis=0).reshape(-1) for each in dataset])
    control = np.concatenate([each.control for each in dataset])

    def size(values: np.ndarray) -> float:
        found = float(np.sqrt(np.mean(values**2)))
        return found if found > 0.0 else 1.0

    return InputScales(
        contact_distance=scene_facts(dataset).config.contact_distance,
        position=size(position),
        speed=size(velocity),
        speed_change=size(change),
        control=tuple(size(each) for each in control.T),
        dt=dataset.dt,
        turn_length=turn_length(dataset),
    )

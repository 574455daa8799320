"""The host's part of a control step: measurements in the planner's shapes, and one core to run on.

Measurements stay in NumPy: a call of JAX for each array would take as long as a control step.
"""

import functools
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from contactgraph.data import InvalidInputError, generalized_coordinates, pair_indices

Observation = Mapping[str, np.ndarray]
"""``position`` [n, D] m and ``velocity`` [n, D] m/s of the first n nodes, for models of bodies that
turn also ``orientation`` [n, 1] rad (in space quaternions [n, 4]) and ``angular_velocity`` [n, 1 or
3] rad/s, NaN for those that do not; other keys are ignored, so that a task's observation can be
handed over as it is."""

T = TypeVar("T")

_SMALL_LOOP = 10_000_000
"""Bytes."""

Motion = tuple[np.ndarray, np.ndarray]
"""Position m and velocity m/s of all nodes, each [N, G]."""


class Measured(NamedTuple):
    """What a control step receives: of a scene, or of some of its nodes as it is compiled."""

    position: Any
    """[N, G] m; zero for nodes that were not observed. May be non-finite, as the velocity."""
    velocity: Any
    """[N, G] m/s"""
    contact: Any
    """[N+1, N+1], 1 touching, 0 not, NaN not measured, as in the last row; of some nodes [E]."""
    applied: Any
    """[U] N: the mean control of the step just made; NaN where it was the last plan's."""
    replan: Any
    """1 makes a plan, 0 reuses one, -1 makes one every ``replan_every`` steps."""

    def among(self, node_ids: np.ndarray) -> "Measured":
        """Of the nodes ``node_ids`` [n], of which -1 is padding, and the contacts of their pairs.

        Where only one of ``[i, j]`` and ``[j, i]`` was measured, that one counts.
        """
        first, second = node_ids[_pairs(len(node_ids))]
        one, other = self.contact[first, second], self.contact[second, first]
        return self._replace(
            position=self.position[node_ids],
            velocity=self.velocity[node_ids],
            contact=np.where(np.isfinite(one), one, other),
        )


def padded_motion(
    observation: Observation,
    capacity: int,
    dimension: int,
    dtype: np.dtype,
    turn_length: float | None = None,
) -> Motion:
    """Position and velocity [N, G], zero for nodes that were not observed.

    ``turn_length`` [m]: see `generalized_coordinates`. Values may be non-finite. Raises
    `InvalidInputError` where a shape does not fit, or a key is missing.
    """
    sizes = {"position": dimension, "velocity": dimension}
    if turn_length is not None:
        turn = (4, 3) if dimension == 3 else (1, 1)
        sizes |= dict(zip(("orientation", "angular_velocity"), turn, strict=True))
    for name in sizes:
        if name not in observation:
            raise InvalidInputError(
                f"observation must have {' and '.join(sizes)}, found {sorted(observation)}"
            )
    found = [_padded(observation, name, capacity, size, dtype) for name, size in sizes.items()]
    position, velocity = generalized_coordinates(turn_length, *found)
    return position.astype(dtype, copy=False), velocity.astype(dtype, copy=False)


def padded_contacts(contacts: np.ndarray | None, capacity: int, dtype: np.dtype) -> np.ndarray:
    """[N+1, N+1] contacts [n, n] of the scene's first n nodes; None: nothing is measured.

    Raises `InvalidInputError` where the shape does not fit.
    """
    padded = np.full((capacity + 1, capacity + 1), np.nan, dtype)
    if contacts is None:
        return padded
    matrix = np.asarray(contacts)
    size = matrix.shape[0] if matrix.ndim == 2 else -1
    if matrix.ndim != 2 or matrix.shape[1] != size or size > capacity:
        raise InvalidInputError(
            f"contacts must have shape (n, n) with n <= {capacity}, the capacity; "
            f"found {matrix.shape}"
        )
    padded[:size, :size] = matrix
    return padded


def applied_control(applied: np.ndarray | None, control_size: int, dtype: np.dtype) -> np.ndarray:
    """[U] N; NaN where it was not given."""
    if applied is None:
        return np.full(control_size, np.nan, dtype)
    control = np.array(applied, dtype)
    if control.shape != (control_size,):
        raise InvalidInputError(
            f"applied must have shape ({control_size},), the control's, found {control.shape}"
        )
    return control


def placed(arrays: T) -> T:
    """On the device to plan on: the CPU, unless the caller has chosen one in JAX's settings.

    A control step of one scene is a chain of small operations, of which a GPU makes several times
    as much time. Whatever else the step computes with follows the arrays of its model.
    """
    settings: Any = jax.config
    chosen = settings.jax_platforms or settings.jax_default_device
    on_cpu = bool(chosen) or jax.default_backend() == "cpu"
    return jax.device_put(arrays, None if on_cpu else jax.devices("cpu")[0])


def compile_small_loops() -> None:
    """Loops of plans become one kernel each in this process; call it before JAX computes anything.

    XLA runs a compiled loop on the CPU as a list of kernels, of which each costs its dispatch, and
    makes one kernel of a loop that accesses little memory only: the bound, in bytes, is raised here
    by the environment variable XLA_FLAGS, unless that has ``xla_backend_extra_options`` already. A
    pickup's step takes two thirds of the time. Large matrix products in such loops are slower.
    """
    flags, option = os.environ.get("XLA_FLAGS", ""), "--xla_backend_extra_options="
    if option not in flags:
        bound = f"{option}xla_cpu_small_while_loop_byte_threshold={_SMALL_LOOP}"
        os.environ["XLA_FLAGS"] = f"{flags} {bound}".strip()


@functools.cache
def loop_options() -> dict[str, str]:
    """Options of `jax.jit` under which loops are small: products of matrices stay loops, too."""
    options = {"xla_cpu_experimental_ynn_fusion_type": ""}
    try:
        jax.jit(jax.numpy.sign, compiler_options=options).lower(0.0).compile()
    except (jax.errors.JaxRuntimeError, ValueError):  # Of another release: it has no such library.
        return {}
    return options


@contextmanager
def pin_to_core(core: int | None = None) -> Iterator[None]:
    """All threads of this process share a core within; None: the last that it may use.

    A control step is a chain of small operations, some of which XLA hands to threads of its own.
    On one core that is a switch; on several, the step waits until another core is awake and free,
    now and then for many milliseconds. Compiling uses all cores, so `MPC.reset` comes before::

        state = mpc.reset(observation, nodes, cost)
        with pin_to_core():
            while True:
                plan, state = mpc.step(observation, contacts, state)

    Threads begun within are pinned too, and free afterwards. Where the system does not let a
    process choose its cores (macOS, Windows), nothing is done. Raises `OSError` for a core that
    the process may not use.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    before = _affinities()
    os.sched_setaffinity(0, {max(allowed) if core is None else core})
    try:
        chosen = os.sched_getaffinity(0)
        _move_threads(lambda thread: chosen)
        yield
    finally:
        _move_threads(lambda thread: before.get(thread, allowed))


@functools.lru_cache(maxsize=64)
def _pairs(count: int) -> np.ndarray:
    return pair_indices(count).T


def _padded(
    observation: Observation, name: str, capacity: int, dimension: int, dtype: np.dtype
) -> np.ndarray:
    # A copy: a robot may write its next observation into the same array during the step.
    value = np.array(observation[name], dtype)
    if value.ndim != 2 or value.shape[1] != dimension or len(value) > capacity:
        raise InvalidInputError(
            f"observation's {name} must have shape (n, {dimension}) with "
            f"n <= {capacity}, the capacity; found {value.shape}"
        )
    if len(value) == capacity:
        return value
    padded = np.zeros((capacity, dimension), dtype)
    padded[: len(value)] = value
    return padded


def _affinities() -> dict[int, set[int]]:
    """The cores that each thread of this process may use."""
    cores = {}
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # It may have ended meanwhile.
            cores[int(task.name)] = os.sched_getaffinity(int(task.name))
    return cores


def _move_threads(cores: Callable[[int], set[int]]) -> None:
    """Until none is left that a thread began before it was moved itself, whose cores it has."""
    moved = set[int]()
    while found := _affinities().keys() - moved:
        for thread in found:
            with suppress(ProcessLookupError):
                os.sched_setaffinity(thread, cores(thread))
        moved |= found

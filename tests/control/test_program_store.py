"""Stored programs: read by a new function, equal to the traced ones, never those of another."""

from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.bodies import geometry
from contactgraph.control import ILQR, MPC, ActiveSetMPC, chain_cost, program_store
from contactgraph.control.box_qp import ControlLimits
from contactgraph.control.program_store import stored
from contactgraph.dynamics import contact_law
from contactgraph.envs import PickupTask
from contactgraph.inference import contact_belief
from contactgraph.model import (
    load_model,
    scene_nodes,
    shipped_model,
)

LIMITS = ControlLimits(jnp.zeros(2), jnp.ones(2))
Step = Callable[[Any, jax.Array], Any]


class Foreign(eqx.Module):
    """A class of this test, whose source has no hash."""

    value: jax.Array


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """An empty folder where JAX is told to keep programs."""
    if not jax.__version__.startswith(program_store._RELEASES):
        pytest.skip(f"nothing is kept with JAX {jax.__version__}")
    settings: Any = jax.config
    before = settings.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def program(static: Any = (1, "a"), like: int | None = 0) -> tuple[Step, list[int]]:
    """A new function, and a list that grows by one with each trace of it."""
    traces: list[int] = []

    def call(carry: Any, x: jax.Array) -> Any:
        traces.append(1)
        return jax.tree.map(lambda leaf: leaf + jnp.sum(x), carry)

    return jax.jit(stored(call, static, like)), traces


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("traced/*/*") if path.is_file())


@pytest.mark.parametrize("static", [(1, "a"), (jax.nn.relu, eqx.nn.Identity, np.ones(2))])
def test_a_new_function_reads_the_program(folder: Path, static: Any) -> None:
    first, traces = program(static)
    made = first(LIMITS, jnp.ones(3))
    again, no_traces = program(static)
    read = again(LIMITS, jnp.ones(3))
    assert (len(traces), len(no_traces), len(files(folder))) == (1, 0, 1)
    assert isinstance(read, ControlLimits)
    np.testing.assert_array_equal(read.upper, made.upper)
    np.testing.assert_array_equal(read.upper, [4.0, 4.0])


def test_what_differs_is_another_program(folder: Path) -> None:
    different = [
        ((1, "a"), LIMITS, jnp.ones(3)),
        ((1, np.zeros(2)), LIMITS, jnp.ones(3)),
        ((1, jax.nn.relu), LIMITS, jnp.ones(3)),
        ((1, "a"), LIMITS, jnp.float32(2.0)),
        ((2, "a"), LIMITS, jnp.ones(3)),
        ((True, "a"), LIMITS, jnp.ones(3)),
        ([1, "a"], LIMITS, jnp.ones(3)),
        ((1, np.ones(2)), LIMITS, jnp.ones(3)),
        ((1, jax.nn.silu), LIMITS, jnp.ones(3)),
        ((1, "a"), LIMITS, jnp.ones(4)),
        ((1, "a"), LIMITS, jnp.ones(3, jnp.int32)),
        ((1, "a"), LIMITS, 2.0),
        ((1, "a"), (LIMITS.lower, LIMITS.upper), jnp.ones(3)),
    ]
    for count, (static, carry, x) in enumerate(different, start=1):
        another, traces = program(static)
        another(carry, x)
        assert (len(traces), len(files(folder))) == (1, count), (static, x)


@pytest.mark.parametrize(
    ("setting", "value"), [("jax_default_matmul_precision", "highest"), ("jax_enable_x64", True)]
)
def test_with_other_settings_it_is_another_program(folder: Path, setting: str, value: Any) -> None:
    program()[0](LIMITS, jnp.ones(3))
    before = getattr(jax.config, setting)
    another, traces = program()
    try:
        jax.config.update(setting, value)
        another(LIMITS, jnp.ones(3, jnp.float32))
    finally:
        jax.config.update(setting, before)
    assert len(traces) == 1 and len(files(folder)) == 2


@pytest.mark.parametrize("content", [b"", bytes(500), "half", "flipped", "another"])
def test_a_damaged_file_is_written_again(folder: Path, content: bytes | str) -> None:
    program()[0](LIMITS, jnp.ones(4))
    (other,) = files(folder)
    program()[0](LIMITS, jnp.ones(3))
    (path,) = set(files(folder)) - {other}
    whole = path.read_bytes()
    damaged = {"half": whole[: len(whole) // 2], "another": other.read_bytes()}
    damaged["flipped"] = bytes([*whole[:-200], whole[-200] ^ 1, *whole[-199:]])
    path.write_bytes(content if isinstance(content, bytes) else damaged[content])
    for traced in (1, 0):
        again, traces = program()
        np.testing.assert_array_equal(again(LIMITS, jnp.ones(3)).upper, [4.0, 4.0])
        assert len(traces) == traced
    assert len(path.read_bytes()) == len(whole)


@pytest.mark.parametrize(
    ("static", "carry", "like"),
    [
        (lambda: 1, LIMITS, 0),
        (jax.vmap(jax.nn.relu), LIMITS, 0),
        (Foreign(jnp.ones(2)), LIMITS, 0),
        ((1, jnp.ones(2)), LIMITS, 0),
        ((1, "a"), Foreign(jnp.ones(2)), 0),
        ((1, "a"), LIMITS, 1),
    ],
    ids=["local", "wrapped", "foreign", "array", "foreign argument", "another structure"],
)
def test_what_has_no_name_is_not_kept(folder: Path, static: Any, carry: Any, like: int) -> None:
    for _ in range(2):
        step, traces = program(static, like)
        made = step(carry, jnp.ones(3))
        assert traces and not files(folder)
        expected: Any = jax.tree.structure(carry)
        assert jax.tree.structure(made) == expected


@pytest.mark.parametrize("call", [jnp.linalg.cholesky, jax.debug.callback])
def test_what_calls_outside_of_the_program_is_not_kept(folder: Path, call: Any) -> None:
    """A process that reads a program does not register the targets of its calls."""
    seen: list[np.ndarray] = []

    def step(x: jax.Array) -> jax.Array:
        made = call(seen.append, x) if call is jax.debug.callback else call(x)
        return x if made is None else made

    for _ in range(2):
        np.testing.assert_array_equal(jax.jit(stored(step, 1, 0))(jnp.eye(2)), np.eye(2))
    jax.effects_barrier()
    assert not files(folder) and len(seen) == (2 if call is jax.debug.callback else 0)


def test_without_a_likeness_the_first_result_is_traced(folder: Path) -> None:
    for traced in (2, 1):
        step, traces = program(like=None)
        for count in (3, 4):
            np.testing.assert_array_equal(step(LIMITS, jnp.ones(count)).lower, [count, count])
        assert len(traces) == traced and len(files(folder)) == 1


@pytest.mark.parametrize(
    ("module", "name"),
    [(geometry, "geometry"), (contact_law, "pin_contacts"), (contact_belief, "correct")],
)
def test_a_function_that_is_rebound_is_traced(
    folder: Path, monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str
) -> None:
    program()[0](LIMITS, jnp.ones(3))
    monkeypatch.setattr(module, name, lambda *_: None)
    step, traces = program()
    step(LIMITS, jnp.ones(3))
    assert traces


def test_few_states_of_the_source_remain(folder: Path) -> None:
    for state in range(6):
        (folder / "traced" / f"{state}").mkdir(parents=True)
    program()[0](LIMITS, jnp.ones(3))
    assert len(list((folder / "traced").iterdir())) == 4 and len(files(folder)) == 1


def without_the_writer(*_: Any) -> None:
    raise ImportError("Please install 'flatbuffers'")


@pytest.mark.parametrize(
    "spoil",
    [
        lambda folder, patch: jax.config.update("jax_compilation_cache_dir", None),
        lambda folder, patch: jax.config.update("jax_compilation_cache_dir", "gs://bucket"),
        lambda folder, patch: (folder / "traced").write_text("a file"),
        lambda folder, patch: patch.setattr(program_store, "_RELEASES", ("0.9.",)),
        lambda folder, patch: patch.setattr(jax.export.Exported, "serialize", without_the_writer),
    ],
    ids=["no folder", "another machine's", "not writable", "unknown release", "no writer"],
)
def test_where_nothing_can_be_kept_programs_are_traced(
    folder: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Path, pytest.MonkeyPatch], Any]
) -> None:
    monkeypatch.chdir(folder)
    spoil(folder, monkeypatch)
    step, traces = program()
    np.testing.assert_array_equal(step(LIMITS, jnp.ones(3)).upper, [4.0, 4.0])
    assert traces and not files(folder) and not (folder / "gs:").exists()


def plans(mpc: ActiveSetMPC) -> list[np.ndarray]:
    """All that three control steps carry, among five distractors."""
    task = PickupTask(distractors=5)
    observation, _ = task.reset(seed=0)
    terms = task.cost_terms()
    weights = terms.pick_weights, terms.goal_weights, terms.control_weight
    cost = chain_cost(terms.chain, *weights, observation["goal"], task.scene.node_count)
    state = mpc.reset(observation, scene_nodes(task.scene), cost)
    found = []
    for _ in range(3):
        plan, state = mpc.step(observation, observation["contact"], state)
        found += [np.asarray(leaf) for leaf in jax.tree.leaves(state.carry)]
        observation, *_ = task.step(np.asarray(plan.controls[0]))
    return found


def test_a_controller_plans_the_same(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Its results are not committed to a device: a later step would compile again."""
    model = load_model(shipped_model("pickup")).model
    found, compiled = [], []
    for setting in (None, str(folder), str(folder)):
        jax.config.update("jax_compilation_cache_dir", setting)
        caplog.clear()
        with jax.log_compiles():
            found.append(plans(ActiveSetMPC(MPC(model, ILQR(horizon=4, iterations=2)))))
        compiled.append([line for line in caplog.messages if line.startswith("Compiling")])
    # A step for each of two sizes, and a second first carry.
    assert len(files(folder)) == 3
    (traced, _, read), (expected, _, again) = found, compiled
    # The same arguments, too: one that is not used would be passed in each step.
    assert again and set(again) <= set(expected)
    assert len(read) == len(traced)
    for one, other in zip(read, traced, strict=True):
        np.testing.assert_array_equal(one, other)

"""All threads of the process on one core, and back."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from contactgraph.control import compile_small_loops, host, pin_to_core

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="the system does not let a process choose among cores",
)


class Waiting:
    """A thread that waits until the end of the context."""

    def __init__(self):
        self.done = threading.Event()
        self.thread = threading.Thread(target=self.done.wait)
        self.thread.start()

    def __enter__(self):
        return self.thread.native_id

    def __exit__(self, *raised):
        self.done.set()
        self.thread.join()


def cores():
    return [os.sched_getaffinity(int(task.name)) for task in Path("/proc/self/task").iterdir()]


def test_all_threads_share_one_core_within_and_are_back_afterwards():
    allowed = os.sched_getaffinity(0)
    with Waiting() as older, Waiting() as kept:
        os.sched_setaffinity(kept, {min(allowed)})
        with pin_to_core():
            assert all(each == {max(allowed)} for each in cores())
            assert os.sched_getaffinity(older) == {max(allowed)}
        assert os.sched_getaffinity(0) == os.sched_getaffinity(older) == allowed
        assert os.sched_getaffinity(kept) == {min(allowed)}


def test_a_thread_begun_within_is_free_afterwards():
    allowed = os.sched_getaffinity(0)
    with pin_to_core(min(allowed)):
        begun = Waiting()
        assert os.sched_getaffinity(begun.thread.native_id) == {min(allowed)}
    with begun as thread:
        assert os.sched_getaffinity(thread) == allowed


def test_a_thread_that_another_begins_meanwhile_is_freed(monkeypatch: pytest.MonkeyPatch):
    """It is not listed yet where the others are freed, and has the core of its own beginner."""
    allowed, listed, calls = os.sched_getaffinity(0), host._affinities, []
    with pin_to_core(min(allowed)):
        begun = Waiting()

        def late():
            calls.append(listed())
            hidden = {begun.thread.native_id} if len(calls) == 1 else set()
            return {thread: calls[-1][thread] for thread in calls[-1].keys() - hidden}

        monkeypatch.setattr(host, "_affinities", late)
    with begun as thread:
        assert os.sched_getaffinity(thread) == allowed


def test_an_error_within_frees_them_too():
    allowed = os.sched_getaffinity(0)
    with pytest.raises(ZeroDivisionError), pin_to_core():
        raise ZeroDivisionError
    assert all(each == allowed for each in cores())


def test_a_core_that_is_not_there_is_an_error():
    allowed = os.sched_getaffinity(0)
    with pytest.raises(OSError), pin_to_core(9999):
        pass
    assert os.sched_getaffinity(0) == allowed


LOOP = """
import jax, jax.numpy as jnp
from contactgraph.control import compile_small_loops
{call}
from contactgraph.control.host import loop_options

def roll(x):
    rows = jnp.ones((20, 40, 40)) / 40
    return jax.lax.scan(lambda x, row: (jnp.tanh(row @ x), jnp.sum(x)), x, rows)

compiled = jax.jit(roll, compiler_options=loop_options()).lower(jnp.ones(40)).compile()
print("xla_cpu_small_call" in compiled.as_text(), float(compiled(jnp.ones(40))[1].sum()))
"""


def compiled_loop(call):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": ""}
    program = [sys.executable, "-c", LOOP.format(call=call)]
    found = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    small, total = found.stdout.split()
    return small == "True", float(total)


def test_a_loop_of_a_plan_is_one_kernel_where_that_is_asked_for():
    small, total = compiled_loop("compile_small_loops()")
    listed, same = compiled_loop("")
    assert small and not listed
    assert total == pytest.approx(same, rel=1e-5)


def test_options_of_xla_that_are_set_stay(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    compile_small_loops()
    flags = os.environ["XLA_FLAGS"].split()
    assert flags[0] == "--xla_cpu_enable_fast_math=false" and len(flags) == 2
    compile_small_loops()
    assert os.environ["XLA_FLAGS"].split() == flags

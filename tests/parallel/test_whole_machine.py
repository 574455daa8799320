"""Work that needs all of a machine: one unit at a time, each in a new process."""

import multiprocessing
import os

from contactgraph.parallel import LocalExecutor, map_in_order


def shout(connection) -> None:
    connection.send(os.getppid())


def begin():
    def work(index: int):
        # A subprocess, which workers of other executors may not start.
        ours, theirs = multiprocessing.Pipe()
        child = multiprocessing.get_context("spawn").Process(target=shout, args=(theirs,))
        child.start()
        parent = ours.recv()
        child.join()
        return index, parent, os.getpid(), len(os.sched_getaffinity(0))

    return work


def test_every_unit_has_a_new_process_all_cores_and_children():
    answers = list(map_in_order(LocalExecutor(whole_machine=True), begin, range(2)))
    assert [index for index, *_ in answers] == [0, 1]
    assert all(parent == process for _, parent, process, _ in answers)
    assert len({process for _, _, process, _ in answers}) == 2
    assert {cores for *_, cores in answers} == {len(os.sched_getaffinity(0))}
    assert multiprocessing.active_children() == []

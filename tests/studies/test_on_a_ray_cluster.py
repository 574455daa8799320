"""A Ray cluster of several nodes on this machine, one of which is killed: no job is lost
or repeated, and the data are the same."""

import os
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from fake_worker import FakeWorker, done

from contactgraph import parallel
from contactgraph.cli import main as cli
from contactgraph.data import InvalidInputError
from contactgraph.parallel import map_in_order
from contactgraph_studies.job import Job, JobRecords, in_dependency_order
from contactgraph_studies.runner import Failure, Progress, run_jobs

pytest.importorskip("ray", reason="Ray is not installed: pip install 'contactgraph[cluster]'")

from ray.cluster_utils import Cluster

from contactgraph import ray_cluster
from contactgraph.ray_cluster import RayExecutor, connected

# Ray starts its processes by fork, of which JAX warns where tests before used it.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:os.fork"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def nodes() -> Iterator[Cluster]:
    """A head that does no work, and two nodes of a core each. They know the tests' modules."""
    # Found dead in two seconds, not in 15.
    reported = {"health_check_period_ms": 500, "health_check_failure_threshold": 3}
    head = {"num_cpus": 0, "_system_config": reported}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        cluster = Cluster(initialize_head=True, head_node_args=head)
        try:
            for _ in range(2):
                cluster.add_node(num_cpus=1)
            yield cluster
        finally:
            cluster.shutdown()


def test_recorded_on_a_cluster_a_file_is_the_same(
    tmp_path: Path, nodes: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "_ALONE_S", 0.0)
    monkeypatch.setattr(parallel, "_START_S", 0.0)
    monkeypatch.chdir(tmp_path)
    arguments = ["collect", "pickup", "--episodes", "7", "--distractors", "2", "--mixed"]
    assert cli.run([*arguments, "--out", "a.h5", "--cluster", f"ray:{nodes.address}"]) == 0
    monkeypatch.setenv("NPROC", "1")
    assert cli.run([*arguments, "--out", "b.h5"]) == 0
    assert Path("a.h5").read_bytes() == Path("b.h5").read_bytes()


@pytest.fixture(scope="module")
def executor(nodes: Cluster) -> Iterator[RayExecutor]:
    with connected(nodes.address) as executor:
        yield executor


@dataclass(frozen=True)
class SentJob:
    """A job that can be sent to a machine."""

    refused: int = -1
    broken: int = -1

    def begin(self):
        def work(unit: int):
            time.sleep(0.02 * (6 - unit))
            if unit == self.refused:
                raise InvalidInputError(f"job {unit}: rejected")
            if unit == self.broken:
                raise KeyError("spoon")
            return unit, os.getpid()

        return work


def test_answers_come_in_order_from_the_machines(executor: RayExecutor) -> None:
    assert executor.workers == 2
    answers = list(map_in_order(executor, SentJob().begin, range(6)))
    assert [unit for unit, _ in answers] == list(range(6))
    assert os.getpid() not in dict(answers).values()


def test_errors_on_a_machine_are_raised_here(
    executor: RayExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    for sent_job, error, said in [
        (SentJob(refused=3), InvalidInputError, "^job 3: rejected$"),
        (SentJob(broken=3), RuntimeError, "(?s)in work.*KeyError: 'spoon'"),
    ]:
        with pytest.raises(error, match=said):
            list(map_in_order(executor, sent_job.begin, range(6)))
    monkeypatch.setattr(ray_cluster, "version", lambda package: "9.9")
    with pytest.raises(InvalidInputError, match=r"has contactgraph 0\.\d.*, not 9\.9 as here"):
        list(map_in_order(executor, SentJob().begin, range(6)))


def study(folder: Path, jobs: list[Job], executor: RayExecutor) -> tuple[list[Failure], list]:
    steps: list[Progress] = []
    records, begin = JobRecords(folder / "study", "1"), FakeWorker(folder).create
    return run_jobs(in_dependency_order(jobs), records, executor, begin, steps.append), steps


def test_files_are_carried_to_cells_and_back(tmp_path: Path, executor: RayExecutor) -> None:
    both = Job("deep/a", ("both", "deep/a"), "both", extra_outputs=("deep/a.more",))
    run = Job("run", ("half", "run"), "half", checkpoints="checkpoint-*")
    joined = Job("b", ("join", "b", "deep/a.more"), "join", (both,))
    bad = Job("bad", ("fail", "bad"), "fail")
    dead = Job("dead", ("die", "dead"), "die")
    failures, steps = study(tmp_path, [joined, run, bad, dead], executor)
    reported = {failure.job.output: failure.reason for failure in failures}
    assert reported.pop("dead").startswith("begun 4 times: ")
    assert reported == {
        "run": "exit code 130; it printed nothing to " + str(tmp_path / "study" / "run.log"),
        "bad": "exit code 2; contactgraph: it cannot be",
    }
    assert steps[-1].done == steps[-1].total == 5
    assert (tmp_path / "study" / "b").read_text() == "more"
    assert Counter(line.split()[0] for line in done(tmp_path)) == {
        **dict.fromkeys(("both", "join", "half", "fail"), 1),
        "die": 4,
    }
    # A partial training is sent along and resumed.
    (tmp_path / "study" / "run").mkdir()
    (tmp_path / "study" / "run" / "checkpoint-1").write_text("")
    assert study(tmp_path, [joined, run], executor)[0] == []
    assert done(tmp_path) == ["half run --resume"]
    assert (tmp_path / "study" / "run" / "checkpoint-1").exists()


def children(begun: Path) -> dict[int, int]:
    """Worker processes by their parent."""
    lines = begun.read_text().splitlines() if begun.exists() else []
    return {int(parent): int(child) for parent, child in map(str.split, lines)}


def test_a_killed_node_costs_only_its_job(
    tmp_path: Path, nodes: Cluster, executor: RayExecutor
) -> None:
    doomed = nodes.add_node(num_cpus=1)
    (raylet,) = doomed.all_processes["raylet"]

    def kill() -> None:
        """A machine that is gone leaves neither Ray's process nor workers."""
        while (worker := children(tmp_path / "begun.txt").get(raylet.process.pid)) is None:
            time.sleep(0.02)
        nodes.remove_node(doomed, allow_graceful=False)
        os.kill(worker, signal.SIGKILL)
        (tmp_path / "go.txt").write_text("")

    jobs = [Job(f"{n}", ("wait", f"{n}", f"{n}"), "wait") for n in range(9)]
    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    failures, steps = study(tmp_path, jobs, executor)
    killer.join()
    assert failures == []
    assert [(tmp_path / "study" / f"{n}").read_text() for n in range(9)] == list("012345678")
    assert sorted(step.last.output for step in steps) == list("012345678"), "each reported once"
    times = Counter(done(tmp_path))
    assert sorted(times.values()) == [1] * 8 + [2], "one was done again"
    assert study(tmp_path, jobs, executor) == ([], [])
    assert done(tmp_path) == []


def test_ctrl_c_keeps_finished_jobs(tmp_path: Path, executor: RayExecutor) -> None:
    jobs = [Job(f"{n}", ("make", f"{n}"), "make") for n in range(4)]

    def interrupted(progress: Progress) -> None:
        raise KeyboardInterrupt

    begin, records = FakeWorker(tmp_path).create, JobRecords(tmp_path / "study", "1")
    with pytest.raises(KeyboardInterrupt):
        run_jobs(jobs, records, executor, begin, interrupted)
    (made,) = (job.output for job in jobs if records.seconds(job) is not None)
    assert study(tmp_path, jobs, executor)[0] == []
    assert done(tmp_path).count(f"make {made}") == 1


@pytest.fixture
def silent() -> Iterator[int]:
    """A port without a server."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.mark.parametrize(
    ("cluster", "said"),
    [
        ("slurm", "--cluster must be one of local, ray; found 'slurm'"),
        ("local:4", "--cluster: local takes no address, found '4'"),
        ("ray:", "a cluster's address must be HOST:PORT, found ''"),
        ("ray:here", "a cluster's address must be HOST:PORT, found 'here'"),
        ("ray:localhost:1", "no Ray cluster answers at localhost:1 (Connection refused); one is "),
        ("ray:127.0.0.1:SILENT", "no Ray cluster answers at 127.0.0.1:SILENT (timed out); one is "),
    ],
)
def test_mistakes(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    silent: int,
    cluster: str,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ray_cluster, "_ANSWER_S", 0.1)
    cluster, said = (text.replace("SILENT", str(silent)) for text in (cluster, said))
    assert cli.run(["reproduce", "door", "--out", "study", "--cluster", cluster]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"contactgraph: {said}")
    assert list(tmp_path.iterdir()) == []


def test_without_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "contactgraph.ray_cluster")
    arguments = ["collect", "pickup", "--out", str(tmp_path / "x.h5"), "--cluster", "ray"]
    assert cli.run(arguments) == 2
    assert capsys.readouterr().err == (
        "contactgraph: a cluster needs Ray: pip install 'contactgraph[cluster]', here and on its "
        "machines\n"
    )

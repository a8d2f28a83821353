"""Tasks on a real scheduler with two worker processes, one of which is killed in the middle."""

import os
import pickle
import signal
import socket
import threading
import time

import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.sims import fanout
from spinndrift.sims.fanout import check_workers, run_on_cluster
from spinndrift.sims.study.config import scaled
from spinndrift.sims.study.run import StudyWork

LIMIT = 35.0


def make_work(folder):
    """Work that notes each attempt; `victim` waits to be killed the first time."""
    folder = str(folder)

    def work(task):
        import os
        import time
        from pathlib import Path

        attempt = len(list(Path(folder).glob(f"{task}-*.begun"))) + 1
        (Path(folder) / f"{task}-{attempt}.begun").write_text(str(os.getpid()))
        if task == "wrong":
            raise RuntimeError("no good")
        if task == "victim" and attempt == 1:
            time.sleep(60)
        (Path(folder) / f"{task}.done").touch()

    return work


@pytest.fixture(scope="module")
def cluster():
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address="127.0.0.1:0",
        host="127.0.0.1",
    ) as local:
        yield local


def test_a_killed_worker_costs_its_task_alone(cluster, tmp_path):
    killed = []

    def kill():
        path, until = tmp_path / "victim-1.begun", time.monotonic() + LIMIT
        while time.monotonic() < until:
            if path.exists() and path.read_text():
                killed.append(int(path.read_text()))
                os.kill(killed[0], signal.SIGKILL)
                return
            time.sleep(0.05)

    thread = threading.Thread(target=kill)
    thread.start()
    began, told = time.monotonic(), []
    tasks = ["a", "victim", "b", "c", "wrong"]
    failed = run_on_cluster(
        make_work(tmp_path),
        tasks,
        lambda fraction, remark="", /: told.append(fraction),
        address=cluster.scheduler_address,
    )
    thread.join()
    assert time.monotonic() - began < LIMIT
    assert killed
    assert [(f.task, f.reason) for f in failed] == [("wrong", "RuntimeError: no good")]
    assert {p.name for p in tmp_path.glob("*.done")} == {f"{t}.done" for t in tasks[:4]}
    attempts = {t: len(list(tmp_path.glob(f"{t}-*.begun"))) for t in tasks}
    assert attempts == {"a": 1, "victim": 2, "b": 1, "c": 1, "wrong": 1}
    assert told[-1] == 1.0
    assert told == sorted(told)


def test_bad_input_on_a_worker_ends_the_study(cluster):
    def work(task):
        from spinndrift.models.config.errors import UserError

        raise UserError(f"{task}: was made with other settings")

    with pytest.raises(UserError, match="other settings"):
        run_on_cluster(
            work, ["a"], lambda fraction, remark="", /: None, address=cluster.scheduler_address
        )


def test_an_address_without_a_scheduler_is_one_sentence(monkeypatch):
    """No client is left behind, whose own end would take longer and print an error of its own."""
    monkeypatch.setattr(fanout, "_PATIENCE", 0.5)
    monkeypatch.setattr("distributed.Client", None)
    with socket.create_server(("127.0.0.1", 0)) as server:  # listens, and is no scheduler
        for address in (f"tcp://127.0.0.1:{server.getsockname()[1]}", "nope", "tcp://a:b:c"):
            with pytest.raises(UserError, match=f"--cluster {address}: no scheduler answers there"):
                check_workers(address, 0)


def test_what_workers_are_sent_survives_the_way():
    work = StudyWork(scaled("tiny"), "/somewhere")
    assert pickle.loads(pickle.dumps(work)) == work

"""Tasks on workers: all are done once, whatever becomes of the workers."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.executors import Workers, run_tasks


def square(number: int) -> int:
    return number * number


def die_once(marker: str) -> int:
    """Kills its own process, as a machine out of memory does, unless it has done so before."""
    path = Path(marker)
    if path.suffix == ".dies" and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def die(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def refuse(number: int) -> int:
    raise FrameError("it is damaged", where=f"frame {number}", fix="mend it")


def test_tasks_in_this_process_are_done_in_order():
    assert list(run_tasks(Workers(), square, [3, 1, 2])) == [(3, 9), (1, 1), (2, 4)]
    assert not list(run_tasks(Workers(2), square, []))


def test_without_dask_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(JaxmapError, match=r"Dask is not installed.*pip install 'jaxmap\[cluster\]'"):
        list(run_tasks(Workers(scheduler="tcp://127.0.0.1:1"), square, [1]))


@pytest.mark.slow
def test_tasks_of_a_killed_process_run_again(tmp_path):
    tasks = [str(tmp_path / name) for name in ("a", "b.dies", "c", "d.dies", "e")]
    lines: list[str] = []
    results = dict(run_tasks(Workers(2), die_once, tasks, lines.append))
    assert results.keys() == set(tasks)
    assert os.getpid() not in results.values()
    assert any("run again" in line for line in lines)


@pytest.mark.slow
def test_a_task_that_always_kills_its_worker_is_given_up():
    with pytest.raises(JaxmapError, match="lost again and again"):
        list(run_tasks(Workers(2), die, [1, 2]))


@pytest.mark.slow
def test_errors_of_tasks_arrive_as_they_are():
    with pytest.raises(FrameError, match="it is damaged in frame 1; mend it") as caught:
        list(run_tasks(Workers(2), refuse, [1, 1]))
    assert (caught.value.what, caught.value.where, caught.value.fix) == ("it is damaged", "frame 1", "mend it")


def square_slowly(number: int) -> int:
    time.sleep(0.3)
    return number * number


@pytest.mark.slow
def test_a_scheduler_that_is_killed_and_started_again_gets_what_is_left():
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    started: list[subprocess.Popen] = []

    def start(*words: str) -> None:
        command = [sys.executable, "-m", "dask", *words, "--no-dashboard"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        started.append(subprocess.Popen(command, env=environment, **quiet))

    def start_both() -> None:
        start("scheduler", "--host", "127.0.0.1", "--port", address.rpartition(":")[2])
        start("worker", f"tcp://{address}", "--nthreads", "1", "--no-nanny")

    try:
        start_both()
        results: dict[int, int] = {}
        for task, result in run_tasks(Workers(scheduler=f"tcp://{address}"), square_slowly, range(12)):
            assert task not in results
            results[task] = result
            if len(results) == 3:
                for process in started:
                    process.kill()
                start_both()
        assert results == {number: number * number for number in range(12)}
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_workers_end_with_the_process_that_gave_the_tasks(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        textwrap.dedent(
            """
            import os, sys, time
            from pathlib import Path
            from jaxmap.host.executors import Workers, run_tasks

            def wait(name):
                Path(name).write_text(str(os.getpid()))
                time.sleep(60)

            if __name__ == "__main__":
                list(run_tasks(Workers(2), wait, sys.argv[1:]))
            """
        )
    )
    names = [tmp_path / "one", tmp_path / "two"]
    parent = subprocess.Popen(
        [sys.executable, script, *names], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    )
    assert_soon(lambda: all(name.exists() and name.read_text() for name in names))
    parent.kill()
    parent.wait()
    assert_soon(lambda: not any(Path(f"/proc/{name.read_text()}").exists() for name in names))


def assert_soon(happened, within_s: float = 30.0) -> None:
    until_s = time.monotonic() + within_s
    while not happened():
        assert time.monotonic() < until_s
        time.sleep(0.05)

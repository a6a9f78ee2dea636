"""The runner of the tests: one that dies or hangs ends the run with its name."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

TESTS = {
    "test_a.py": "import os\ndef test_good(): pass\ndef test_dies(): os.abort()\ndef test_after(): pass\n",
    "test_b.py": "import threading\ndef test_good(): pass\ndef test_hangs(): threading.Event().wait()\n",
    "test_c.py": "def test_good(): pass\n",
}


@pytest.mark.slow
def test_a_test_that_dies_and_one_that_hangs_end_the_run_with_their_names(tmp_path):
    """Under the options of scripts/test and the settings of pyproject.toml, but for a shorter patience."""
    (options,) = re.findall(r'-m pytest (.*) "\$@"', (ROOT / "scripts" / "test").read_text())
    for name, text in TESTS.items():
        (tmp_path / name).write_text(text)
    settings = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(tmp_path), "-p", "no:cacheprovider"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options.split(), *settings, "-o", "faulthandler_timeout=2", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
        env=environment,
    )
    assert done.returncode == 1, done.stdout
    assert re.search(r"^FAILED \S*test_a\.py::test_dies - worker 'gw\d' crashed", done.stdout, re.MULTILINE), (
        done.stdout
    )
    assert re.search(r"^FAILED \S*test_b\.py::test_hangs - worker 'gw\d' crashed", done.stdout, re.MULTILINE), (
        done.stdout
    )

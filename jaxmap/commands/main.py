"""The command line: finds and runs the command; an error becomes one line and an exit status."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from jaxmap import __version__
from jaxmap.commands import COMMANDS
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.memory import restart_with_lasting_memory
from jaxmap.host.streams import lasting_streams, lost_output

LASTING_MEMORY = ("train", "tune", "segment", "perceive", "map", "demo")
"""Commands that allocate and free the memory of a network at every step: gigabytes in training, hundreds of MiB where
images are labelled. Fetching it anew from the system took a sixth of the time of labelling."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `jaxmap COMMAND ...`.

    Returns:
        0; 2 for a wrong command line or configuration; 1 for any other error; 130 when interrupted.
    """
    if arguments is None:
        lasting_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if arguments is None and words and words[0] in LASTING_MEMORY:
        restart_with_lasting_memory()
    try:
        status = _run(words)
        # Here, so that a closed pipe is noticed before Python exits.
        sys.stdout.flush()
        if (fault := lost_output()) is not None:
            _print_error(f"standard output was not written ({fault.strerror}); all files were")
            return status or 1
        return status
    except JaxmapError as error:
        if debug:
            raise
        _print_error(f"{error}")
        return error.exit_code
    except KeyboardInterrupt:
        _print_error("interrupted")
        return 130
    except BrokenPipeError:
        # The reader of our output has closed the pipe; Python must not complain about it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if debug:
            raise
        what = " ".join(str(error).split())[:300] or "no message"
        _print_error(f"{type(error).__name__}: {what}; this is a fault of jaxmap: --debug shows the traceback")
        return 1


def _run(words: Sequence[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        print(f"jaxmap {__version__}")
        return 0
    if words[0] not in COMMANDS:
        raise UsageError(f"there is no command {words[0]!r}", fix=f"choose one of {', '.join(COMMANDS)}")
    return importlib.import_module(f"jaxmap.commands.{words[0]}").main(words[1:]) or 0


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items()]
    return "\n".join(
        [
            "usage: jaxmap COMMAND [OPTIONS]",
            "",
            "Stereo images and rover poses in, a georeferenced 3D semantic voxel map out.",
            "",
            "commands:",
            *lines,
            "",
            "jaxmap COMMAND --help describes a command; --debug shows the traceback of an error.",
        ]
    )


def _print_error(line: str) -> None:
    print(f"error: {line}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())

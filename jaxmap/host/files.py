"""Files: bundled ones; reading regular files alone, within bounds; and atomic writing.

After a crash or on a full disk, a file has its old content or the new one.
"""

from __future__ import annotations

import errno
import glob
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from jaxmap.errors import JaxmapError

_PACKAGE = Path(__file__).parents[1]
_FULL = {errno.ENOSPC, errno.EDQUOT}
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}


def config_folder() -> Path:
    """The folder of configurations that come with jaxmap."""
    packaged = _PACKAGE / "configs"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "configs"


def bundled(name: str) -> Path:
    """A file or folder of data that comes with jaxmap.

    Raises:
        JaxmapError: it is not there.
    """
    path = _PACKAGE / "bundled" / name
    if not path.exists():
        raise JaxmapError(f"{name} is missing", where=path.parent, fix="install jaxmap anew")
    return path


def real_path(path: str | os.PathLike[str]) -> Path:
    """The path without links; of a link to itself, which `Path.resolve` raises at, as far as it leads."""
    return Path(os.path.realpath(path))


def check_regular(path: Path, most_bytes: int) -> None:
    """Refuses what is no regular file before it is opened: a pipe would wait for ever, a device may never end.

    Raises:
        JaxmapError: it is missing, no regular file, cannot be reached, or larger than `most_bytes`.
    """
    try:
        found = os.stat(path)
    except FileNotFoundError as fault:
        raise JaxmapError(f"there is no file {path}", fix="check the path") from fault
    except (OSError, ValueError) as fault:
        raise _read_error(fault, path) from fault
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device, pipe or socket"
        raise JaxmapError(f"the file cannot be read (it is {kind})", where=path, fix="give a regular file")
    if found.st_size > most_bytes:
        raise _too_large(path, most_bytes)


def read_bytes(path: Path, most_bytes: int, *, text: bool = False) -> bytes:
    """The content of a regular file.

    Args:
        path: the file.
        most_bytes: that it may hold.
        text: refuse a file whose first bytes hold a zero: a bag given by mistake, before gigabytes are read.

    Raises:
        JaxmapError: what `check_regular` refuses, the system refuses, or it is not text.
    """
    check_regular(path, most_bytes)
    try:
        with open(path, "rb") as file:
            data = file.read(4096)
            if not (text and b"\0" in data):
                # The size is not trusted: files of /proc have none, and others grow.
                data += file.read(most_bytes + 1 - len(data))
    except OSError as fault:
        raise _read_error(fault, path) from fault
    if text and b"\0" in data:
        raise JaxmapError("not a text file", where=path, fix="give a UTF-8 text file")
    if len(data) > most_bytes:
        raise _too_large(path, most_bytes)
    return data


def _read_error(fault: OSError | ValueError, path: Path) -> JaxmapError:
    return JaxmapError(f"the file cannot be read ({fault})", where=path, fix="check the path")


def _too_large(path: Path, most_bytes: int) -> JaxmapError:
    most = f"{most_bytes / 2**20:,.0f} MiB" if most_bytes >= 2**20 else f"{most_bytes:,} bytes"
    return JaxmapError(f"the file is larger than {most}", where=path, fix="check that it is the right one")


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, which replaces it when the block ends without an error.

    The temporary file keeps the suffix, which some writers take the format from. Missing parent folders are created.
    When the block raises, the temporary file is removed and `path` keeps its content.

    Raises:
        JaxmapError: the operating system refused (disk full, no permission, ...).
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem}.tmp-{os.getpid()}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_strays(target)
        yield temporary
        sync(temporary)
        os.replace(temporary, target)
        sync(target.parent)
    except OSError as error:
        raise write_error(error, target) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_strays(target: Path) -> None:
    """Removes temporary files of processes that were killed while writing the same file."""
    for stray in target.parent.glob(f".{glob.escape(target.stem)}.tmp-*{glob.escape(target.suffix)}"):
        process = stray.name.removeprefix(f".{target.stem}.tmp-").removesuffix(target.suffix)
        if process.isdecimal() and not is_alive(int(process)):
            stray.unlink(missing_ok=True)


def is_alive(process: int) -> bool:
    """Whether a process of this machine runs."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def sync(path: Path) -> None:
    """Waits until a file, or the entries of a folder, have reached the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some file systems cannot sync a folder.
        if error.errno != errno.EINVAL:
            raise
    finally:
        os.close(handle)


def write_error(error: OSError, where: object) -> JaxmapError:
    """An error for a failure of the operating system while writing `where`."""
    if error.errno in _FULL:
        return JaxmapError("disk full", where=where, fix="free some space or write to another disk")
    if error.errno in _REFUSED:
        return JaxmapError("no permission to write", where=where, fix="check its owner or write somewhere else")
    reason = error.strerror or str(error) or type(error).__name__
    return JaxmapError(f"writing failed ({reason})", where=where, fix="check the path and the disk")

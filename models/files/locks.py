"""Locks between processes, released when the process ends, even if it is killed."""

import errno
import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..config.errors import UserError

_BUSY = (errno.EAGAIN, errno.EACCES)
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
_log = logging.getLogger(__name__)


class BusyError(UserError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path, called: str | None) -> Iterator[None]:
    """Hold the lock of the file `path`, which is made if missing and removed when the block ends.

    The operating system keeps the lock (flock; on NFS with its server, so between machines too)
    and releases it when the process ends, so a file left by a killed process does not block.
    On a file system without locks the block runs without one, and a warning is logged.

    Args:
        path: an empty lock file, in an existing folder.
        called: beginning of the message if another process holds the lock; None waits for it.

    Raises:
        BusyError: another process holds the lock.
    """
    handle = _open(path, called)
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # while it is held: a process that opened it before finds it removed
        os.close(handle)


def _open(path: Path, called: str | None) -> int:
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if called is None else fcntl.LOCK_NB))
            if _still_there(handle, path):
                return handle
        except OSError as error:
            if error.errno in _NO_LOCKS:
                _log.warning(f"{path.parent}: has no file locks, so take care that no other "
                             "command writes there")  # fmt: skip
                return handle
            os.close(handle)
            if error.errno in _BUSY:
                raise BusyError(
                    f"{called}: another spinndrift command is writing there; wait until it has "
                    "ended, or name another place"
                ) from error
            raise
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _still_there(handle: int, path: Path) -> bool:
    """Whether the file that was opened has not been removed in the meantime."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False

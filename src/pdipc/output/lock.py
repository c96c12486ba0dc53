"""One writer for a run folder: a lock that the system releases when its holder dies, however that happens.

The file's words say who holds it; it stays when the lock is released. Locks of this kind also hold between machines that share a
disk over a network with locks (NFS from version 4 on, SMB). On a disk without any the words are all there is: who is alive on this
machine is believed, and so is who is on another one.
"""

import errno
import os
import socket
from pathlib import Path
from typing import BinaryIO

import psutil

NAME = "run.lock"
FAR = 1 << 30  # the byte that Windows locks; the words before it stay readable
HELD = {errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK}
UNSUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP}


class LockedError(RuntimeError):
    """The folder has a writer; the message says which."""


class Lock:
    """Holds `folder`/run.lock from its making to `release`, at the latest to the end of the process.

    Raises LockedError where another writer, of this process or another one, holds it; OSError where the file cannot be written.
    """

    def __init__(self, folder: Path):
        path = folder / NAME
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise OSError(errno.EINVAL, "it is no regular file", str(path))
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115  (held for as long as the lock is)
        try:
            _take(self._file, path)
            self._file.truncate(0)
            self._file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
        except BaseException:
            self._file.close()
            raise

    def release(self) -> None:
        """Lets others write; a second call does nothing."""
        if self._file.closed:
            return
        try:
            self._file.truncate(0)
            _free(self._file)
        finally:
            self._file.close()


def _take(file: BinaryIO, path: Path) -> None:
    words = path.read_text(errors="replace").strip()
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(FAR)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        else:
            import fcntl

            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in HELD:
            raise LockedError(f"{path.parent} is being written by {words or 'another process'}") from None
        if error.errno not in UNSUPPORTED:
            raise
        if _alive(words):
            raise LockedError(
                f"{path.parent} is being written by {words}, as far as can be told on a disk without locks; "
                f"if that has ended, delete {path}"
            ) from None


def _free(file: BinaryIO) -> None:
    """Also where a fork has left the file open in another process."""
    if os.name != "nt":
        import fcntl

        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_UN)
        except OSError as error:
            if error.errno not in UNSUPPORTED:
                raise


def _alive(words: str) -> bool:
    """Whether who wrote "process N on HOST" may still be at work."""
    _, _, said = words.partition("process ")
    number, _, host = said.partition(" on ")
    if not (number.isdigit() and len(number) < 20 and host) or (host == socket.gethostname() and int(number) == os.getpid()):
        return False
    return host != socket.gethostname() or psutil.pid_exists(int(number))

"""One training per folder, and an end to what dead processes left half-made in it."""

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from dataset.receipts import host_name, is_alive, make_folder, storage_errors
from labeling.errors import ConfigError

_OWNER = re.compile(r"\.(?P<host>[A-Za-z0-9-]+)-(?P<process>\d{1,9})(\.tmp)?$")


class Claim:
    """A folder for this process alone, until it is released or the process ends, in whatever way.

    It is a record lock (fcntl(2)): the operating system drops it with its process, so that a killed one leaves a file
    but no claim, and forked children do not inherit it. A file system that knows no locks grants every claim.

    Raises:
        ConfigError: another living process has it.
        StorageError: the folder cannot be made or written to.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / ".claim"
        with storage_errors(folder):
            self._made = [one for one in (folder, *folder.parents) if not one.exists()]
            make_folder(folder)
            self._file = self._locked()
            self._file.truncate(0)
            self._file.write(f"process {os.getpid()} on {host_name()}")
            self._file.flush()

    def _locked(self) -> TextIO:
        while True:
            file = self._path.open("a+", encoding="utf-8")
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError) as error:
                file.seek(0)
                holder = file.read().strip() or "another process"
                file.close()
                raise ConfigError(
                    f"{self._path.parent} is in use: {holder} trains there; let it end, or give another --out"
                ) from error
            except OSError:
                return file  # no locks here
            # Its holder may have released it, and with it the file, between our two calls.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), self._path.stat()):
                    return file
            file.close()

    def release(self) -> None:
        """Give the folder free; it goes too, where it was made for the claim and nothing was written to it."""
        if self._file.closed:
            return
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        self._file.close()
        with contextlib.suppress(OSError):
            for folder in self._made:
                folder.rmdir()


def owner() -> str:
    """The end of a name that only this process gives: host and process."""
    return f"{host_name()}-{os.getpid()}"


def sweep(leftovers: Iterable[Path]) -> None:
    """Remove what has no living owner in its name; processes of other hosts may live, so theirs stays."""
    for path in leftovers:
        told = _OWNER.search(path.name)
        if told is not None and (told["host"] != host_name() or is_alive(int(told["process"]))):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()

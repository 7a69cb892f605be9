"""Faults: `Calls` numbers every call that changes a folder and makes one of them go wrong; `Disk`
knows what a power cut would leave."""

import errno
import io
import os
import sqlite3
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

ON_PATHS = ("open", "replace", "rename", "mkdir", "unlink", "rmdir", "link")
ON_DESCRIPTORS = ("close", "write", "pwrite", "fsync", "ftruncate")


class Killed(BaseException):
    """Ends a simulated process: no later call does anything."""


@dataclass(frozen=True)
class Call:
    """A system call, a file that Zarr makes (`create`), or a step of SQLite."""

    number: int
    name: str
    path: str


Fault = type[Killed] | int | float | None  # kill; errno; share of a short write; no fault


class Calls:
    """While entered, records the calls of this process that change a folder or anything in it.

    `fault(call)` decides before each call what goes wrong: a kill (a write is then half done), an
    error, a short write, or nothing. `after(call)` follows each call that was made.
    """

    def __init__(
        self,
        folder: Path,
        fault: Callable[[Call], Fault] = lambda call: None,
        after: Callable[[Call], None] = lambda call: None,
    ) -> None:
        self.folder, self.fault, self.after = str(folder), fault, after
        self.made: list[Call] = []
        self.dead = False
        self._paths: dict[int, str] = {}  # of open descriptors
        self._lock = threading.RLock()

    def __enter__(self) -> "Calls":
        self._real = {name: getattr(os, name) for name in (*ON_PATHS, *ON_DESCRIPTORS)}
        for name, real in self._real.items():
            setattr(os, name, partial(self._call, name, real))
        self._connect, self._open = sqlite3.connect, io.open
        sqlite3.connect = self._connected  # type: ignore[assignment]
        io.open = self._opened  # type: ignore[assignment]
        return self

    def __exit__(self, *_: object) -> None:
        for name, real in self._real.items():
            setattr(os, name, real)
        sqlite3.connect, io.open = self._connect, self._open
        for descriptor in self._paths:  # what the system does for a process that is no more
            os.close(descriptor)
        self._paths.clear()

    def _where(self, name: str, args: tuple, kwargs: dict) -> str | None:
        """The path that a call changes, if it is in the folder."""
        if name in ON_DESCRIPTORS:
            return self._paths.get(args[0])
        base = self._paths.get(kwargs.get("dir_fd"), "")
        changed = args[1 if name == "link" else 0]
        path = os.path.abspath(os.path.join(base, os.fspath(changed)))
        return path if self._in(path) else None

    def _in(self, path: str) -> bool:
        return path == self.folder or path.startswith(self.folder + os.sep)

    def _call(self, name, real, *args, **kwargs):
        where = self._where(name, args, kwargs)
        if where is None:
            return real(*args, **kwargs)
        with self._lock:
            call, fault = self._next(name, where)
            if name in ("write", "pwrite") and (fault is Killed or isinstance(fault, float)):
                share = 0.5 if fault is Killed else fault
                args = (args[0], bytes(args[1])[: int(len(args[1]) * share) or 1], *args[2:])
                done = real(*args, **kwargs)
            elif name == "close" and fault is not Killed:  # gone, even where that fails
                del self._paths[args[0]]
                done = real(*args)
            elif fault is None or isinstance(fault, float):
                done = real(*args, **kwargs)
            self._end(fault, *([where] if name in ON_PATHS else []))
            if name == "open":
                self._paths[done] = where
            self.after(call)
            return done

    def _next(self, name: str, where: str) -> tuple[Call, Fault]:
        if self.dead:
            raise Killed
        call = Call(len(self.made), name, where)
        self.made.append(call)
        return call, self.fault(call)

    def _step(self, name: str, where: str) -> Call:
        """A step of several system calls."""
        call, fault = self._next(name, where)
        if isinstance(fault, int) and name != "create":
            error = sqlite3.OperationalError("disk I/O error, or it is full")
            full = fault == errno.ENOSPC
            error.sqlite_errorname = "SQLITE_FULL" if full else "SQLITE_IOERR"
            raise error
        self._end(fault, where)
        return call

    def _end(self, fault: Fault, *where: str) -> None:
        """Raise what the fault asks for."""
        if fault is Killed:
            self.dead = True
            raise Killed
        if isinstance(fault, int):
            raise OSError(fault, os.strerror(fault), *where)

    def _opened(self, file, mode="r", *args, **kwargs):
        if set(mode) & set("wax+") and isinstance(file, str | Path):
            where = os.path.abspath(file)
            if self._in(where):
                with self._lock:
                    self._step("create", where)
        return self._open(file, mode, *args, **kwargs)

    def _connected(self, address: str, **kwargs):
        calls, where = self, address.removeprefix("file://").partition("?")[0]

        class Connection(sqlite3.Connection):
            def __exit__(self, kind, *rest):
                with calls._lock:
                    call = calls._step("commit", where) if kind is None else None
                    left = super().__exit__(kind, *rest)
                    if call:
                        calls.after(call)
                    return left

        if self._in(where):
            with self._lock:
                self._step("connect", where)
        return self._connect(address, factory=Connection, **kwargs)


class Disk:
    """What a power cut would leave of a folder, from the calls that `Calls` reports to `after`.

    Contents are on the disk after the fsync of their file, names after the fsync of their folder,
    a commit of SQLite when it returns, and what existed at first. Without fsync a change may
    survive, wholly or, for contents, by half.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.contents: dict[int, bytes] = {}  # inode -> contents on the disk
        self.names: dict[int, dict[str, int]] = {}  # folder -> name -> inode, on the disk
        self.changes: dict[int, list[dict[str, int | None]]] = {}  # of names, without fsync
        self.seen: dict[int, dict[str, int]] = {}  # folder -> name -> inode, as it is
        for path in (folder, *folder.rglob("*")):
            self._flush(path)

    def after(self, call: Call) -> None:
        """Record a call that was made."""
        path = Path(call.path)
        if call.name in ("fsync", "commit") and path.exists():
            self._flush(path)
        if path.parent.is_dir() and call.name != "commit":
            self._look(path.parent)

    def _flush(self, path: Path) -> None:
        inode = os.lstat(path).st_ino
        if path.is_dir():
            self.names[inode] = self.seen[inode] = _listing(path)
            self.changes[inode] = []
        else:
            self.contents[inode] = path.read_bytes()

    def _look(self, folder: Path) -> None:
        inode, now = os.lstat(folder).st_ino, _listing(folder)
        before = self.seen.get(inode, {})
        change = {n: now.get(n) for n in now.keys() | before if now.get(n) != before.get(n)}
        if change:
            self.changes.setdefault(inode, []).append(change)
        self.seen[inode] = now

    def left(self, survives: Callable[[], bool]) -> dict[str, bytes | None]:
        """The files with contents, and folders (None), after a power cut now.

        `survives()` decides for each change without fsync.
        """
        live = {os.lstat(p).st_ino: p for p in (self.folder, *self.folder.rglob("*"))}
        return dict(self._below(os.lstat(self.folder).st_ino, "", survives, live))

    def _below(self, inode: int, place: str, survives: Callable[[], bool], live: dict):
        now = live.get(inode)
        if inode in self.names or inode in self.seen or (now and now.is_dir()):
            yield place, None
            names: dict[str, int | None] = dict(self.names.get(inode, {}))
            for change in self.changes.get(inode, []):
                if survives():
                    names |= change
            for name, one in names.items():
                if one is not None:
                    yield from self._below(one, f"{place}/{name}", survives, live)
            return
        content = self.contents.get(inode, b"")
        whole = now.read_bytes() if now else content
        if whole != content and survives():
            content = whole if survives() else whole[: len(whole) // 2]
        yield place, content


def build(left: dict[str, bytes | None], target: Path) -> None:
    """Write the files that a power cut left."""
    for place, content in left.items():
        path = Path(f"{target}{place}")
        if content is None:
            path.mkdir()
        else:
            path.write_bytes(content)


def _listing(folder: Path) -> dict[str, int]:
    with os.scandir(folder) as entries:
        return {entry.name: entry.inode() for entry in entries}


def refusing(number: int) -> Callable[..., None]:
    """A system call that answers with an error, as a file system does that lacks it."""

    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return refuse

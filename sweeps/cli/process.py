"""The process of a command: it starts and ends without work that helps nobody.

Streams, locale and PYTHONWARNINGS are those of the user's other programs: they end no command.
"""

import atexit
import codecs
import gc
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn


@contextmanager
def importing() -> Iterator[None]:
    """Import large packages inside, a fifth of a second faster."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy would start a thread for each core
    gc.disable()  # imported objects stay: the collector would scan them and free nothing
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


class _Stream(io.TextIOWrapper):
    """A stream that raises nothing: on a full disk, or without a reader, its text alone is lost."""

    lost: OSError | None = None

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self.lost = error
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self.lost = error


def _encode_any(error: UnicodeError) -> tuple[bytes, int]:
    """What the locale can't encode: the bytes of a file name as they were, letters as \\xe9."""
    assert isinstance(error, UnicodeEncodeError)
    letters = error.object[error.start : error.end]
    encoded = (
        os.fsencode(c) if "\udc80" <= c <= "\udcff" else c.encode("ascii", "backslashreplace")
        for c in letters
    )
    return b"".join(encoded), error.end


def use_any_streams() -> None:
    """Make stdout and stderr usable, in any locale, also where the shell has closed them.

    A closed descriptor gets /dev/null: else the next file that is opened would get its number, and
    what a library prints would be written into that file.
    """
    codecs.register_error(_encode_any.__name__, _encode_any)
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, this one
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name) or os.fdopen(descriptor, "w")
        usable = _Stream(
            stream.detach(),
            stream.encoding,
            _encode_any.__name__,
            line_buffering=stream.line_buffering,
            write_through=stream.write_through,
        )
        setattr(sys, name, usable)


def forget_other_programs() -> None:
    """Drop variables that are for the user's other work: they would change or end ours.

    `ZARR_DEFAULT_ZARR_FORMAT=2` ends a run, GIT_DIR names another program's revision, and a
    notebook's MPLBACKEND may not exist here.
    """
    for name in [name for name in os.environ if name.startswith(("ZARR_", "GIT_"))]:
        del os.environ[name]
    os.environ["MPLBACKEND"] = "agg"  # draws into files


def show_warnings_once() -> None:
    """Print each warning for users once, as one line on stderr, whatever PYTHONWARNINGS says."""
    shown = set()

    def show(message: Warning | str, *_: object, **__: object) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            print(f"fic-sweep: warning: {message}", file=sys.stderr)

    warnings.resetwarnings()
    for category in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
        warnings.simplefilter("ignore", category)
    warnings.showwarning = show


def exit_with(command: Callable[[], int]) -> NoReturn:
    """Run a command and exit with the code it returns, or 1 if it raises or its output is lost.

    Exit handlers run and stdout is flushed. Python would then take all imported modules apart, for
    a quarter of a second: the process ends before that.
    """
    use_any_streams()
    code = 1

    def end() -> None:
        sys.stdout.flush()
        os._exit(code)

    atexit.register(end)  # before any other handler: the first to register is the last to run
    returned = command()
    sys.stdout.flush()
    lost = getattr(sys.stdout, "lost", None)
    if lost and not isinstance(lost, BrokenPipeError):  # as in `fic-sweep list | head`
        print(f"fic-sweep: stdout: {lost.strerror}", file=sys.stderr)
    code = returned or (1 if lost else 0)
    sys.exit(code)

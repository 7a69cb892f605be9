"""`explore`: maps in the browser."""

import importlib.util
import os
import sys
import webbrowser
from typing import TYPE_CHECKING, Annotated

import typer

from sweeps.cli.errors import complain, refuse
from sweeps.cli.library import find, is_store
from sweeps.cli.process import importing

if TYPE_CHECKING:
    from sweeps.explore.source import Source

LOOPBACK = "127.0.0.1"


def explore(
    what: Annotated[
        str | None,
        typer.Argument(metavar="[NAME|FILE|PATH]", help="library name, TOML file or a store"),
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="default: 5170, or a free one")
    ] = None,
    host: Annotated[
        str, typer.Option(help="address to listen on; default: this machine alone")
    ] = LOOPBACK,
    browser: Annotated[bool, typer.Option(help="open the page")] = True,
) -> None:
    """Show live maps in the browser, or those of a store."""
    for module in ("bokeh", "llvmlite"):
        if importlib.util.find_spec(module) is None:
            refuse(f"explore needs {module}: `pip install 'fic-jax[explore]'`")
    with importing():
        from sweeps.explore import server

    def make() -> "Source":
        with importing():
            return source(what)

    if what is not None:  # a mistake is said before a browser opens
        made = make()
    else:
        made = None

    def opened(link: str) -> None:
        print(f"{link}  (Ctrl-C ends it)", flush=True)
        if not server.is_loopback(host):
            complain(
                f"warning: everybody who reaches {host} over the network can see "
                f"{'this store' if what and is_store(what) else 'these maps'} and use this "
                "machine's processor: there is no password and no encryption"
            )
        # without a screen Python would start a browser of the terminal, which waits for its user
        screen = sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
        if browser and screen:
            webbrowser.open(link)

    try:
        server.serve(lambda: made or make(), host, port, opened)
    except server.ListenError as error:
        refuse(str(error))
    except KeyboardInterrupt:
        print("stopped")


def source(what: str | None) -> "Source":
    """The store or the program that the maps come from, with JAX in its precision."""
    from sweeps.explore.live import Live
    from sweeps.runner import configure
    from sweeps.spec.reading import load
    from sweeps.store.place import place_of_store

    if what is not None and is_store(what):
        from sweeps.explore.stored import Stored

        stored = Stored(place_of_store(what))
        configure(int(stored.dtype.removeprefix("float")), "cpu")
        return stored
    sweep = load(find(what)) if what is not None else None
    bits = sweep.bits if sweep else 32
    configure(bits, "cpu")
    return Live(sweep, f"float{bits}")

"""The server: on this machine alone unless asked, and for its own pages alone.

It listens before JAX and the rest of this package are imported: a browser loads Bokeh meanwhile.
"""

import asyncio
import errno
import ipaddress
import logging
import socket
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import lru_cache
from importlib.resources import files
from io import BytesIO
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode, urlsplit

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.embed.server import server_html_page_for_session
from bokeh.resources import Resources
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.views.doc_handler import DocHandler
from bokeh.util.token import get_session_id
from jinja2 import Template
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.web import RequestHandler

from sweeps.explore.worker import Stale, Worker

if TYPE_CHECKING:
    from sweeps.explore.source import Source
    from sweeps.explore.view import View

LOOPBACK = "127.0.0.1"
PORT = 5170  # unless it is in use: a link then works again after a new start
LARGEST_MESSAGE = 20_000  # bytes of a websocket's message; a page sends at most some hundred
LARGEST_REQUEST = 65_536  # bytes of a request's head and body
UNUSED = 10_000  # ms that a closed page may take to come back
MOST_PAGES = 30  # of 10 MB at most: a live map has all metrics of 256 x 256 cells
FULL = (
    f"{MOST_PAGES} pages of this program are open, and that is its limit: close one, "
    f"wait {UNUSED // 1000} seconds and load this again."
)
MOST_PICTURES = 8  # that wait to be drawn, about a second each
PATHS = ("/", "/ws", "/view.py", "/view.toml", "/picture.png", "/picture.svg")


class ListenError(Exception):
    """The server can't listen there; the text is one line."""


class Guarded(BokehTornado):  # type: ignore[misc]
    """A Bokeh server that refuses a foreign Host or Origin before anything else reads the request.

    A page of a foreign site could else read this server's pages under a name of its own that leads
    to this machine (DNS rebinding), or open a websocket to it.
    """

    hosts: Callable[[str], bool]
    place: tuple[str, int]  # address and port
    ready: "asyncio.Future[Source]"
    coming = 0  # pages that wait for the source
    drawing = 0  # pictures that wait or are drawn

    @property
    def full(self) -> bool:
        """Whether there are as many pages as there may be."""
        return len(self.get_sessions("/")) + self.coming >= MOST_PAGES

    def find_handler(self, request: Any, **kwargs: Any) -> Any:
        """The handler of a request; a refusal of one that is foreign, or that nothing answers."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if not self.hosts(host):
            return self._refused(request, 403, refused_host(host, *self.place))
        if not _own(origin, host) or _embedded(request.headers):
            line = f"A page of another site sent this: open http://{host}/ by itself instead."
            return self._refused(request, 403, line)
        if request.path not in PATHS:  # Bokeh's other pages are not needed
            return self._refused(request, 404, "There is nothing at this address.")
        if request.path == "/ws" and self.full and not self._has_session(request):
            # a page whose session has ended comes back through its websocket
            return self._refused(request, 503, FULL)
        if request.path == "/":
            context = {"application_context": self.applications["/"], "bokeh_websocket_path": "/ws"}
            return self.get_handler_delegate(request, Early, context)
        return super().find_handler(request, **kwargs)

    def _has_session(self, request: Any) -> bool:
        """Whether the session that a websocket's subprotocols name exists."""
        _, _, token = request.headers.get("Sec-WebSocket-Protocol", "").partition(",")
        try:
            name = get_session_id(token.strip())
        except Exception:  # whatever a text that is no token leads to
            return False
        return any(session.id == name for session in self.get_sessions("/"))

    def _refused(self, request: Any, status: int, line: str) -> Any:
        return self.get_handler_delegate(request, Refused, {"status": status, "line": line})


class Refused(RequestHandler):  # type: ignore[misc]
    """One line that says what is refused, and what to do."""

    def initialize(self, status: int, line: str) -> None:
        """Tornado's constructor."""
        self.status, self.line = status, line

    def prepare(self) -> None:
        """The answer to each method."""
        say(self, self.status, self.line)


def say(handler: RequestHandler, status: int, line: str) -> None:
    """Answer with one line of plain text."""
    handler.set_status(status)
    handler.set_header("Content-Type", "text/plain; charset=utf-8")
    handler.set_header("X-Content-Type-Options", "nosniff")
    handler.finish(line)


def refused_host(host: str, address: str, port: int) -> str:
    """Why a request for `host` is refused, and what to do; one line."""
    from sweeps.spec.mistakes import command, printable

    shown = printable(host)
    with suppress(ValueError):
        other = urlsplit(f"//{host}").port or 80
        if other != port and own_host(address, other)(host):
            return (
                f"This program answers on port {port} alone, but the request is for {shown}: "
                "give a tunnel the same port at both ends, as in "
                f"`ssh -L {port}:127.0.0.1:{port} MACHINE`, or start the program with "
                f"`--port {other}`."
            )
    return (
        f"This program answers at {address}:{port} alone, but the request is for {shown}; "
        f"{command('explore', '--host', 'ADDRESS')} listens at another address of this machine."
    )


def _own(origin: str | None, host: str) -> bool:
    try:
        return origin is None or urlsplit(origin).netloc.lower() == host.lower()
    except ValueError:  # no address
        return False


def _embedded(headers: Mapping[str, str]) -> bool:
    """Whether a foreign page asks, as for a picture or a frame in it; following a link is no such.

    It could not read the answer, but each request is work.
    """
    foreign = headers.get("Sec-Fetch-Site") in ("cross-site", "same-site")
    return foreign and headers.get("Sec-Fetch-Dest") != "document"


class Early(DocHandler):  # type: ignore[misc]
    """The page: its head at once, for which the browser loads Bokeh, the rest when it is known."""

    async def get(self) -> None:
        """The page of a new session."""
        if self.application.full:
            say(self, 503, FULL)
            return
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.write(head())
        self.application.coming += 1
        try:
            await self.flush()
            await asyncio.shield(self.application.ready)
            session = await self.get_session()
        finally:
            self.application.coming -= 1
        document = session.document
        whole = server_html_page_for_session(
            session, None, document.title, document.template, document.template_variables
        )
        self.write(whole)


@lru_cache(maxsize=1)
def head() -> str:
    """The head of the page, with Bokeh: a request for it would wait for the session."""
    text, _, _ = text_of("page.html").partition("<body>")
    scripts = Resources(mode="inline", components=["bokeh"]).render_js()
    return text.replace("{{ style }}", text_of("page.css")).replace("{{ scripts }}", scripts)


@lru_cache(maxsize=1)
def body() -> Template:
    """The page after its head."""
    _, mark, text = text_of("page.html").partition("<body>")
    return Template(mark + text)


def text_of(name: str) -> str:
    """A file of the page."""
    return files("sweeps.explore").joinpath(name).read_text(encoding="utf-8")


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address or a name."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def own_host(address: str, port: int) -> Callable[[str], bool]:
    """Whether the Host of a request is this server: its address, or localhost for loopback.

    An address in digits belongs to nobody's domain. Of a server that others may reach, the names
    are this machine's.
    """
    local = ipaddress.ip_address(address).is_loopback
    names = {"localhost"} if local else {"localhost", socket.gethostname(), socket.getfqdn()}

    def own(host: str) -> bool:
        try:
            parts = urlsplit(f"//{host}")
            if (parts.port or 80) != port or parts.username is not None:
                return False
            name = parts.hostname or ""
        except ValueError:
            return False
        try:
            number = ipaddress.ip_address(name)
        except ValueError:
            return name in {known.lower() for known in names}
        return number.is_loopback or not local

    return own


def bound(host: str, port: int | None) -> tuple[socket.socket, str, int]:
    """A socket that listens, its address and port; without a port it is PORT, or a free one.

    Raises ListenError for a port in use or a host that is not here.
    """
    try:
        family, *_, place = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    except (OSError, ValueError):
        raise ListenError(f"--host {host!r}: is no address or name of a machine") from None
    address = str(place[0])
    if port is None:
        with suppress(ListenError):
            return _listening(family, host, address, PORT)
    return _listening(family, host, address, port or 0)


def _listening(
    family: socket.AddressFamily, host: str, address: str, port: int
) -> tuple[socket.socket, str, int]:
    try:
        made = socket.create_server((address, port), family=family)
    except OSError as error:
        wrong = {
            errno.EADDRINUSE: f"--port {port}: is in use; --port 0 chooses a free one",
            errno.EACCES: f"--port {port}: is for root alone; --port 0 chooses a free one",
            errno.EADDRNOTAVAIL: f"--host {host}: is no address of this machine",
        }
        raise ListenError(wrong.get(error.errno or 0, f"--host {host}: {error}")) from None
    made.setblocking(False)
    return made, address, made.getsockname()[1]


class Views(RequestHandler):  # type: ignore[misc]
    """A view as Python, as a sweep file or as a picture: /view.py?QUERY, /picture.svg?QUERY."""

    def initialize(self, pool: ThreadPoolExecutor) -> None:
        """Tornado's constructor."""
        self.pool = pool

    async def get(self, what: str) -> None:
        """The text or the picture, or one line that says why there is none."""
        from sweeps.explore.view import ViewError, parse
        from sweeps.spec.mistakes import SweepError

        source = await asyncio.shield(self.application.ready)
        content: str | bytes
        try:
            view = parse(self.request.query, source.start, source.space, source.defaults)
            source.check(view)
            view = source.opened(view)
            make = {"view.py": source.python, "view.toml": source.sweep_file}.get(what)
            if make:
                content = make(view)
            elif self.application.drawing >= MOST_PICTURES:
                say(self, 503, f"{MOST_PICTURES} pictures wait to be drawn: try again later.")
                return
            else:
                content = await self._picture(source, view, what.rpartition(".")[2])
        except (ViewError, SweepError, OSError) as error:
            say(self, 400, f"{error}".splitlines()[0])
            return
        self.set_header("Content-Type", KINDS.get(what, "text/plain; charset=utf-8"))
        self.set_header("X-Content-Type-Options", "nosniff")
        self.finish(content)

    async def _picture(self, source: "Source", view: "View", kind: str) -> bytes:
        self.application.drawing += 1
        work = self.pool.submit(picture, source, view, kind)
        try:
            return await asyncio.wrap_future(work)
        finally:
            self.application.drawing -= 1


KINDS = {"picture.png": "image/png", "picture.svg": "image/svg+xml"}


def picture(source: "Source", view: "View", kind: str) -> bytes:
    """A view as `fic-sweep plot` draws it. Raises ViewError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from figures import PlotError, heatmap, planes, style
    from sweeps.explore.view import ViewError

    try:
        plane = planes.select(
            source.dataset(view),
            x=view.x,
            y=view.y,
            metric=view.metric,
            at={dim: value for dim, value in view.at.items() if dim in source.cut(view)},
        )
    except PlotError as error:
        raise ViewError(str(error)) from None
    content = BytesIO()
    with style.look():
        canvas = FigureCanvasAgg(heatmap.draw(plane))
        canvas.print_figure(content, format=kind, dpi=200, bbox_inches="tight")
    return content.getvalue()


def serve(
    make: Callable[[], "Source"], host: str, port: int | None, opened: Callable[[str], None]
) -> None:
    """Serve the pages of a source until Ctrl-C; calls `opened` with the link once it listens.

    The source is made meanwhile. Raises ListenError as `bound` does, and what `make` raises.
    """
    for name in ("bokeh", "tornado"):  # what a browser sends wrong is no matter of the terminal
        logging.getLogger(name).setLevel(logging.CRITICAL)
    listening, address, port = bound(host, port)
    worker, quick = Worker("maps"), Worker("cells")
    pictures = ThreadPoolExecutor(1, "pictures")

    def page(document: Document) -> None:
        from sweeps.explore.page import Page

        arguments = document.session_context.request.arguments
        pairs = [(n, v.decode("utf-8", "replace")) for n, vs in arguments.items() for v in vs]
        Page(document, app.ready.result(), worker, quick, urlencode(pairs))

    app = Guarded(
        {"/": Application(FunctionHandler(page))},
        extra_patterns=[
            (r"/(view\.py|view\.toml|picture\.png|picture\.svg)", Views, {"pool": pictures})
        ],
        extra_websocket_origins=["*"],  # `Guarded` has refused all but this server's own
        websocket_max_message_size_bytes=LARGEST_MESSAGE,
        unused_session_lifetime_milliseconds=UNUSED,
        check_unused_sessions_milliseconds=UNUSED // 4,
        include_headers=[],
        include_cookies=[],
        ico_path="none",
        use_index=False,
        session_token_expiration=3600,  # s; a page that sleeps may come back
    )
    app.hosts, app.place = own_host(address, port), (address, port)
    http = HTTPServer(app, max_body_size=LARGEST_REQUEST, max_header_size=LARGEST_REQUEST)
    http.add_socket(listening)
    loop = IOLoop.current()
    server = BaseServer(loop, app, http)
    server.start()
    head()  # before the first page needs it
    shown = LOOPBACK if address in ("0.0.0.0", "::") else address
    opened(f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/")

    async def begin() -> None:
        app.ready = asyncio.wrap_future(pictures.submit(_made, make, worker))
        app.ready.add_done_callback(lambda done: loop.stop() if done.exception() else None)

    loop.run_sync(begin)
    try:
        loop.start()
        app.ready.result()
    finally:
        server.stop(wait=False)


def _made(make: Callable[[], "Source"], worker: Worker) -> "Source":
    """The source; `worker` compiles what its first map needs, or reads it from the disk."""
    source = make()

    def prepare(stale: Stale) -> None:
        (_, compute), *_ = source.stages()
        compute(source.start, None, stale)

    worker.submit("first", prepare)
    import sweeps.explore.page  # noqa: F401  before the first page needs it

    return source

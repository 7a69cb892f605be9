"""The server answers its own pages, refuses all others, and says in one line what it can't do."""

import http.client
import json
import re
import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from unittest.mock import patch
from urllib.parse import urlsplit

import pytest
from bokeh.util.token import generate_jwt_token

from sweeps.explore import server
from sweeps.explore.page import _event
from sweeps.explore.view import ViewError
from tests.command import call, typed
from tests.explore.serving import serving


@pytest.fixture(scope="module")
def link(cube):
    with serving(cube) as link:
        yield link


def get(link, path, method="GET", **headers):
    """Status and body; `Host` is the link's unless given."""
    place = urlsplit(link)
    with closing(http.client.HTTPConnection(place.hostname, place.port, timeout=20)) as connection:
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read().decode("utf-8", "replace")


def test_its_own_page_is_served(link):
    status, page = get(link, "/")
    assert status == 200
    assert 'lang="en"' in page


@pytest.mark.parametrize("path", ["/", "/ws", "/view.py", "/static/js/bokeh.min.js"])
@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:80"},
        {"Host": "127.0.0.1:1"},
        {"Host": ""},
        {"Host": "user@127.0.0.1"},
        {"Host": "10.0.0.1:{port}"},
        {"Host": "localhost.evil.example:{port}"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "http://[::1"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"},
    ],
)
def test_a_foreign_host_or_origin_is_refused(link, path, headers):
    headers = {name: text.format(port=urlsplit(link).port) for name, text in headers.items()}
    assert get(link, path, **headers)[0] in (400, 403)


def test_localhost_is_this_machine(link):
    port = urlsplit(link).port
    own = {"Host": f"localhost:{port}", "Origin": f"http://localhost:{port}"}
    assert get(link, "/view.toml", **own)[0] == 200


def test_a_link_on_a_foreign_page_can_be_followed(link):
    followed = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}
    assert get(link, "/view.toml", **followed)[0] == 200


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/static/../../../../../../etc/passwd",
        "/static/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
        "/static//etc/passwd",
        "/picture.pdf",
        "/view.py/..",
        "/cube.zarr/zarr.json",
        "//evil.example/",
        "/nothing",
        "/static/%00",
        "/static/js/bokeh.min.js",
        "/%00",
        "/%ff%zz%",
        "/" + 5_000 * "a/",
        "/autoload.js?bokeh-autoload-element=x",
        "/metadata",
    ],
)
def test_there_is_nothing_else_to_read(link, path):
    status, body = get(link, path)
    assert status in (400, 403, 404)
    assert "root:" not in body


@pytest.mark.parametrize("method", ["POST", "OPTIONS", "FOO", "TRACE"])
@pytest.mark.parametrize("path", ["/", "/ws", "/view.py", "/autoload.js", "/static/%00"])
def test_other_methods_are_refused(link, method, path):
    assert 400 <= get(link, path, method)[0] < 500


def test_a_tunnel_with_another_port_is_told_what_to_do(link):
    port = urlsplit(link).port
    status, body = get(link, "/", Host="localhost:9000")
    assert status == 403
    assert "\n" not in body
    assert "the request is for localhost:9000" in body
    assert f"ssh -L {port}:127.0.0.1:{port}" in body
    assert "--port 9000" in body
    assert "--host ADDRESS" in get(link, "/", Host=f"evil.example:{port}")[1]
    assert "by itself" in get(link, "/", Origin="http://evil.example")[1]


def test_there_are_at_most_so_many_pages(cube):
    with serving(cube) as link:
        answers = [get(link, "/") for _ in range(server.MOST_PAGES + 1)]
        assert [status for status, _ in answers] == [200] * server.MOST_PAGES + [503]
        assert f"{server.MOST_PAGES} pages of this program are open" in answers[-1][1]
        # the websockets of these pages, and that of a page whose session has ended
        tokens = [re.search(r'"token":"([^"]+)"', page)[1] for _, page in answers[:2]]
        tokens.append(generate_jwt_token("another"))
        opening = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        opening["Sec-WebSocket-Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
        opened = [
            get(link, "/ws", **opening, **{"Sec-WebSocket-Protocol": f"bokeh, {token}"})[0]
            for token in tokens
        ]
        assert opened == [101, 101, 503]


def test_at_most_so_many_pictures_wait(link):
    with ThreadPoolExecutor(3 * server.MOST_PICTURES) as pool:
        requests = [pool.submit(get, link, "/picture.png") for _ in range(3 * server.MOST_PICTURES)]
    answers = [request.result() for request in requests]
    assert {status for status, _ in answers} == {200, 503}
    assert all("pictures wait" in body for status, body in answers if status == 503)


@pytest.mark.parametrize(
    ("query", "wanted"),
    [
        ("Td=x", "`Td` must be a finite number"),
        ("x=<b>", "has"),
        ("a" * 9_000, "at most"),
    ],
)
def test_a_wrong_address_is_one_line(link, query, wanted):
    status, body = get(link, f"/view.py?{query}")
    assert status == 400
    assert wanted in body
    assert "\n" not in body


def test_a_page_with_a_wrong_address_is_a_page(link):
    assert get(link, "/?metric=nothing")[0] == 200


def test_a_huge_request_is_refused(link):
    place = urlsplit(link)
    connection = socket.create_connection((place.hostname, place.port), timeout=20)
    with closing(connection), suppress(OSError):  # it may hang up before all is sent
        connection.sendall(b"GET /?" + 1_000_000 * b"a" + b" HTTP/1.1\r\n\r\n")
        assert b" 200 " not in connection.recv(100)
    assert get(link, "/view.toml")[0] == 200


def test_pictures_are_of_the_view(link):
    status, picture = get(link, "/picture.svg?Td=12")
    assert status == 200
    assert "<svg" in picture[:500]


@pytest.mark.parametrize(
    "line",
    [
        "",
        "[]",
        "null",
        "{",
        '{"do": "close"}',
        '{"do": "__init__"}',
        '{"do": "set", "name": "Td"}',
        '{"do": "set", "name": "Td", "value": 5}',
        '{"do": "tap", "x": NaN, "y": 0}',
        '{"do": "tap", "x": true, "y": 0}',
        '{"do": "tap", "x": "0", "y": 0}',
        '{"do": ["set"]}',
        '{"do": "undo", "more": 1}',
        "[" * 3_000,
        json.dumps({"do": "set", "name": "Td", "value": "5" * 5_000}),
        5,
        None,
    ],
)
def test_a_malformed_event_is_refused(line):
    with pytest.raises(ViewError):
        _event({"json": [line]})
    with pytest.raises(ViewError):
        _event({"other": [line]})


def test_a_well_formed_event_is_taken():
    line = json.dumps({"do": "tap", "x": 0.5, "y": 1, "pin": True, "n": 7})
    assert _event({"json": [line]}) == json.loads(line)


def test_it_listens_on_this_machine_alone():
    listening, address, port = server.bound("127.0.0.1", 0)
    with closing(listening):
        assert listening.getsockname() == ("127.0.0.1", port)
        assert address == "127.0.0.1"


@pytest.mark.parametrize(
    ("address", "host", "own"),
    [
        ("127.0.0.1", "127.0.0.1:7", True),
        ("127.0.0.1", "[::1]:7", True),
        ("127.0.0.1", "LOCALHOST:7", True),
        ("127.0.0.1", "192.168.0.9:7", False),
        ("127.0.0.1", "localhost:8", False),
        ("127.0.0.1", "localhost:x", False),
        ("0.0.0.0", "192.168.0.9:7", True),
        ("0.0.0.0", f"{socket.gethostname()}:7", True),
        ("0.0.0.0", "evil.example:7", False),
    ],
)
def test_which_hosts_are_its_own(address, host, own):
    assert server.own_host(address, 7)(host) is own


def test_a_port_in_use_is_one_line(cube):
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        done = call("explore", cube, "--no-browser", "--port", str(port), code=2)
    assert done.stderr == f"fic-sweep: --port {port}: is in use; --port 0 chooses a free one\n"


def test_the_default_port_gives_way(monkeypatch):
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        monkeypatch.setattr(server, "PORT", taken.getsockname()[1])
        listening, _, port = server.bound("127.0.0.1", None)
        listening.close()
    assert port != server.PORT


@pytest.mark.parametrize("host", ["no.such.host.invalid", "8.8.8.8", "a\x00b"])
def test_a_host_that_is_not_here_is_one_line(host):
    with pytest.raises(server.ListenError, match="--host"):
        server.bound(host, 0)


def test_an_open_host_is_a_warning(cube, monkeypatch):
    def serve(source, host, port, opened):
        opened("http://example/")

    monkeypatch.setattr(server, "serve", serve)
    done = typed("explore", cube, "--no-browser", "--host", "0.0.0.0")
    assert "no password and no encryption" in done.stderr
    assert done.stderr.count("\n") == 1
    assert typed("explore", cube, "--no-browser").stderr == ""


def test_without_bokeh_one_line_names_the_extra(cube):
    with patch.dict(sys.modules, {"bokeh": None}):
        done = typed("explore", cube)
    assert done.code == 2
    assert done.stderr == "fic-sweep: explore needs bokeh: `pip install 'fic-jax[explore]'`\n"


@pytest.mark.parametrize("what", ["nothing-like-this", "missing.toml"])
def test_what_is_not_there_is_one_line(what):
    done = typed("explore", what)
    assert done.code == 2
    assert done.stderr.count("\n") == 1


def test_a_store_of_a_later_version_is_one_line(cube, tmp_path):
    import shutil

    later = shutil.copytree(cube, tmp_path / "later.zarr")
    text = (later / "zarr.json").read_text()
    assert '"format": 3' in text
    (later / "zarr.json").write_text(text.replace('"format": 3', '"format": 99'))
    done = typed("explore", later)
    assert done.code == 2
    assert "has format 99; this program reads up to 3" in done.stderr
    assert done.stderr.count("\n") == 1

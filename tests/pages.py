"""Pages in headless Chromium, of the explorer and of shared files."""

import shutil
from contextlib import contextmanager

import pytest

CHROMIUM = shutil.which("chromium")
WAIT = 30_000  # ms, on a busy machine


@pytest.fixture(scope="module")
def browser():
    """A browser for the tests of a module; without one they are skipped."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright (extra `test`)")
    if CHROMIUM is None:
        pytest.skip("no chromium: `apt-get install chromium`")
    with playwright.sync_playwright() as driver:
        made = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield made
        made.close()


def expect(locator):
    """Playwright's assertions, which wait."""
    from playwright.sync_api import expect

    expect.set_options(timeout=WAIT)
    return expect(locator)


@contextmanager
def opened(
    browser, link, ready, width=1280, height=900, complaints=(), alone=False, offline=False, **more
):
    """A page, after `ready(page)` has waited for it.

    No script of it may fail, but with complaints that begin with known words. A page that is
    `alone` may ask for nothing but itself, nor complain. `more` is for the browser's context.
    """
    context = browser.new_context(
        viewport={"width": width, "height": height}, offline=offline, **more
    )
    page = context.new_page()
    page.set_default_timeout(WAIT)
    failed, loaded = [], []
    page.on("pageerror", lambda error: failed.append(str(error)))
    if alone:
        page.on("console", lambda message: message.type == "error" and failed.append(message.text))
    page.on("request", lambda request: loaded.append(request.url))
    page.goto(link)
    ready(page)
    yield page
    context.close()
    assert [one for one in failed if not one.startswith(complaints)] == []
    if alone:
        assert [url for url in loaded if not url.startswith("data:")] == [link]

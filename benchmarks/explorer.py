"""How soon a picture is in the page: `make explore-speed`, or `python -m benchmarks.explorer`.

A time is from the event in the page to the second frame after the new image has come, when it is on
the screen. Chromium is headless, and everything shares this machine's cores.
"""

import json
import os
import select
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

REPEATS = 15
BLOCK = 50_000  # cells, as the library's atlas has, whose cells take a thousand steps
WAIT = 60_000  # ms
# 10.1 million cells, of one step each: only their number matters here
STORE = """
name = "ten-million"
[time]
dt = 0.01
t_end = 0.01
[axes]
K0 = { log = [1.0, 1000.0], n = 64 }
Kenv = { log = [10.0, 1000.0], n = 64 }
Denv = { log = [1.0, 1000.0], n = 31 }
Td = { lin = [1.0, 20.0], n = 20 }
sigma = { log = [0.001, 0.1], n = 4 }
"""

# in the page: ms from an action to the second frame after the source `name` has new data
TIMED = """([act, name, wanted]) => new Promise((done) => {
  const source = Bokeh.documents[0].get_model_by_name(name);
  const before = source.data;
  const size = () => source.data.image?.[0]?.length;
  const began = performance.now();
  const look = () => {
    if (source.data !== before && (!wanted || size() === wanted))
      requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - began)));
    else requestAnimationFrame(look);
  };
  eval(act);
  look();
})"""
SLIDE = """(() => {{
  const slider = document.querySelector('input[name="slide.{name}"]');
  slider.value = {place};
  slider.dispatchEvent(new Event("input", {{bubbles: true}}));
}})()"""
TAP = """window.explorer.pointer({{event_name: "tap", x: {x}, y: {y}, modifiers: {{}}}})"""


@contextmanager
def serving(*arguments: str) -> Iterator[tuple[str, float]]:
    """The link of a server, and when its command was typed."""
    began = time.perf_counter()
    command = [_fic_sweep(), "explore", "--no-browser", "--port", "0", *arguments]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout
    try:
        select.select([server.stdout], [], [], 60)
        yield server.stdout.readline().split()[0], began
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(20)


def _fic_sweep() -> str:
    return str(Path(sys.executable).with_name("fic-sweep"))


def _ready(page: Any, image: str = "window.explorer?.said()?.maps") -> None:
    page.wait_for_function(image, timeout=WAIT, polling="raf")


def first_map(browser: Any, runs: int = 5) -> list[float]:
    """ms from the command to the first map in the page, with a warm cache."""
    times = []
    for _ in range(runs):
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        with serving() as (link, began):
            page.goto(link, wait_until="commit")
            _ready(page)
            times.append(1e3 * (time.perf_counter() - began))
            page.close()
    return times[1:]  # the first one warms the cache


def live(browser: Any, query: str = "") -> dict[str, list[float]]:
    """ms of a live page: a slider to coarse and to fine maps, a click to a motion."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    coarse, fine, motion = [], [], []
    rng = np.random.default_rng(0)
    with serving() as (link, _):
        page.goto(link + query)
        _ready(page, "window.explorer?.said()?.fine")
        page.wait_for_timeout(1000)
        for place in rng.integers(100, 300, REPEATS):
            act = SLIDE.format(name="Td", place=place)
            coarse.append(page.evaluate(TIMED, [act, "image", 64 * 64]))
            page.wait_for_timeout(1500)
        for place in rng.integers(100, 300, REPEATS):
            act = SLIDE.format(name="Denv", place=place)
            fine.append(page.evaluate(TIMED, [act, "image", 256 * 256]))
            page.wait_for_timeout(1000)
        for x, y in rng.uniform(0.1, 0.9, (REPEATS + 1, 2)):
            motion.append(page.evaluate(TIMED, [TAP.format(x=x, y=y), "motions", 0]))
            page.wait_for_timeout(200)
        page.close()
    rested = [ms - 150 for ms in fine]
    return {
        "live: slider to 64 x 64": coarse,
        "live: slider to 256 x 256, the 150 ms of rest included": fine,
        "live: 256 x 256 after the slider rests": rested,
        "live: click to motion, after the first": motion[1:],
    }


def dragged(browser: Any) -> list[float]:
    """ms between pictures while a slider is dragged, an event each frame."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    with serving() as (link, _):
        page.goto(link)
        _ready(page, "window.explorer?.said()?.fine")
        page.wait_for_timeout(1000)
        code = """() => new Promise((done) => {
          const source = Bokeh.documents[0].get_model_by_name("image");
          const slider = document.querySelector('input[name="slide.Td"]');
          const came = []; let last = source.data; let frame = 0;
          const step = () => {
            if (source.data !== last) { last = source.data; came.push(performance.now()); }
            slider.value = 100 + frame; slider.dispatchEvent(new Event("input"));
            frame += 1;
            if (frame < 180) requestAnimationFrame(step); else done(came);
          };
          step();
        })"""
        came = page.evaluate(code)
        page.close()
    return [float(ms) for ms in np.diff(came)]


def stored(browser: Any, path: Path) -> dict[str, list[float]]:
    """ms of a store: page load to the first map, a slider to the next one."""
    first, slide = [], []
    with serving(str(path)) as (link, _):
        for _ in range(5):
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            began = time.perf_counter()
            page.goto(link, wait_until="commit")
            _ready(page)
            first.append(1e3 * (time.perf_counter() - began))
            page.close()
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(link)
        _ready(page)
        page.wait_for_timeout(1000)
        for place in [*range(0, 20, 2), *range(1, 20, 2)]:
            act = SLIDE.format(name="Td", place=place)
            slide.append(page.evaluate(TIMED, [act, "image", 0]))
            page.wait_for_timeout(100)
        page.close()
    return {
        "10 M cells: page load to first map": first[:1],
        "10 M cells: page load to first map, later pages": first[1:],
        "10 M cells: slider to map": slide,
    }


def make_store(folder: Path) -> Path:
    """A store of ten million cells."""
    from sweeps import runner
    from sweeps.spec.reading import parse

    path = folder / "ten-million.zarr"
    runner.configure(32, "cpu")
    runner.run(runner.start(path, parse(STORE, "sweep"), BLOCK, 32), lambda _: None)
    return path


def main() -> None:
    """Measure, and print a table of medians."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("no chromium: `apt-get install chromium`")
    times: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        path = make_store(Path(folder))
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        times["command to first map, warm cache"] = first_map(browser)
        times |= live(browser)
        times["live: between two maps while a slider is dragged"] = dragged(browser)
        times |= stored(browser, path)
        browser.close()
    print(f"load of the machine: {', '.join(f'{x:.1f}' for x in os.getloadavg())}")
    print("| ms | median | worst | n |\n|---|---|---|---|")
    for what, ms in times.items():
        print(f"| {what} | {statistics.median(ms):.0f} | {max(ms):.0f} | {len(ms)} |")
    print(json.dumps({what: [round(one, 1) for one in ms] for what, ms in times.items()}))


if __name__ == "__main__":
    main()

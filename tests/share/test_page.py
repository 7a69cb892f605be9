"""The file in headless Chromium, from file:// and without a network."""

import json

import numpy as np
import pytest

from sweeps.store.opening import dataset
from tests import pages
from tests.command import typed
from tests.explore.conftest import ran
from tests.share.conftest import EVIL, JOINT

PIN = {"K0": 100.0, "Kenv": 100.0, "Td": 5.0, "contact": "hard_stop"}


@pytest.fixture(scope="module")
def file(joint, tmp_path_factory):
    made = tmp_path_factory.mktemp("shared") / "page.html"
    pin = ",".join(f"{name}={value}" for name, value in PIN.items())
    ended = typed("share", joint, "--out", made, "--pin", pin, "--pin", "contact=welded")
    assert ended.code == 0, ended.stderr
    return made


def opened(browser, file, **more):
    """A page that is ready; it asks for nothing but itself."""
    return pages.opened(browser, file.as_uri(), ready, alone=True, offline=True, **more)


def ready(page):
    """Wait until a page has read its data."""
    page.wait_for_selector("html[data-ready]", timeout=pages.WAIT)


def drawn(page):
    """The page, once the map and the words around it are those of the view."""
    page.evaluate("""() => new Promise((done) =>
        requestAnimationFrame(() => requestAnimationFrame(done)))""")
    return page


def pixels(page):
    """Every 11th pixel of the map."""
    code = """() => {
        const canvas = document.querySelector("#map canvas");
        const image = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        return Array.from(new Uint32Array(image.data.buffer).filter((_, i) => i % 11 === 0));
    }"""
    return np.array(drawn(page).evaluate(code), np.uint32)


def at(page, x, y):
    """A place of the map in pixels of the page, from parts of its width and height."""
    box = page.locator("#map").bounding_box()
    return box["x"] + x * box["width"], box["y"] + (1 - y) * box["height"]


def where(page):
    """What the cell of the table is at."""
    parts = page.locator("#readout p").inner_text().split(", ")
    pairs = (part.split(" = ") for part in parts)
    return {name: value.split(" ")[0] for name, value in pairs}


def cell(joint, place):
    """The cell of the store that the table names."""
    data = dataset(joint).sel(contact=place["contact"].replace(" ", "_"))
    numbers = {name: float(place[name]) for name in ("K0", "Kenv", "Td")}
    return data.sel(numbers, method="nearest")


def table(page, name):
    """A value of the table with all its digits."""
    text = page.locator(f'#readout td[data-name="{name}"]').get_attribute("data-exact")
    return np.float32(text.replace("Infinity", "inf"))


def test_hover_has_the_values_of_the_store(browser, file, joint):
    with opened(browser, file) as page:
        seen = set()
        for x, y in ((0.1, 0.1), (0.5, 0.6), (0.95, 0.9)):
            page.mouse.move(*at(page, x, y))
            place = where(page)
            seen.add((place["K0"], place["Kenv"]))
            expected = cell(joint, {**place, "contact": "hard_stop"})
            for name in ("nmse", "convergence_time", "peak_torque", "energy_in"):
                assert table(page, name) == expected[name].item(), (place, name)
        assert len(seen) == 3
        assert page.locator("#title").inner_text().startswith("nmse: ")


def test_a_slider_moves_the_map(browser, file, joint):
    with opened(browser, file) as page:
        before = pixels(page)
        assert len(np.unique(before)) > 10
        page.mouse.click(*at(page, 0.7, 0.3))
        slider = page.locator('input[name="slide.Td"]')
        slider.focus()
        slider.press("ArrowRight")
        assert slider.get_attribute("aria-valuetext") == "12 N·m"
        assert (pixels(page) != before).mean() > 0.5
        assert where(page)["Td"] == "12"
        expected = cell(joint, {**where(page), "contact": "hard_stop"})
        assert table(page, "nmse") == expected["nmse"].item()


def test_metric_and_axes_are_chosen(browser, file, joint):
    with opened(browser, file) as page:
        page.locator('select[name="Metric"]').select_option("steady_error")
        page.locator('select[name="Vertical axis"]').select_option("Td")
        page.locator('select[name="Horizontal axis"]').select_option("Td")  # they change places
        assert page.locator('select[name="Vertical axis"]').input_value() == "Kenv"
        assert "T" in drawn(page).locator("#x-label").inner_text()
        page.mouse.move(*at(page, 0.99, 0.01))
        place = where(page)
        assert (place["Td"], place["Kenv"]) == ("12", "10")
        assert page.locator('input[name="slide.K0"]').is_visible()
        assert page.locator('input[name="slide.Td"]').is_hidden()


def test_the_nmse_of_a_pin_is_that_of_its_cell(browser, file, joint):
    with opened(browser, file) as page:
        pins = page.locator("#motions li")
        assert pins.count() == 2
        expected = cell(joint, {**PIN, "contact": "hard_stop"})["nmse"].item()
        assert np.float32(pins.first.get_attribute("data-nmse")) == np.float32(expected)
        pins.first.get_by_role("button").click()
        assert where(page) == {"K0": "100", "Kenv": "100", "Td": "5", "contact": "hard"}
        assert table(page, "nmse") == np.float32(expected)
        assert page.locator("#plots svg").count() == 6
        lines = 'document.querySelector("#plots svg").querySelectorAll("path[fill=none]").length'
        assert page.evaluate(lines) == 2
        pins.last.get_by_role("checkbox").uncheck()
        assert page.evaluate(lines) == 1


def test_keys_move_the_cell_and_reach_all_controls(browser, file, joint):
    with opened(browser, file) as page:
        reached = set()
        for _ in range(20):
            page.keyboard.press("Tab")
            code = "document.activeElement.name || document.activeElement.id"
            reached.add(page.evaluate(code))
        assert {"Metric", "Horizontal axis", "slide.Td", "slide.contact", "map"} <= reached
        page.locator("#map").focus()
        page.keyboard.press("Shift+ArrowLeft")
        page.keyboard.press("Shift+ArrowDown")
        page.keyboard.press("ArrowUp")
        assert (where(page)["Kenv"], where(page)["K0"]) == ("10", "17.78")
        nameless = """Array.from(document.querySelectorAll("input, select, button")).filter(
            (o) => !(o.getAttribute("aria-label") || o.ariaLabel || o.textContent.trim())).length"""
        assert page.evaluate(nameless) == 0


def test_a_narrow_screen_scrolls_down_alone(browser, file):
    with opened(browser, file, width=390, height=844, has_touch=True) as page:
        page.locator("#map").tap()
        assert "K0" in where(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        slider = page.locator('input[name="slide.Td"]')
        slider.scroll_into_view_if_needed()
        assert page.locator("#map").bounding_box()["y"] >= -1  # the map stays in sight
        assert slider.bounding_box()["height"] >= 40  # for a finger


def test_no_text_of_the_store_runs(browser, file):
    with opened(browser, file) as page:
        assert page.title() == EVIL
        assert page.locator("h1").inner_text() == EVIL
        assert page.locator("img, h1 b").count() == 0


def test_the_policy_of_the_page_stops_what_would_be_loaded_or_run(browser, file, tmp_path):
    """The second lock: even markup that is not escaped can do nothing."""
    text = file.read_text(encoding="utf-8")
    bad = "<script>document.title = 'run'</script><img src=http://127.0.0.1/x onerror='alert(1)'>"
    broken = tmp_path / "broken.html"
    broken.write_text(text.replace("<header>", f"{bad}<header>"), encoding="utf-8")
    context = browser.new_context()
    page = context.new_page()
    sent = []
    page.on("response", lambda response: sent.append(response.url))
    page.goto(broken.as_uri())
    ready(page)
    assert page.title() == EVIL
    assert sent == [broken.as_uri()]
    context.close()


def test_cells_without_a_number_are_hatched(browser, tmp_path):
    store = ran(tmp_path / "part.zarr", JOINT, chunk=80, blocks=[0])
    file = tmp_path / "part.html"
    assert typed("share", store, "--out", file, "--metric", "convergence_time").code == 0
    with opened(browser, file) as page:
        page.locator('input[name="slide.contact"]').press("Home")
        page.locator('input[name="slide.Td"]').press("Home")
        legend = json.dumps(drawn(page).locator("#legend li").all_inner_texts())
        assert "not run yet" in legend
        assert "blocks are missing" in page.locator("#about-copy").inner_text()
        page.locator('input[name="slide.contact"]').press("End")
        page.mouse.move(*at(page, 0.5, 0.5))
        assert page.locator('#readout td[data-name="convergence_time"]').inner_text() == (
            "not run yet"
        )
        colours = {0xFFFFFFFF, 0xFF8C8C8C}  # white with grey dots
        assert len(set(pixels(page).tolist()) & colours) == 2

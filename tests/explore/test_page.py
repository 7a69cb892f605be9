"""The page in headless Chromium: what a user does, and what is then seen."""

import json
import threading

import numpy as np
import pytest

from fic_jax import Params, sweep
from sweeps import runner
from sweeps.store.opening import open_store
from tests import pages
from tests.explore.conftest import CUBE, ran
from tests.explore.serving import serving
from tests.pages import expect

SHORT = "t_end=1.0"  # s: what is tested does not depend on the length of a run


@pytest.fixture(scope="module")
def live():
    with serving() as link:
        yield link


@pytest.fixture(scope="module")
def stored(cube):
    with serving(cube) as link:
        yield link


def opened(browser, link, **more):
    """A page whose map is there."""
    return pages.opened(browser, link, settle, **more)


def settle(page):
    """Wait for the map of the present view, the finest one."""
    page.wait_for_function("window.explorer?.said()?.fine")


def said(page):
    return json.loads(page.evaluate("JSON.stringify(window.explorer.said())"))


def pixels(page):
    """The image of the map."""
    code = "Array.from(Bokeh.documents[0].get_model_by_name('image').data.image[0])"
    return np.array(page.evaluate(code), np.uint32)


def click(page, x, y, **more):
    """Click the map at parts of its width and height."""
    box = page.locator("#map").bounding_box()
    page.locator("#map").click(position={"x": x * box["width"], "y": y * box["height"]}, **more)


def motions(page, n):
    """Wait for n motions; returns the nmse of each."""
    page.wait_for_function(f"window.explorer.said().motions.length === {n}")
    return [float(one["nmse"]) for one in said(page)["motions"]]


def exact(page, name):
    """A value of the table of a cell, with all its digits."""
    return float(page.locator(f'#readout td[data-name="{name}"]').get_attribute("data-exact"))


def test_a_slider_changes_map_and_address(browser, live):
    with opened(browser, f"{live}?{SHORT}") as page:
        before = pixels(page)
        assert before.size == 256 * 256
        slider = page.locator('input[name="slide.Td"]')
        slider.focus()
        for _ in range(4):
            slider.press("ArrowRight")
        value = page.locator('input[name="Td"]').input_value()
        page.wait_for_function(f"Number(window.explorer.said().view.at.Td) === {value}")
        settle(page)
        assert (pixels(page) != before).any()
        assert f"Td={float(value)!r}" in page.url
        assert slider.get_attribute("aria-valuetext") == f"{value} N·m"


def test_a_click_draws_the_motion_of_the_cell(browser, live):
    with opened(browser, f"{live}?{SHORT}") as page:
        click(page, 0.7, 0.3)
        (nmse,) = motions(page, 1)
        view = said(page)["view"]
        Kenv, K0 = view["cell"]
        one = {name: np.float32([v]) for name, v in vars(Params(K0=K0, Kenv=Kenv)).items()}
        assert np.float32(nmse) == sweep(Params(**one), dt=0.01, n_steps=100).nmse[0]
        assert exact(page, "nmse") == nmse
        samples = "Bokeh.documents[0].get_model_by_name('motions').data.T[0].length"
        assert page.evaluate(samples) == 100
        assert page.locator("figcaption").first.is_visible()
        # the map has the same number in that cell
        page.mouse.move(5, 5)
        box = page.locator("#map").bounding_box()
        page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.3 * box["height"])
        page.wait_for_function("window.explorer.said().readout")
        assert exact(page, "nmse") == nmse


def test_a_second_click_pins_and_the_next_cell_is_drawn_beside(browser, live):
    with opened(browser, f"{live}?{SHORT}") as page:
        click(page, 0.7, 0.3)
        first = motions(page, 1)
        click(page, 0.7, 0.3)
        page.wait_for_function("window.explorer.said().view.pins === 1")
        click(page, 0.4, 0.6)
        page.wait_for_function("window.explorer.said().motions.length === 2")
        assert motions(page, 2)[1] == first[0]
        page.keyboard.press("Enter")
        click(page, 0.3, 0.2, modifiers=["Shift"])
        assert len(motions(page, 3)) == 3
        page.get_by_role("button", name="Remove pins").click()
        assert len(motions(page, 1)) == 1


def test_arrow_keys_move_the_cell_and_undo_comes_back(browser, live):
    with opened(browser, f"{live}?{SHORT}") as page:
        page.keyboard.press("ArrowUp")
        motions(page, 1)
        x, y = said(page)["view"]["cell"]
        page.wait_for_timeout(600)  # the view comes to rest, and undo keeps it
        page.keyboard.press("ArrowRight")
        page.wait_for_function(f"window.explorer.said().view.cell[0] > {x!r}")
        assert said(page)["view"]["cell"][1] == y
        page.wait_for_timeout(600)
        page.keyboard.press("Control+z")
        page.wait_for_function(f"window.explorer.said().view.cell[0] === {x!r}")


def test_a_copied_link_shows_the_same(browser, live):
    granted = {"permissions": ["clipboard-read", "clipboard-write"]}
    with opened(browser, f"{live}?{SHORT}&Td=8", **granted) as page:
        page.locator('select[name="Metric"]').select_option("peak_torque")
        page.wait_for_function("window.explorer.said().title.includes('peak_torque')")
        settle(page)
        click(page, 0.5, 0.5)
        click(page, 0.5, 0.5)
        page.wait_for_function("window.explorer.said().view.pins === 1")
        settle(page)
        page.get_by_role("button", name="Copy link").click()
        expect(page.locator("#copied")).to_contain_text("link")
        link = page.evaluate("navigator.clipboard.readText()")
        image, words = pixels(page), said(page)
        page.get_by_role("button", name="Copy as sweep file").click()
        expect(page.locator("#copied")).to_contain_text("sweep file")
        assert "Td = 8.0" in page.evaluate("navigator.clipboard.readText()")
    with opened(browser, link) as page:
        motions(page, 2)  # the cell, and the same cell pinned
        assert said(page)["view"] == words["view"]
        np.testing.assert_array_equal(pixels(page), image)


def test_a_diverging_scenario_is_a_hatch_and_a_wrong_value_a_line(browser, live):
    with opened(browser, f"{live}?{SHORT}&contact=welded") as page:
        entry = page.locator('input[name="Denv"]')
        entry.fill("1e6")
        entry.press("Enter")
        page.wait_for_function("document.querySelector('#legend .diverged')")
        assert not pixels(page).any()  # no colour
        click(page, 0.5, 0.5)
        motions(page, 1)
        entry = page.locator('input[name="x0"]')
        entry.fill("0.5")
        entry.press("Enter")
        notice = page.get_by_role("alert")
        expect(notice).to_contain_text("must be greater than x0")
        entry.fill("0.05")
        entry.press("Enter")
        expect(notice).to_have_text("")


def test_a_narrow_screen_has_all_and_scrolls_down_alone(browser, live):
    with opened(browser, f"{live}?{SHORT}", width=390, height=844, has_touch=True) as page:
        click(page, 0.5, 0.5)
        motions(page, 1)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        slider = page.locator('input[name="slide.sigma"]')
        slider.scroll_into_view_if_needed()
        assert page.locator("#map").bounding_box()["y"] >= -1  # the map stays in sight
        assert slider.bounding_box()["height"] >= 40  # for a finger


def test_all_controls_have_names_and_are_reached_by_keys(browser, live):
    with opened(browser, f"{live}?{SHORT}") as page:
        nameless = """Array.from(document.querySelectorAll("input, select, button, a")).filter(
            (one) => !(one.ariaLabel || one.labels?.length || one.textContent.trim()))"""
        assert page.evaluate(f"{nameless}.length") == 0
        page.locator("#map").focus()
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "fit"
        reached = set()
        for _ in range(60):
            page.keyboard.press("Tab")
            code = "document.activeElement.name || document.activeElement.id"
            reached.add(page.evaluate(code))
        assert {"link", "map", "fit", "Metric", "slide.Td", "Td", "contact", "t_end"} <= reached


def test_malformed_and_oversized_events_are_refused(browser, live):
    bokeh = ("Failed to execute 'close' on 'WebSocket'",)
    with opened(browser, f"{live}?{SHORT}", complaints=bokeh) as page:
        event = "Bokeh.documents[0].get_model_by_name('events').data = {json: [%s]}"
        page.evaluate(event % "'nonsense'")
        notice = page.get_by_role("alert")
        expect(notice).to_contain_text("an event that is none")
        click(page, 0.5, 0.5)
        motions(page, 1)
        page.evaluate(event % "'x'.repeat(100000)")  # the server hangs up, and the page comes back
        with page.expect_navigation(timeout=pages.WAIT):
            pass
        settle(page)
        motions(page, 1)
    with opened(browser, f"{live}?{SHORT}") as page:
        click(page, 0.5, 0.5)
        motions(page, 1)


def test_a_page_that_closes_in_the_middle_harms_no_other(browser, live):
    with opened(browser, f"{live}?{SHORT}") as page:
        other = page.context.new_page()
        other.goto(f"{live}?{SHORT}&integrator=rk4_events")
        other.close()  # while it computes
        click(page, 0.6, 0.6)
        motions(page, 1)


def test_a_store_is_cut_and_reduced(browser, stored, cube):
    with opened(browser, stored) as page:
        slider = page.locator('input[name="slide.Td"]')
        slider.focus()
        slider.press("ArrowRight")
        page.wait_for_function("window.explorer.said().view.at.Td === '12.0'")
        click(page, 0.5, 0.5)
        (nmse,) = motions(page, 1)
        assert exact(page, "nmse") == nmse
        before = pixels(page)
        page.locator('input[name="over.Td"]').click()
        page.wait_for_function("window.explorer.said().view.over.length === 1")
        page.wait_for_function("window.explorer.said().legend")
        page.locator('select[name="all values"]').select_option("share")
        page.wait_for_function("window.explorer.said().title.includes('share of cells')")
        assert (pixels(page) != before).any()


def test_older_words_do_not_set_a_control_back(browser, stored):
    with opened(browser, stored) as page:
        checked = page.evaluate("""() => {
          const box = document.querySelector('input[name="over.Td"]');
          const before = JSON.stringify(window.explorer.said());
          box.click();
          Bokeh.documents[0].get_model_by_name("words").data = { json: [before] };
          return box.checked;
        }""")
        assert checked
        page.wait_for_function("window.explorer.said().view.over.length === 1")
        assert page.locator('input[name="over.Td"]').is_checked()


def test_a_running_sweep_fills_in(browser, tmp_path):
    path = ran(tmp_path / "cube.zarr", CUBE, chunk=12, blocks=[0, 1])
    with serving(path) as link, opened(browser, f"{link}?contact=hard_stop&Td=1.0") as page:
        page.wait_for_selector("#legend .not-run")
        rest = threading.Thread(target=runner.run, args=(open_store(path), lambda _: None))
        rest.start()
        page.wait_for_function("!document.querySelector('#legend .not-run')")
        rest.join(timeout=60)
        expect(page.locator("#state")).to_have_text("")

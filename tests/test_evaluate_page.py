"""The report in a real browser."""

import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from torch_vdm import read_image, write_image
from torch_vdm.cli import main

FRAMES, HEIGHT, WIDTH = 7, 60, 90
NAMES = ["A", "<h6>B"]
EVIL = "<script>alert(1)<:script>"  # what a file may be called


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the output folder of an evaluation of linear frames, one of them with foul names."""
    folder = tmp_path_factory.mktemp("report")
    generator = torch.Generator().manual_seed(1)
    for name in ("ref", "a", "b"):
        (folder / name).mkdir()
    for number in range(FRAMES):
        frame = EVIL if number == 6 else f"{number:03}"
        reference = 4.0 * torch.rand(3, HEIGHT // 6, WIDTH // 6, generator=generator)
        reference = reference.repeat_interleave(6, 1).repeat_interleave(6, 2)
        noise = torch.randn(reference.shape, generator=generator)
        write_image(folder / f"ref/{frame}.exr", reference)
        for name, size in (("a", 0.05 * (1 + number)), ("b", 0.02)):
            write_image(folder / f"{name}/{frame}.exr", (reference + size * noise).abs())
    (folder / "b/001.exr").write_bytes(b"broken")
    command = ["evaluate", f"--reference={folder}/ref", f"--output={folder}/out"]
    command += [f"--test={NAMES[0]}={folder}/a", f"--test={NAMES[1]}={folder}/b", "--flicker"]
    assert main([*command, "--fail-above", "1"]) == 1
    return folder / "out"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Start a browser without a window; skip where there is none."""
    binary = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    try:
        from selenium.webdriver import Chrome, ChromeOptions
        from selenium.webdriver.chrome.service import Service
    except ImportError:
        binary = None
    if not binary or not driver:
        pytest.skip("no browser: apt-get install chromium chromium-driver; pip install selenium")
    options = ChromeOptions()
    options.binary_location = binary
    for argument in (
        "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
        "--window-size=1280,900", "--force-device-scale-factor=1", "--lang=en",
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = Chrome(options=options, service=Service(driver))
    yield browser
    browser.quit()


@pytest.fixture
def page(chromium: Any, report: Path) -> Iterator[Any]:
    """Open the summary; afterwards nothing may have been said on the console."""
    chromium.get("about:blank")
    chromium.get(f"{(report / 'report.html').as_uri()}")
    yield chromium
    # But that these tests look at the canvas.
    said = [line for line in chromium.get_log("browser") if "readback" not in line["message"]]
    assert said == []


def value(page: Any, script: str, *arguments: object) -> Any:
    return page.execute_script(f"return {script}", *arguments)


def wait(page: Any, condition: str) -> None:
    """Wait until a JavaScript expression is true."""
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(page, 20, 0.02).until(lambda _: value(page, condition))


def open_frame(page: Any, number: int) -> None:
    """Open a frame of the page and wait for its pictures."""
    page.execute_script("location.hash = arguments[0]", f"#{number}")
    wait(page, f"view.row?.number === {number} && painted()")


@pytest.fixture(autouse=True)
def _helpers(page: Any) -> None:
    # The last drawing that was asked for is on the canvas.
    page.execute_script(
        "window.painted = () => $('panes').dataset.asked === $('panes').dataset.painted"
    )


def press(page: Any, keys: str) -> None:
    page.find_element("tag name", "body").send_keys(keys)


def middle(page: Any) -> list[float]:
    """Return what pixel of the picture lies in the middle of a pane, x and y."""
    half = "[panes()[0].clientWidth / 2, panes()[0].clientHeight / 2]"
    return list(value(page, f"view.transform.invert({half})"))


def point(page: Any, x: int, y: int) -> str:
    """Move the pointer to a place of the canvas, from its left top, and return what is told."""
    from selenium.webdriver import ActionChains

    canvas = page.find_element("css selector", "#panes canvas")
    width, height = canvas.size["width"], canvas.size["height"]
    ActionChains(page, duration=0).move_to_element_with_offset(
        canvas, x - width // 2, y - height // 2
    ).perform()
    return str(value(page, "$('value').textContent"))


def test_the_table_sorts_and_filters(page: Any) -> None:
    def first() -> list[str]:
        cells = "[...$('frames').tBodies[0].rows].map((row) => row.cells[2].textContent)"
        return list(value(page, cells))

    assert len(first()) == 2 * FRAMES - 1
    worst_first = [float(text) for text in first()]
    assert worst_first == sorted(worst_first, reverse=True)
    page.find_element("css selector", "#frames th[data-by='0'] button").click()
    assert [float(text) for text in first()] == worst_first[::-1]
    assert value(page, "$('frames').tHead.rows[0].cells[2].ariaSort") == "ascending"
    page.find_element("css selector", "#frames th[data-by='frame'] button").click()
    names = value(page, "[...$('frames').tBodies[0].rows].map((row) => row.cells[0].textContent)")
    assert names[:2] == ["000", "000"]
    page.find_element("id", "filter").send_keys("003")
    assert len(first()) == 2
    assert value(page, "$('found').textContent") == "2 of 13"


def test_what_is_said_is_text(page: Any) -> None:
    assert value(page, "document.querySelectorAll('h6').length") == 0
    assert value(page, "document.querySelectorAll('body > script').length") == 3
    assert NAMES[1] in value(page, "$('verdicts').textContent")
    assert EVIL in value(page, "$('frames').textContent")
    assert value(page, "$('skipped').querySelectorAll('tr').length") == 1
    wait(page, "[...document.querySelectorAll('#worst img')].some((image) => image.naturalWidth)")


def test_a_click_on_a_worst_region_goes_there(page: Any) -> None:
    page.find_element("css selector", "#worst a").click()
    wait(page, "view.row && painted()")
    assert value(page, "!$('frame').hidden && $('summary').hidden")
    peak, region = value(page, "[view.row.peak, view.row.regions[0]]")
    left, top, width, height, jnd = region
    assert middle(page) == pytest.approx([left + width / 2, top + height / 2])
    assert left <= peak[0] < left + width
    assert jnd == value(page, "Number(maximum(view.row).toFixed(2))")


def test_the_value_under_the_pointer_is_the_maps(page: Any, report: Path) -> None:
    for number in (0, 2 * FRAMES - 2):
        open_frame(page, number)
        frame, test = value(page, "[view.row.frame, testName(view.row)]")
        jnd = read_image(report / "maps" / test / f"{frame}.exr")[0]
        seen = set()
        for place in ((120, 20), (300, 211), (551, 102), (640, 400)):
            told = point(page, *place)
            found = re.fullmatch(r"x (\d+), y (\d+): ([\d.]+) JND", told)
            assert found is not None, told
            x, y = int(found[1]), int(found[2])
            assert float(found[3]) == pytest.approx(jnd[y, x].item(), abs=0.00501)
            # The picture is as large as fits, in the middle.
            width, height = value(page, "[panes()[0].width, panes()[0].height]")
            scale = min(width / WIDTH, height / HEIGHT)
            assert x == pytest.approx(WIDTH / 2 + (place[0] - width / 2) / scale, abs=1.2)
            assert y == pytest.approx(HEIGHT / 2 + (place[1] - height / 2) / scale, abs=1.2)
            seen.add((x, y))
        assert len(seen) == 4


def test_zoom_keeps_what_is_under_the_pointer(page: Any) -> None:
    open_frame(page, 0)
    before = point(page, 200, 150)
    scale = value(page, "view.transform.k")
    page.execute_script(
        """const box = panes()[0].getBoundingClientRect();
        panes()[0].dispatchEvent(new WheelEvent("wheel", {deltaY: -600, clientX: box.left + 200,
          clientY: box.top + 150, cancelable: true}))"""
    )
    wait(page, "painted()")
    # As d3-zoom has it: 500 pixels of the wheel double the size.
    assert value(page, "view.transform.k") == pytest.approx(2.0**1.2 * scale)
    assert point(page, 200, 150) == before
    page.find_element("id", "fit").click()
    assert value(page, "view.transform.k") == pytest.approx(scale)
    # Dragging moves all layers at once.

    press(page, "+")
    wait(page, "painted()")
    x = middle(page)[0]
    drag(page, 0, -200)
    assert middle(page)[0] < x


def drag(page: Any, number: int, x: int) -> None:
    """Drag a pane by 60 pixels to the right, from a place beside its middle."""
    from selenium.webdriver import ActionChains

    canvas = page.find_elements("css selector", "#panes canvas")[number]
    ActionChains(page, duration=0).move_to_element_with_offset(
        canvas, x, 0
    ).click_and_hold().move_by_offset(60, 0).release().perform()


def test_panes_move_together(page: Any) -> None:
    open_frame(page, 0)
    press(page, "v")
    wait(page, "panes().length === 3 && painted()")
    press(page, "++")
    wait(page, "painted()")
    before, scale = middle(page), value(page, "view.transform.k")
    drag(page, 2, -20)
    wait(page, "painted()")
    assert middle(page) == pytest.approx([before[0] - 60.0 / scale, before[1]])
    kept = value(page, "panes().map((pane) => d3.zoomTransform(pane).x)")
    assert len(set(kept)) == 1
    press(page, "v")


@pytest.mark.parametrize("at", ["60,0,30,30", "0,0,16,16", "74,44,16,16"])
def test_a_region_does_not_jump_at_the_next_gesture(page: Any, at: str) -> None:
    page.execute_script("location.hash = arguments[0]", f"#0/{at}")
    wait(page, "view.row?.number === 0 && painted()")
    point(page, 300, 100)
    before = value(page, "view.transform.invert([300, 100])")
    page.execute_script(
        """const box = panes()[0].getBoundingClientRect();
        panes()[0].dispatchEvent(new WheelEvent("wheel", {deltaY: -50, clientX: box.left + 300,
          clientY: box.top + 100, cancelable: true}))"""
    )
    wait(page, "painted()")
    moved = 2.0 ** (0.002 * 50) * HEIGHT / value(page, "view.transform.k")
    assert value(page, "view.transform.invert([300, 100])") == pytest.approx(before, abs=moved)


def test_what_is_no_region_and_the_skip_link_are_no_harm(page: Any) -> None:
    open_frame(page, 0)
    for at in ("10,10,0,0", "0,0,0,0", ",,,", "99999,99999,5,5"):
        page.execute_script("location.hash = arguments[0]", f"#0/{at}")
        wait(page, f"location.hash.endsWith('{at}') && painted()")
        assert value(page, "Number.isFinite(view.transform.k)"), at
        assert value(page, "region") is None
    page.execute_script("location.hash = '#main'")
    wait(page, "painted()")
    assert not value(page, "$('frame').hidden")


def test_the_value_stays_that_under_the_pointer(page: Any) -> None:
    open_frame(page, 0)
    point(page, 300, 150)
    press(page, "++")
    wait(page, "painted()")
    x, y = value(page, "view.transform.invert([300, 150]).map(Math.floor)")
    assert value(page, "$('value').textContent").startswith(f"x {x}, y {y}:")


def test_another_size_of_the_window_shows_the_same_place(page: Any) -> None:
    open_frame(page, 0)

    def resize(width: int, ratio: float = 1.0) -> None:
        metrics = {"width": width, "height": 700, "deviceScaleFactor": ratio, "mobile": False}
        page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        settled = "String(paneSize()) === String(view.size) && painted()"
        wait(page, f"innerWidth === {width} && devicePixelRatio === {ratio} && {settled}")

    try:
        resize(1000)
        fitting = "fittingScale(paneSize())"
        assert value(page, "view.transform.k") == pytest.approx(value(page, fitting))
        # The browser's own zoom.
        resize(800, 1.25)
        assert value(page, "view.transform.k") == pytest.approx(value(page, fitting))
        assert middle(page) == pytest.approx([WIDTH / 2, HEIGHT / 2])
        press(page, "++")
        drag(page, 0, -50)
        wait(page, "painted()")
        before, scale = middle(page), value(page, "view.transform.k")
        for size in ((620, 1.0), (500, 2.0), (800, 1.25)):
            resize(*size)
            assert middle(page) == pytest.approx(before, abs=0.5)
            assert value(page, "view.transform.k") == pytest.approx(scale)
        # What has had no room begins anew.
        resize(20)
        resize(800, 1.25)
        assert value(page, "view.transform.k") == pytest.approx(value(page, fitting))
        assert value(page, "panes()[0].width") == round(1.25 * value(page, "view.size[0]"))
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def colour(page: Any, x: int, y: int) -> list[int]:
    data = f"panes()[0].getContext('2d').getImageData({x}, {y}, 1, 1).data"
    return list(value(page, f"[...{data}].slice(0, 3)"))


def test_the_slider_shows_one_or_the_other(page: Any) -> None:
    open_frame(page, 0)
    page.execute_script("setSlider(1)")
    wait(page, "painted()")
    reference = colour(page, 100, 200)
    page.execute_script("$('slider').value = 0; $('slider').dispatchEvent(new Event('input'))")
    wait(page, "painted()")
    mapped = colour(page, 100, 200)
    assert reference != mapped
    press(page, "]]]]")  # 0.2 of the width
    wait(page, "painted()")
    assert colour(page, 100, 200) == reference
    assert colour(page, int(value(page, "panes()[0].width")) - 100, 200) != reference
    press(page, "m")
    wait(page, "painted()")
    assert value(page, "$('right').value") == "test"
    assert "left and A right" in value(page, "panes()[0].getAttribute('aria-label')")
    # The line between them is dragged.
    drag(page, 0, int(value(page, "panes()[0].clientWidth * (view.slider - 0.5)")))
    moved = 0.2 + 60.0 / value(page, "panes()[0].clientWidth")
    assert value(page, "view.slider") == pytest.approx(moved, abs=0.002)


def test_exposure_shows_what_is_over_white(page: Any) -> None:
    open_frame(page, 0)
    page.execute_script("setSlider(1)")
    wait(page, "painted()")
    data = "panes()[0].getContext('2d').getImageData(x * 10, 60, 1, 1).data[0]"
    place = f"[...Array(90).keys()].map((x) => {data})"
    assert 255 in value(page, place)
    page.execute_script("$('exposure').value = -4; $('exposure').dispatchEvent(new Event('input'))")
    wait(page, "painted()")
    darker = value(page, place)
    assert 255 not in darker
    assert len(set(darker)) > 8


def test_keys_do_everything(page: Any) -> None:
    open_frame(page, 0)
    order = value(page, "order.rows.map((row) => row.number)")
    press(page, "n")
    following = order[(order.index(0) + 1) % len(order)]
    wait(page, f"view.row.number === {following} && painted()")
    press(page, "p")
    wait(page, "view.row.number === 0 && painted()")
    press(page, "t")
    wait(page, "view.row.number === 1 && painted()")
    press(page, "v")
    wait(page, "painted()")
    assert value(page, "panes().length") == 3
    press(page, "v+")
    wait(page, "painted()")
    x = middle(page)[0]
    page.find_element("id", "panes").send_keys("\ue014")  # the arrow to the right
    wait(page, "painted()")
    assert middle(page)[0] > x
    press(page, "?")
    assert value(page, "$('help').open")
    press(page, "\ue00c")  # Esc closes the keys, and then leaves the frame
    assert not value(page, "$('help').open")
    assert value(page, "$('summary').hidden")
    press(page, "\ue00c")
    wait(page, "!$('summary').hidden")


def test_light_and_dark(page: Any) -> None:
    def background() -> str:
        return str(value(page, "getComputedStyle(document.body).backgroundColor"))

    before = background()
    press(page, "d")
    assert background() != before
    page.find_element("id", "theme").click()
    assert background() == before


def test_a_narrow_screen_scrolls_in_one_direction(page: Any) -> None:
    metrics = {"width": 390, "height": 800, "deviceScaleFactor": 2, "mobile": True}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        assert value(page, "document.documentElement.scrollWidth") <= 390
        open_frame(page, 0)
        assert value(page, "document.documentElement.scrollWidth") <= 390
        assert value(page, "panes()[0].width") == pytest.approx(2 * 370, abs=30)
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_everything_has_a_name(page: Any) -> None:
    open_frame(page, 0)
    unnamed = """[...document.querySelectorAll("button, input, select, canvas, img, svg")].filter(
        (each) => !(each.textContent.trim() || each.getAttribute("aria-label") || each.alt
            || each.labels?.length)).map((each) => each.outerHTML)"""
    assert value(page, unnamed) == []


def test_a_picture_that_is_missing_is_told(page: Any, report: Path) -> None:
    open_frame(page, 0)
    name = value(page, "rows[4].pictures[2]")
    path = report / "pictures" / f"{name}.js"
    hidden = path.rename(path.with_suffix(".hidden"))
    page.execute_script("location.hash = '#4'")
    wait(page, "$('state').textContent.includes('missing')")
    hidden.rename(path)
    page.get_log("browser")  # the browser says so too


def test_a_picture_that_is_cut_off_is_told(page: Any, report: Path) -> None:
    open_frame(page, 0)
    path = report / "pictures" / f"{value(page, 'rows[2].pictures[0]')}.js"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    page.execute_script("location.hash = '#2'")
    wait(page, "$('state').textContent.includes('damaged')")
    path.write_bytes(whole)
    assert "000" not in value(page, "panes()[0].getAttribute('aria-label')").split("frame")[1]
    page.get_log("browser")  # the browser says so too


def test_going_back_quickly_leaves_no_message(page: Any) -> None:
    open_frame(page, 0)
    page.execute_script(
        """const before = arrived;
        arrived = async (name) => {
          await new Promise((resolve) => setTimeout(resolve, 700));
          return before(name);
        };
        location.hash = "#6";
        setTimeout(() => { location.hash = "#0"; }, 100)"""
    )
    time.sleep(1.5)
    assert value(page, "[view.row.number, $('state').textContent]") == [0, ""]

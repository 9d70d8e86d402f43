"""What a page shows in a real browser: whether there is one, and how tests use it."""

import base64
import shutil
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
browsing = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="no browser installed (apt-get install chromium chromium-driver)"
)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
)


def open_page(browser, page, *, size=(1440, 900), scheme="light"):
    """Load `page` from the disk and wait until its animation is there; nothing may have gone wrong."""
    from selenium.webdriver.support.ui import WebDriverWait

    set_screen(browser, size, scheme)
    browser.get_log("browser")
    browser.get(page.as_uri())
    ready = (
        "document.documentElement.dataset.ready === 'yes'" if page.name == "report.html" else "viewer.animator.duration"
    )
    WebDriverWait(browser, 30).until(lambda b: b.execute_script(f"return Boolean({ready})"))


def set_screen(browser, size, scheme):
    """The size of the screen [pixels], a phone's below 600, and whether it is "light" or "dark"."""
    screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size[0] < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)


def wait_for_frame(browser):
    """Until the page has been drawn again."""
    browser.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")


def colours(picture):
    """How many colours a picture (n, m, 3) of 0 to 1 has: a blank one has few."""
    bytes_ = np.round(255 * picture).astype(int)
    return len(np.unique(bytes_ @ [65536, 256, 1]))


def errors(browser):
    """What the console complains of; SwiftShader's remarks on its own speed are none of ours."""
    return [entry["message"] for entry in browser.get_log("browser") if "GPU stall" not in entry["message"]]


def move_slider(browser, part):
    browser.execute_script(
        "const s = document.getElementById('time');s.value = arguments[0] * s.max; s.dispatchEvent(new Event('input'))",
        part,
    )
    wait_for_frame(browser)


def view_of(browser):
    """The 3D view's pixels, as it was last drawn."""
    import matplotlib.image

    url = browser.execute_script(
        "const v = (document.getElementById('view') || {contentWindow: window}).contentWindow.viewer;"
        "v.render(); return v.renderer.domElement.toDataURL('image/png')"
    )
    return matplotlib.image.imread(BytesIO(base64.b64decode(url.split(",")[1])))[..., :3]


READABLE = (Path(__file__).parent / "readable.js").read_text(encoding="utf-8")


def faint_texts(browser):
    """Texts in view whose contrast is below WCAG's AA, with the element and the ratio; those of drawings apart."""
    return browser.execute_script(READABLE + "return faint();")


def nameless(browser):
    """Controls and pictures that a screen reader has no words for."""
    return browser.execute_script(READABLE + "return nameless();")


def badly_laid(browser):
    """What leaves the page, is cut without a way to read it, or lies on another text."""
    return browser.execute_script(READABLE + "return badlyLaid();")

"""Functions for tests of pages in a real browser, which are skipped if no browser is installed."""

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
    """Load `page` from the disk and wait until its animation is ready."""
    from selenium.webdriver.support.ui import WebDriverWait

    set_screen(browser, size, scheme)
    browser.get_log("browser")
    browser.get(page.as_uri())
    ready = (
        "document.documentElement.dataset.ready === 'yes'" if page.name == "report.html" else "viewer.animator.duration"
    )
    WebDriverWait(browser, 30).until(lambda b: b.execute_script(f"return Boolean({ready})"))


def set_screen(browser, size, scheme):
    """Set the size of the screen [pixels], a phone's below 600, and its colour scheme, "light" or "dark"."""
    screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size[0] < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)


def wait_for_frame(browser):
    """Wait until the page has been drawn again."""
    browser.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")


def colours(picture):
    """Return the number of colours of a picture (n, m, 3) with values from 0 to 1. A blank picture has few."""
    bytes_ = np.round(255 * picture).astype(int)
    return len(np.unique(bytes_ @ [65536, 256, 1]))


def errors(browser):
    """Return the messages in the console, without SwiftShader's messages about its own speed."""
    return [entry["message"] for entry in browser.get_log("browser") if "GPU stall" not in entry["message"]]


def move_slider(browser, part):
    browser.execute_script(
        "const s = document.getElementById('time');s.value = arguments[0] * s.max; s.dispatchEvent(new Event('input'))",
        part,
    )
    wait_for_frame(browser)


def view_of(browser):
    """Draw the 3D view and return its pixels."""
    import matplotlib.image

    url = browser.execute_script(
        "const v = (document.getElementById('view') || {contentWindow: window}).contentWindow.viewer;"
        "v.render(); return v.renderer.domElement.toDataURL('image/png')"
    )
    return matplotlib.image.imread(BytesIO(base64.b64decode(url.split(",")[1])))[..., :3]


READABLE = (Path(__file__).parent / "readable.js").read_text(encoding="utf-8")


def faint_texts(browser):
    """Return visible texts with a contrast below WCAG's AA, with element and ratio, except texts in drawings."""
    return browser.execute_script(READABLE + "return faint();")


def nameless(browser):
    """Return the controls and pictures that have no name for a screen reader."""
    return browser.execute_script(READABLE + "return nameless();")


def badly_laid(browser):
    """Return elements that leave the page, are cut without a way to read them, or overlap another text."""
    return browser.execute_script(READABLE + "return badlyLaid();")

"""Headless Chromium for tests and screenshots; it reaches nothing outside this machine."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from selenium.common.exceptions import (
    ElementClickInterceptedException,
    JavascriptException,
    NoSuchElementException,
    StaleElementReferenceException,
)
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.wait import WebDriverWait

from tests.support.waiting import HANG_S

PROGRAMS = ("chromium", "chromedriver")
WORDS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic"),
    *("--no-first-run", "--no-proxy-server", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"),
)
# Otherwise MLflow opens its assistant's panel on the first visit.
BEFORE_EACH_PAGE = "localStorage.setItem('mlflow.assistant.fab.autoOpenedOnFirstLoad_v1', 'true')"
FIND = """
    const isRead = (each, text) => (each.innerText ?? each.textContent).trim().replace(/\\s+/g, " ") === text;
    const seen = [...document.querySelectorAll(arguments[0])].filter((each) => each.getClientRects().length > 0);
    return seen.findLast((each) => arguments[1] === null || isRead(each, arguments[1])) ?? null;
"""
# After the charts have followed the change of the page's width.
WIDER = """
    const done = arguments[0];
    setTimeout(() => done([...document.querySelectorAll("html, body *:not(.wide):not(.wide *)")].filter((each) =>
        each.clientWidth > 0 && !(each instanceof SVGElement) && each.scrollWidth > each.clientWidth + 1
    ).map((each) => `${each.tagName} ${each.className}`)), 1000);
"""


def programs() -> tuple[str, str] | None:
    """Return the paths of the browser and its driver; None if one is not installed."""
    browser, driver = (shutil.which(name) for name in PROGRAMS)
    return (browser, driver) if browser and driver else None


@contextmanager
def chromium(profile: Path, *, width: int = 1400, height: int = 900) -> Iterator[Browser]:
    """Open a browser; close it at the end of the block.

    Args:
        profile: Folder of its profile.
        width: Width of the page in pixels.
        height: Height of the page in pixels.
    """
    found = programs()
    assert found is not None
    options = ChromeOptions()
    options.binary_location = found[0]
    for word in (*WORDS, f"--user-data-dir={profile}"):
        options.add_argument(word)
    driver = Chrome(options=options, service=Service(executable_path=found[1]))
    try:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser = Browser(driver)
        browser.before_each_page(BEFORE_EACH_PAGE)
        yield browser
    finally:
        driver.quit()


class Browser:
    """A browser that waits until what it is asked for is there.

    Args:
        driver: Driver of Selenium.
    """

    def __init__(self, driver: Chrome) -> None:
        self.driver = driver
        # Raised while a page changes.
        passing = (
            ElementClickInterceptedException,
            JavascriptException,
            NoSuchElementException,
            StaleElementReferenceException,
        )
        self._wait = WebDriverWait(driver, HANG_S, poll_frequency=0.1, ignored_exceptions=passing)

    def before_each_page(self, program: str) -> None:
        """Run JavaScript before the scripts of each page."""
        self.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": program})

    def open(self, address: str) -> None:
        """Go to an address."""
        self.driver.get(address)

    @property
    def address(self) -> str:
        """The address of the page."""
        return self.driver.current_url

    def find(self, css: str, *, text: str | None = None) -> WebElement:
        """Wait for a visible element and return it; of several, the last one, which is the innermost.

        Args:
            css: CSS selector of the element.
            text: Whole text of the element; None for any text.
        """
        element = self._wait.until(lambda _: self._seen(css, text), f"there is no {css} {text or ''}")
        assert isinstance(element, WebElement)
        return element

    def has(self, css: str, *, text: str) -> bool:
        """Return whether an element is on the page now; see `find`."""
        return self._seen(css, text) is not None

    def click(self, css: str, *, text: str | None = None) -> None:
        """Click on an element, as soon as nothing covers it."""

        def clicked(_: Chrome) -> bool:
            element = self.find(css, text=text)
            self._scroll_to(element)
            element.click()
            return True

        self._wait.until(clicked)

    def type(self, css: str, text: str) -> None:
        """Write into an element."""
        self.find(css).send_keys(text)

    def count(self, css: str, at_least: int) -> int:
        """Wait until there are at least this many elements; return their number."""

        def counted(driver: Chrome) -> int:
            n = len(driver.find_elements(By.CSS_SELECTOR, css))
            return n if n >= at_least else 0

        return int(self._wait.until(counted, f"fewer than {at_least} of {css}"))

    def picture(self, css: str) -> int:
        """Scroll to a picture, wait until it has loaded, and return its width in pixels."""

        def read(driver: Chrome) -> int:
            image = driver.find_element(By.CSS_SELECTOR, css)
            self._scroll_to(image)
            return int(image.get_property("naturalWidth") or 0)

        return int(self._wait.until(read, f"no picture {css}"))

    def wider_than_page(self, width: int) -> list[str]:
        """Return the tags and classes of elements that overflow a page of this width; charts may be scrolled."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        found = self.driver.execute_async_script(WIDER)
        assert isinstance(found, list)
        return found

    def keep(self, file: Path) -> None:
        """Save a screenshot."""
        file.parent.mkdir(parents=True, exist_ok=True)
        assert self.driver.save_screenshot(str(file))

    def _seen(self, css: str, text: str | None) -> WebElement | None:
        found = self.driver.execute_script(FIND, css, text)
        return found if isinstance(found, WebElement) else None

    def _scroll_to(self, element: WebElement) -> None:
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)

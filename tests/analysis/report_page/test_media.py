"""The report on a phone, on a dark screen and on paper, in chromium."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from analysis.commands.report_page.report import write_report
from tests.analysis.responses import synthetic

pytest.importorskip("selenium")
from selenium import webdriver

from tests.browser_picture import open_browser

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(not Path("/usr/bin/chromedriver").exists(), reason="needs chromium with chromedriver"),
]
PHONE_WIDTH = 390
# Contrast that WCAG requires of text.
MIN_CONTRAST = 4.5
# Contrast of the text of each element with the page.
CONTRASTS = """
const luminance = (color) => color.match(/[\\d.]+/g).slice(0, 3).map((part) => part / 255)
  .map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4))
  .reduce((sum, part, k) => sum + [0.2126, 0.7152, 0.0722][k] * part, 0);
const page = luminance(getComputedStyle(document.body).backgroundColor);
return [...document.querySelectorAll("main *")].filter((each) => each.innerText && !each.closest("svg")).map((each) => {
  const own = luminance(getComputedStyle(each).color);
  return [each.tagName, (Math.max(own, page) + 0.05) / (Math.min(own, page) + 0.05)];
});
"""
VISIBLE = "return [...document.querySelectorAll(arguments[0])].filter((each) => each.offsetHeight).length"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    folder = tmp_path_factory.mktemp("report")
    synthetic.impulses(folder / "hit.mcap", interval=3.0, name="hit scene")
    [page] = write_report([folder / "hit.mcap"], folder).files
    driver = open_browser()
    try:
        driver.get(page.as_uri())
        yield driver
    finally:
        driver.quit()


def emulate(browser: webdriver.Chrome, width: int = 1280, media: str = "", scheme: str = "light") -> None:
    metrics = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 700}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": features})


def test_phone_page_has_the_width_of_the_screen(browser: webdriver.Chrome) -> None:
    emulate(browser, PHONE_WIDTH)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= PHONE_WIDTH


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_sufficient_contrast(browser: webdriver.Chrome, scheme: str) -> None:
    emulate(browser, scheme=scheme)
    contrasts = browser.execute_script(CONTRASTS)
    assert len(contrasts) > 50 and [each for each in contrasts if each[1] < MIN_CONTRAST] == []


def test_paper_has_no_controls(browser: webdriver.Chrome) -> None:
    emulate(browser)
    assert browser.execute_script(VISIBLE, "nav, .tools")
    emulate(browser, media="print")
    assert not browser.execute_script(VISIBLE, "nav, .tools") and browser.execute_script(VISIBLE, ".chart")


def test_pages_of_all_media_log_nothing(browser: webdriver.Chrome) -> None:
    for scheme, media, width in (("dark", "", 1280), ("light", "print", 1280), ("light", "", PHONE_WIDTH)):
        emulate(browser, width, media, scheme)
    assert browser.get_log("browser") == []

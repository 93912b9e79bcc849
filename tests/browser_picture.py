"""Draw a page as the browser shows it: `python -m tests.browser_picture PAGE.html|bench PICTURE.png`."""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

# Duration of the sweep on the bench, with the time until the force is settled, s.
_LONGEST_SWEEP_S = 180.0


def open_browser(width: int = 1280, height: int = 800, scale: float = 1.0) -> webdriver.Chrome:
    """Open chromium without a window of this size, with `scale` pixels of a picture for each of the page."""
    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    for word in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "disable-gpu", "hide-scrollbars"):
        options.add_argument(f"--{word}")
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService("/usr/bin/chromedriver"))
    size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    return driver


def draw_bench(picture: str) -> None:
    """Draw the bench at the last resonance of a sweep."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "daq", "bench", "fig8-three-dampers", "--no-browser", "--port", "0"]
        command += ["--device-port", "0", "-o", str(Path(folder) / "sweep.mcap")]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as bench:
            driver = open_browser()
            try:
                assert bench.stdout is not None
                driver.get(bench.stdout.readline().split()[-1])
                waiting = WebDriverWait(driver, _LONGEST_SWEEP_S)
                waiting.until(lambda page: page.find_element(By.ID, "message").text == "ready")
                driver.find_element(By.ID, "start").click()
                # A busy machine delays the bench, which a picture should not show.
                waiting.until(
                    lambda page: (
                        re.match(r"8\d %", page.find_element(By.ID, "progress").text)
                        and page.find_element(By.ID, "lag").text == ""
                    )
                )
                driver.save_screenshot(picture)
            finally:
                driver.quit()
                bench.terminate()


def draw_page(page: str, picture: str) -> None:
    """Draw a report to the end of the first panel of its first chart."""
    # The narrowest page with the rig beside the answer, so that both are legible on the start page.
    driver = open_browser(880, 800, 1.5)
    try:
        driver.get(Path(page).resolve().as_uri())
        end = driver.execute_script("return document.querySelector('.chart .uplot').getBoundingClientRect().bottom")
        size = {"width": 880, "height": round(end), "deviceScaleFactor": 1.5, "mobile": False}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        driver.save_screenshot(picture)
    finally:
        driver.quit()


if __name__ == "__main__":
    source, target = sys.argv[1:]
    if source == "bench":
        draw_bench(target)
    else:
        draw_page(source, target)

"""A user session on the bench page in a real browser: start a sweep, observe the resonance, record, analyze."""

import contextlib
import functools
import http.server
import os
import re
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType

import analysis
import daq
from daq.extras.ni_server.client_defaults import open_channel
from rig.core.base.palette import BODIES, HAMMER, contrast, on_dark
from tests.daq.bench_page.test_bench import BRACKET, SHAKER_TEST

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
pytest.importorskip("starlette", reason="the extra 'bench' is not installed")

from selenium.common.exceptions import StaleElementReferenceException  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")
TIMEOUT_S = 120.0
# JavaScript for frequencies and magnitudes of a channel in the frequency response.
CURVE = """
const row = response.curves?.rows.find(each => each.name === arguments[0]);
return row ? [Array.from(response.curves.frequency), Array.from(row.magnitude)] : null;
"""
# JavaScript for the elements that end outside the window.
OUTSIDE = """
return [...document.querySelectorAll('body *')].filter(each => {
    const box = each.getBoundingClientRect();
    return box.width && (box.right > innerWidth + 1 || (innerWidth > 900 && box.bottom > innerHeight + 1))
        && !each.closest('svg') && each.tagName !== 'OPTION';
}).map(each => each.outerHTML.slice(0, 80));
"""
# JavaScript that stores all texts of the state, because a busy machine may miss a short one.
STORE_STATES = """
const label = document.querySelector('[data-testid=state]');
window.states = [];
new MutationObserver(() => window.states.push(label.textContent))
    .observe(label, {childList: true, characterData: true, subtree: true});
"""


@pytest.fixture
def bench(tmp_path):
    """A bench in a separate process: address of the page, address of the device, process."""
    (tmp_path / "bracket.yaml").write_text(BRACKET.replace("PLACE", "shaker") + SHAKER_TEST, encoding="utf-8")
    command = [sys.executable, "-m", "daq", "bench", "bracket.yaml", "--no-browser", "-o", "rec/test.mcap"]
    process = subprocess.Popen(
        [*command, "--port", "0", "--device-port", "0"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )
    try:
        page, device = process.stdout.readline().strip(), process.stdout.readline()
        yield page, re.search(r"127\.0\.0\.1:\d+", device)[0], process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def browser():
    if not (CHROMIUM.exists() and DRIVER.exists()):
        pytest.skip("no chromium with chromedriver in /usr/bin (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for word in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--disable-gpu",
        "--window-size=1280,800",
    ):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(DRIVER)))
    with contextlib.closing(contextlib.ExitStack()) as stack:
        stack.callback(driver.quit)
        yield driver


def element(browser, name):
    return browser.find_element(By.CSS_SELECTOR, f"[data-testid={name}]")


def wait_for(browser, condition):
    """Return the value of the condition once it is true; on a busy machine the page may be loaded twice."""
    wait = WebDriverWait(browser, TIMEOUT_S, ignored_exceptions=(StaleElementReferenceException,))
    return wait.until(lambda driver: condition())


def set_number(browser, name, value):
    field = browser.find_element(By.CSS_SELECTOR, f"input[data-testid={name}]")
    browser.execute_script("arguments[0].select()", field)
    field.send_keys(str(value))


@pytest.mark.thorough
def test_sweep_is_displayed_recorded_and_analyzed(bench, browser, tmp_path):
    page, device, process = bench
    browser.get(page)
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    for name, value in {"level": 5, "low": 57, "high": 67, "duration": 8}.items():
        set_number(browser, name, value)
    # Another program reads the noise of a channel, and the page shows its task. A task that runs after the sweep would
    # have a recording of its own.
    with open_channel(device) as channel, nidaqmx.Task("other", grpc_options=_options(channel)) as task:
        task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0")
        task.timing.cfg_samp_clk_timing(1024.0, samps_per_chan=1024)
        task.start()
        wait_for(browser, lambda: "other" in element(browser, "clients").text)
        assert np.ptp(task.read(1024)) > 0.0
    wait_for(browser, lambda: "other" not in element(browser, "clients").text)
    browser.execute_script(STORE_STATES)
    element(browser, "record").click()
    element(browser, "start").click()
    # The file is named from the start of the sweep on, which may have ended before a busy machine looks again.
    wait_for(browser, lambda: "test.mcap" in element(browser, "file").text)
    wait_for(browser, lambda: element(browser, "state").text == "sweep test completed")
    assert any(" Hz" in state for state in browser.execute_script("return window.states"))
    wait_for(browser, lambda: browser.execute_script(CURVE, "arm"))
    frequency, magnitude = np.array(browser.execute_script(CURVE, "arm"), float)
    assert frequency[np.nanargmax(magnitude)] == pytest.approx(62.0, abs=1.0)
    assert element(browser, "file").text.startswith("recorded test.mcap; next: analysis frf test.mcap")
    assert browser.find_elements(By.CSS_SELECTOR, "#rig-body_2")
    assert browser.get_log("browser") == []
    with urllib.request.urlopen(page.replace("/?", "/report/1?")) as report:
        assert "test.mcap" in report.read().decode()
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    with daq.open(tmp_path / "rec" / "test.mcap") as recording:
        recording.check()
        frf = analysis.frfs(recording)["arm"]
    assert frf.frequency[np.argmax(abs(frf.value))] == pytest.approx(62.0, abs=0.3)


@pytest.mark.thorough
def test_controls_wait_for_the_bench(bench, browser):
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    is_inert = functools.partial(value_of, browser, "document.getElementById('controls').inert")
    browser.execute_script("socket.close()")
    wait_for(browser, is_inert)
    wait_for(browser, lambda: not is_inert())
    # Until the last command is carried out, messages do not change the fields.
    browser.execute_script("sent++; controls.fields.level[1].value = '7'; window.before = messages")
    wait_for(browser, lambda: value_of(browser, "messages > before + 4"))
    assert value_of(browser, "controls.fields.level[1].value") == "7"
    browser.execute_script("sent--")
    wait_for(browser, lambda: value_of(browser, "controls.fields.level[1].value") == "10")


@pytest.mark.thorough
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (1600, 900), (390, 844)])
def test_page_fits_the_screen(bench, browser, width, height):
    resize(browser, width, height)
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    wait_for(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#rig-body_2"))
    assert browser.execute_script(OUTSIDE) == []
    size = browser.execute_script("const e = document.documentElement; return [e.scrollWidth, e.scrollHeight]")
    assert size[0] <= width and (size[1] <= height or width <= 900)
    assert browser.get_log("browser") == []


def resize(browser, width, height):
    """Set the size of the page's window, px, without the frame of the browser."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


@pytest.mark.thorough
def test_keys_start_freeze_and_stop(bench, browser):
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    browser.find_element(By.TAG_NAME, "body").send_keys(" ")
    wait_for(browser, lambda: element(browser, "pill").text in ("settling", "measuring"))
    browser.find_element(By.TAG_NAME, "body").send_keys("f")
    assert browser.execute_script("return frozen")
    browser.find_element(By.TAG_NAME, "body").send_keys(" ")
    wait_for(browser, lambda: element(browser, "pill").text == "aborted")


def value_of(browser, script):
    return browser.execute_script(f"return {script}")


@pytest.mark.thorough
def test_page_has_the_colors_of_the_figures(bench, browser):
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    colors = dict(browser.execute_script("return channels.map(each => [each.name, each.color])"))
    expected = {"base": BODIES[0], "arm": BODIES[1], "force": HAMMER}
    assert colors == {name: on_dark(color).lower() for name, color in expected.items()}
    panel = value_of(browser, "getComputedStyle(document.querySelector('section')).backgroundColor")
    background = "#{:02x}{:02x}{:02x}".format(*map(int, re.findall(r"\d+", panel)))
    assert min(contrast(color, background) for color in colors.values()) >= 4.5


@pytest.mark.thorough
def test_texts_and_scales_suit_the_values(bench, browser):
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")

    value = functools.partial(value_of, browser)
    # Noise at ±180° does not cross the chart.
    assert value("Array.from(wrapped(Float32Array.of(180, 0, -170)))") == [-180, 0, -170]
    assert value("withInterval(4.276, 1.96)") == "4.3 ± 2.0"
    assert value("targetText({target: 200, force: null})") == "target 200 N"
    forces = "[9.999, 9.9, 10.2].map((force) => targetText({target: 10, force}))"
    assert [text.removeprefix("target 10.0 N ") for text in value(forces)] == ["(0.0 %)", "(−1.0 %)", "(+2.0 %)"]
    # Measured values have equal digits, settings and ticks as few as they need.
    assert value("[2.6, 98, 203, 1234, 0, 2e-5, null].map((number) => reading(number, 3))") == [
        "2.60", "98.0", "203", "1230", "0.00", "2·10⁻⁵", "–",
    ]  # fmt: skip
    assert value("digits(2.60, 3)") == "2.6"
    note = "response.note({hits: [], running: true, frf_reason: ''})"
    assert "1 average: no γ²" in value(f"(response.head = {{averages: 1}}, {note})")
    # The phase of a single hit, without coherence, is drawn where it changes little from line to line.
    phase = "Float32Array.from({length: 200}, (_, k) => k < 100 ? k / 10 : (40 * k) % 180)"
    drawn = value(f"determined({phase}, new Float32Array(200).fill(NaN))")
    assert all(drawn[:70]) and not any(drawn[130:])
    # A few lines among noise have a smooth phase by chance.
    phase = "Float32Array.from({length: 200}, (_, k) => k > 95 && k < 105 ? k / 10 : (40 * k) % 180)"
    assert not any(value(f"determined({phase}, new Float32Array(200).fill(NaN))"))
    # The last coherent run of a growing curve is drawn before it is long.
    runs = "Array.from({length: 60}, (_, k) => k < 20 || (k > 30 && k < 36) || k > 52)"
    drawn = value(f"[false, true].map((grows) => longRuns({runs}, RUN, new Float32Array(60).fill(1), grows))")
    assert [[sum(part[:25]), sum(part[25:45]), sum(part[45:])] for part in drawn] == [[20, 0, 0], [20, 0, 7]]
    # A peak where the curve is thin is uncertain.
    curves = "{frequency: Float32Array.of(0.1, 0.2), rows: [{name: 'a', determined: [true, false]}]}"
    assert value(f"[0.1, 0.2].map((f) => response.isUncertain.call({{curves: {curves}}}, [f, 1, null, 0, 'a']))") == [
        False,
        True,
    ]
    # A peak without damping and with a low coherence is uncertain down to half of its power.
    row = "{smooth: Array(6).fill(true), magnitude: [1, 8, 9, 7, 1, 9], coherence: [0.8, 0.8, 0.8, 0.95, 0.8, 0.8]}"
    assert value(f"outsidePeaks({row}, [2])") == [True, False, False, True, True, True]
    # The axis of a hammer test is logarithmic and ends at the highest excited frequency.
    curves = "{frequency: Float32Array.of(0, 0.5, 1, 300, 400), rows: [{magnitude: Float32Array.of(1, 1, 1, 1, NaN)}]}"
    low, high = value(f"response.range.call({{curves: {curves}}})")
    assert (round(low, 2), high) == (0.95, 300)
    clipped = "cause({unit: 'm/s^2', limit: 490.3325}, READING)"
    assert value(clipped.replace("READING", "490.3")) == "clipped at 50 g"
    assert value(clipped.replace("READING", "588.4")) == "60 g, limit 50 g"
    # The phase of a cursor is the angle of the axis, and an undetermined value has none.
    row = "{magnitude: [1e-4, 2e-4], phase: [-251, -80], relation: [0, 0], determined: [1, 0], angular: [1, 0]}"
    assert value(f"[0, 1].map((k) => response.cell({row}, k))") == ["100\n-251°", "~200\n–"]
    # A test without an accepted impact has its verdict instead of curves.
    rejected = "{hits: [[1, 9, ['clipped'], false, true, [0, 1, 2]]], running: false, frf_reason: ''}"
    hint = f"(response.head = null, response.note({rejected}), $('hint').textContent)"
    assert value(hint) == "No accepted impact: 3 channels clipped. Lower the level."
    assert value("$('hint').checkVisibility()")
    # The scatter of a single impact, and the amplitude of a tone.
    assert value("scatterText({limit: [NaN], force: [NaN]})") == "one impact: scatter unknown"
    assert value("clientLevel({force: Float32Array.of(NaN, 0.5)})") == pytest.approx(
        {"level": 0.5**0.5, "kind": "amplitude"}
    )
    assert value("clientLevel({force: new Float32Array(9).fill(0.5)})") == {"level": 0.5, "kind": "rms"}
    # Cursor A is at the largest of a few tones.
    tones = "frequency: [5, 6, 7], force: Float32Array.of(0.1, 0.5, NaN)"
    assert value(f"[null, 1].map((level) => largestTone({{level, {tones}}}))") == [[6], []]
    # A fault is final, a weak pulse may still rise.
    assert value("[['clipped'], ['too weak'], []].map((faults) => isJudged([1, 9, faults, false, false]))") == [
        True,
        False,
        False,
    ]
    # Idle noise neither fills an axis nor is a line at zero: 7 µm of 0.49 m.
    idle = value("""(() => {
        const kept = channels;
        channels = [{name: 'a', unit: 'm', limit: 0.49}];
        const {range} = panels('idle', [0, 1], [Float32Array.of(7e-6, 0)], false)[0];
        channels = kept;
        return range;
    })()""")
    assert idle == [-50, 50]
    names = "[...document.querySelectorAll('#history-legend [data-name]')].map((entry) => entry.textContent)"
    assert value(names) == value("channels.map((channel) => channel.name)")
    panel = "{name: 'µm', range: [-2000, 2000], curves: [{y: Float32Array.of(1500)}]}"
    assert value(f"inMillimeters({panel}).name") == "mm"
    assert value(f"inMillimeters({panel}).curves[0].y[0]") == 1.5


@pytest.mark.thorough
def test_sharp_peak_ends_at_its_value(bench, browser):
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    script = """(() => {
        const canvas = document.createElement('canvas'), x = [0, 0.44, 0.5, 0.56, 1];
        document.body.append(canvas);
        Object.assign(canvas.style, {position: 'fixed', width: '400px', height: '300px'});
        const chart = new Chart(canvas, {name: 'x', log: false});
        chart.show([0, 1], [{name: 'y', range: [0, 2], curves: [{x, y: [0, 0, 1, 0, 0], color: '#ff0000', width: 4}]}]);
        const {data, width} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        const first = data.findIndex((red, k) => k % 4 === 0 && red > 200 && data[k + 1] < 60);
        const ratio = canvas.width / canvas.clientWidth, highest = Math.floor(first / 4 / width) / ratio;
        return [highest, TOP + (canvas.clientHeight - TOP - BOTTOM) / 2];
    })()"""
    highest, expected = value_of(browser, script)
    # The line is 4 px wide.
    assert highest == pytest.approx(expected, abs=3.0)


@pytest.mark.thorough
def test_overloads_of_all_channels_fit_their_panel(bench, browser):
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    texts = browser.execute_script("""
        socket.onclose = null;
        const overloads = Object.fromEntries(channels.map(({limit}, k) => [k, [54.72, k ? 183.7 : 54.72, limit]]));
        levels.update({state: {levels: channels.map(() => 1), overloads, clipping: []}});
        const panel = $('level-panel');
        return [$('causes').textContent, panel.scrollHeight - panel.clientHeight, $('alarm').hidden];
    """)
    # Each channel has the times of its own first and last overload.
    base, arm, _ = texts[0].split(";")
    assert base == "Overload: base: clipped at 50 g (54.72\u00a0s)"
    assert arm == " arm: clipped at 50 g (54.72 to 183.7\u00a0s)"
    assert texts[1] <= 0 and not texts[2]
    assert browser.execute_script(OUTSIDE) == []
    # A phone has one line.
    resize(browser, 390, 844)
    brief, height = browser.execute_script("""
        const overloads = {0: [54.72, 183.7, 1], 1: [1, 2, 1]};
        levels.update({state: {levels: channels.map(() => 1), overloads, clipping: []}});
        return [$('causes').textContent, $('causes').clientHeight];
    """)
    assert brief == "Overload: base, arm, latest at 183.7\u00a0s. Lower the level." and height < 50


@pytest.mark.thorough
def test_recording_of_clients_can_be_stopped(bench, browser):
    page, device, _ = bench
    browser.get(page)
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    element(browser, "record").click()
    with open_channel(device) as channel, nidaqmx.Task("other", grpc_options=_options(channel)) as task:
        task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0")
        task.timing.cfg_samp_clk_timing(1024.0, sample_mode=AcquisitionType.CONTINUOUS)
        task.start()
        wait_for(browser, lambda: element(browser, "stop").text == "Stop recording")
        element(browser, "stop").click()
        wait_for(browser, lambda: element(browser, "file").text.startswith("recorded test.mcap"))
        assert "other: running" in element(browser, "clients").text


@pytest.mark.thorough
def test_damping_of_moving_dampers_is_approximate(bench, browser):
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    texts = value_of(
        browser,
        """[true, false].map((isLinear) => {
            Object.assign(response, {isLinear, curves: null, head: {peaks: [[34.5, 2e-4, 0.0386, 0.0042, 'a', '']]}});
            response.describe();
            return $('peaks').rows[1].lastChild.textContent;
        })""",
    )
    assert texts == ["3.86 ± 0.42", "~3.9"]


@pytest.mark.thorough
def test_touch_screen_has_hints_for_touch(bench, browser):
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    )
    browser.get(bench[0])
    wait_for(browser, lambda: element(browser, "state").text == "ready")
    value = functools.partial(value_of, browser)
    assert "two taps" in value("CURSOR_HINT")
    # Before a test the page has its message instead of empty axes.
    assert value("[$('hint'), $('frf')].map((each) => each.checkVisibility())") == [True, False]
    browser.find_element(By.ID, "theory").click()
    wait_for(browser, lambda: value("[$('hint'), $('frf')].map((each) => each.checkVisibility())") == [False, True])
    # The last two taps are the cursors.
    browser.execute_script(
        "$('response').classList.remove('empty'); response.chart.draw();"
        "for (const x of [100, 200, 300]) $('frf').dispatchEvent(Object.assign(new MouseEvent('click', {clientX: x})))"
    )
    assert value("response.chart.cursors.length") == 2 and value(
        "response.chart.cursors[0] < response.chart.cursors[1]"
    )


def _options(channel):
    return nidaqmx.GrpcSessionOptions(channel, "")


@pytest.mark.thorough
def test_page_without_token_is_rejected(bench):
    page, _, _ = bench
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(page.partition("?")[0])
    assert urllib.request.urlopen(page).status == 200


# JavaScript of another page: it tries to read the page of the bench, and to open its web socket, and reports results.
ATTACKS = """
const [page, done] = arguments;
const results = {};
const frame = document.createElement('iframe');
frame.src = page;
document.body.append(frame);
const answers = ['include', 'omit'].map(credentials =>
    fetch(page, {credentials}).then(() => 'read', () => 'rejected'));
const sockets = ['live', ''].map(path => new Promise(resolve => {
    const socket = new WebSocket(page.replace('http', 'ws') + path);
    socket.onopen = () => resolve('open');
    socket.onerror = () => resolve('rejected');
}));
// The browser has stored this script when it opened the page of the bench.
const script = new Promise(resolve => {
    const script = document.createElement('script');
    script.src = page + 'browser/bench.js';
    script.onload = () => resolve('loaded');
    script.onerror = () => resolve('rejected');
    document.body.append(script);
});
Promise.all([...answers, ...sockets, script]).then(done);
"""


@pytest.mark.thorough
def test_page_of_another_port_cannot_reach_the_bench(bench, browser, tmp_path):
    page = bench[0]
    (tmp_path / "other.html").write_text("<title>other</title><body>other</body>")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        browser.get(page)
        wait_for(browser, lambda: element(browser, "state").text == "ready")
        # The browser has the cookie of the bench, and sends it to all ports of the host.
        browser.get(f"http://127.0.0.1:{other.server_port}/other.html")
        for address in (page.partition("?")[0], page.partition("?")[0].replace("127.0.0.1", "localhost")):
            assert browser.execute_async_script(ATTACKS, address) == ["rejected"] * 5
        browser.switch_to.frame(browser.find_element(By.TAG_NAME, "iframe"))
        assert not browser.find_elements(By.CSS_SELECTOR, "[data-testid=start]")
        browser.switch_to.default_content()
        other.shutdown()

"""TensorBoard as a person opens it: a tiny run, looked at in Chromium."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator

import pytest
from inprocess import call
from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait
from tiny import TINY_SCENARIO, TINY_TRAINING

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
MISSING = "chromium or chromedriver is missing: apt-get install chromium chromium-driver"
PATIENCE = 120
"""Seconds, on a machine that has much else to do."""
QUIET = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1600,1000",
)  # fmt: skip
CHART = """
const found = (root, tag) => [...root.querySelectorAll("*")].flatMap((element) =>
    [...(element.matches(tag) ? [element] : []), ...(element.shadowRoot ? found(element.shadowRoot, tag) : [])]);
const [card] = found(document, "tf-custom-scalar-multi-line-chart-card");
if (!card) return null;
const lines = found(card.shadowRoot, "vz-line-chart2").flatMap((chart) => found(chart.shadowRoot, "path.line"));
return {
    title: found(card.shadowRoot, "figcaption").map((caption) => caption.innerText).join(" "),
    colours: lines.filter((line) => line.getTotalLength() > 100).map((line) => getComputedStyle(line).stroke),
};
"""
"""Title of the first chart, and the colour of every line in it that is longer than 100 pixels."""


@pytest.fixture
def address(tmp_path) -> Iterator[str]:
    """Where TensorBoard shows a run that has just been made."""
    call("dqn", "preset=mlp", f"run_dir={tmp_path / 'run'}", *TINY_SCENARIO, *TINY_TRAINING)
    command = [
        sys.executable,
        "-m",
        "tensorboard.main",
        "--logdir",
        str(tmp_path),
        "--port",
        "0",
        "--host",
        "127.0.0.1",
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as server:
        try:
            assert server.stderr is not None
            found = next((each for line in server.stderr if (each := re.search(r"http://[\d.:]+", line))), None)
            assert found is not None, "TensorBoard has not started"
            yield found[0]
        finally:
            server.terminate()


@pytest.fixture
def browser(tmp_path) -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    options.binary_location = str(BROWSER)
    for argument in (*QUIET, f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(argument)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    try:
        yield driver
    finally:
        driver.quit()


@pytest.mark.skipif(not (BROWSER and DRIVER) and "NFV_TORCHRL_CI" not in os.environ, reason=MISSING)
def test_the_first_chart_shows_the_agent_beside_what_it_is_compared_with(request):
    assert BROWSER and DRIVER, MISSING  # .ci/run installs them, so no run there skips this
    address = request.getfixturevalue("address")
    browser = request.getfixturevalue("browser")
    browser.get(f"{address}/#custom_scalars")

    def drawn(driver: webdriver.Chrome) -> dict | None:
        chart = driver.execute_script(CHART)
        return chart if chart and len(chart["colours"]) >= 5 else None

    chart = WebDriverWait(browser, PATIENCE).until(drawn, "no chart with five lines")
    assert chart["title"].strip().startswith("AAR: the agent")
    # The agent, three rules and the bound, each a run of its own for TensorBoard and so in a colour of its own.
    assert len(set(chart["colours"])) == 5

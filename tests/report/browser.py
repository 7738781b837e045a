"""A page as a browser has it: headless Chromium, where there is one."""

import re
import shutil
import subprocess

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--enable-logging=stderr"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars"),
)
WORDS = re.compile(r"CONSOLE[^\]]*\]\s*(.*)")


def browse(page, folder, *options):
    """What the page has become once its script has run, and what was said on its console."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    ended = subprocess.run(
        [CHROMIUM, *OPTIONS, f"--user-data-dir={folder / 'browser'}", *options, "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return ended.stdout, WORDS.findall(ended.stderr)

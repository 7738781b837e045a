"""The files around the package agree with it: changelog, citation, contributor's guide."""

import re
from pathlib import Path

import yaml

from fg_calib import __version__

ROOT = Path(__file__).resolve().parents[1]
SECTIONS = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_the_changelog_keeps_its_form():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, *versions = re.findall(r"^## (.*)$", text, flags=re.M)
    assert first == "[Unreleased]"
    for version in versions:
        assert re.fullmatch(r"\[\d+\.\d+\.\d+\] - (\d{4}-(0[1-9]|1[0-2])-([0-2]\d|3[01])|unreleased)", version)
    assert versions[0].startswith(f"[{__version__}]")
    assert set(re.findall(r"^### (.*)$", text, flags=re.M)) <= SECTIONS


def test_the_citation_names_the_version():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == __version__


def test_all_files_that_contributors_are_sent_to_are_there():
    named = re.findall(r"`([\w./-]+/[\w.-]*)`", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    assert len(named) > 10
    assert [name for name in named if not (ROOT / name).exists()] == []

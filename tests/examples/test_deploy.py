# SPDX-License-Identifier: Apache-2.0
"""Files of deployment name options that exist, and no address but their own. They are not run here."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from manyeyes.cli.live.options import MethodOptions, NetworkOptions, SecurityOptions
from manyeyes.cli.live.run import Options
from manyeyes.cli.view import Options as ViewOptions

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "deploy"
KNOWN = {
    "--" + field.name.replace("_", "-")
    for options in (Options, NetworkOptions, SecurityOptions, MethodOptions)
    for field in fields(options)
}


@pytest.mark.parametrize("name", ["compose.yaml", "manyeyes-live.service"])
def test_options_are_those_of_live_run(name: str) -> None:
    text = (FOLDER / name).read_text().partition("  viewer:")[0]
    used = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))
    assert len(used) >= 6 and used <= KNOWN


def test_the_viewer_takes_the_record_of_the_first_agent() -> None:
    services = yaml.safe_load((FOLDER / "compose.yaml").read_text())["services"]
    record = "/records/agent-1.mcap"
    assert f"--record {record}" in services["agent-1"]["command"] and services["show"]["command"][0] == record
    words = set(services["show"]["command"][1::2])
    assert words == {"--rerun"} and "rerun" in {field.name for field in fields(ViewOptions)}


def test_services_are_bounded_and_have_no_root() -> None:
    services = yaml.safe_load((FOLDER / "compose.yaml").read_text())["services"]
    assert set(services) == {"agent-1", "agent-2", "agent-3", "viewer", "show"}
    assert all(s["read_only"] and s["mem_limit"] == "1g" and s["cap_drop"] == ["ALL"] for s in services.values())
    published = [port for service in services.values() for port in service.get("ports", ())]
    assert published and all(port.startswith("127.0.0.1:") for port in published)
    lines = (FOLDER / "Dockerfile").read_text().splitlines()
    assert "USER manyeyes" in lines and any("/healthz" in line for line in lines)
    unit = (FOLDER / "manyeyes-live.service").read_text()
    assert all(
        line in unit
        for line in ("DynamicUser=yes", "ProtectSystem=strict", "MemoryMax=1G", "WatchdogSec=2", "Restart=on-failure")
    )


@pytest.mark.parametrize("path", sorted(FOLDER.iterdir()), ids=lambda path: path.name)
def test_no_address_of_another_machine_is_named(path: Path) -> None:
    addresses = re.findall(r"\b\d{1,3}(?:\.\d{1,3}){3}\b|https?://[^\s'\"]+", path.read_text())
    assert set(addresses) <= {"127.0.0.1", "0.0.0.0", "http://127.0.0.1:9464/healthz", "http://viewer:9876/proxy"}

"""The compose file, as far as it can be checked without containers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]  # its types are a package of their own

from app.runtime.settings import PREFIX, Settings

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    parsed: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
    return parsed


def ours(compose: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {name: s for name, s in compose["services"].items() if s["image"] == "lensmodel"}


def filled(value: str) -> str:
    return re.sub(r"\$\{[^}]+\}", "secret", value)


def test_api_and_worker_run_our_image_with_the_same_environment(compose: dict[str, Any]) -> None:
    services = ours(compose)

    assert {s["command"][0] for s in services.values()} == {"api", "worker"}
    assert services["api"]["environment"] == services["worker"]["environment"]


def test_every_setting_is_known_and_they_fit_together(
    compose: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in ours(compose)["api"]["environment"].items():
        monkeypatch.setenv(name, filled(value))

    settings = Settings(host="0.0.0.0")

    assert settings.database.startswith("postgresql")
    assert settings.jobs.startswith("postgresql")
    assert settings.storage == "s3://lensmodel"
    assert settings.hosts
    names = [name for name in ours(compose)["api"]["environment"] if name.startswith(PREFIX)]
    assert len(names) == 3


def test_our_containers_have_no_rights_and_a_root_that_nobody_writes_to(compose: dict[str, Any]) -> None:
    for service in ours(compose).values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert "no-new-privileges:true" in service["security_opt"]
        assert any(str(volume).endswith("/data") for volume in service["volumes"])


def test_ports_are_published_on_loopback_only(compose: dict[str, Any]) -> None:
    published = [port for service in compose["services"].values() for port in service.get("ports", [])]

    assert published
    assert all(port.startswith("127.0.0.1:") for port in published)


def test_no_secret_is_written_down_and_no_image_floats(compose: dict[str, Any]) -> None:
    for name, service in compose["services"].items():
        for key, value in service.get("environment", {}).items():
            if "PASSWORD" in key or "SECRET" in key:
                assert value.startswith("${"), f"{name}: {key}"
        if service["image"] != "lensmodel":
            assert re.search(r":\d", service["image"]), service["image"]


def test_whatever_is_waited_for_exists_and_can_tell_its_health(compose: dict[str, Any]) -> None:
    services = compose["services"]
    for service in services.values():
        for other, wait in service.get("depends_on", {}).items():
            assert other in services
            if wait["condition"] == "service_healthy":
                assert "test" in services[other]["healthcheck"]


def test_named_volumes_are_declared(compose: dict[str, Any]) -> None:
    used = {
        str(volume).split(":")[0]
        for service in compose["services"].values()
        for volume in service.get("volumes", [])
        if not str(volume).startswith("/")
    }

    assert used == set(compose["volumes"])


def test_dockerfile_ends_as_a_user_without_rights_and_says_its_health() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    last = text.rsplit("\nFROM ", 1)[1]

    assert text.count("\nFROM ") == 2
    assert "ARG BASE=" in text
    assert re.search(r"^USER 10001", last, re.MULTILINE)
    assert "VOLUME /data" in last
    assert "HEALTHCHECK" in last
    assert not re.search(r"^ADD ", text, re.MULTILINE)

"""`lensmodel keys`, and the client that sends one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx2
import pytest
from typer.testing import CliRunner

from app.client import Client
from lensmodel.cli.ending import UsageError
from lensmodel.cli.main import app
from lensmodel.core.errors import InvalidInputError

RUNNER = CliRunner()


def run(folder: Path, *words: str) -> tuple[str, str]:
    done = RUNNER.invoke(app, ["keys", *words, "--data", str(folder)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout, done.stderr


def test_a_key_is_made_listed_and_ended(tmp_path: Path) -> None:
    text, hint = run(tmp_path, "create", "--owner", "anna", "--scope", "read", "--label", "notebook")
    assert text.startswith("lpk_")
    assert text.count("\n") == 1  # it can be passed on as it is
    assert "Shown once" in hint

    [key] = json.loads(run(tmp_path, "list", "--json")[0])
    assert (key["owner"], key["scope"], key["label"], key["state"]) == ("anna", "read", "notebook", "valid")
    assert text.strip().split("_", 2)[2] not in str(key)
    run(tmp_path, "revoke", text.strip())
    run(tmp_path, "create", "--owner", "ben")

    states = [key["state"] for key in json.loads(run(tmp_path, "list", "--owner", "anna", "--json")[0])]
    assert states == ["revoked"]
    assert "owner anna" in run(tmp_path, "list")[0]


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        ("create --expires 3months", UsageError, "such as 90d; got '3months'"),
        ("create --owner |", UsageError, "owner's name"),
        ("revoke abcd2345", InvalidInputError, "no key begins with abcd2345"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(
    tmp_path: Path, words: str, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        run(tmp_path, *words.split())


def test_the_client_sends_its_key_or_that_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    def sent(**options: Any) -> str | None:
        with Client(**options) as client:
            return client._http.headers.get("Authorization")

    monkeypatch.delenv("LENS_API_KEY", raising=False)
    assert (sent(), sent(key="lpk_a")) == (None, "Bearer lpk_a")
    monkeypatch.setenv("LENS_API_KEY", "lpk_b")
    assert (sent(), sent(key=""), sent(http=httpx2.Client())) == ("Bearer lpk_b", None, None)

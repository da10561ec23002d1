"""One service on the other end of a connection: what it answers, read into objects, and how it says no."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeAlias, TypeVar

import httpx2
from pydantic import BaseModel, ValidationError

from app import schemas as s
from app.client_retries import RETRIES, Retrying
from app.runtime.settings import CLIENT_KEY
from lensmodel.core.errors import LensModelError
from lensmodel.core.files import atomic

M = TypeVar("M", bound=BaseModel)
Query: TypeAlias = Mapping[str, str | int | float | bool | None]

DEFAULT_URL: Final = "http://127.0.0.1:8000"
ANSWER_SECONDS: Final = 60.0
"""Longest wait for a response (chosen): longer than a long poll of 20 s."""


class ServiceProblemError(LensModelError):
    """The service said no; `problem` says why."""

    def __init__(self, problem: s.Problem) -> None:
        super().__init__(f"{problem.detail or problem.title} ({problem.code}, status {problem.status})")
        self.problem = problem


class Connection:
    """Speaks with one service.

    Parameters
    ----------
    url : str
        Where the service listens.
    http : httpx2.Client, optional
        A connection to use instead of an own one, for instance with other time limits.
    key : str, optional
        What `lensmodel keys create` printed, where the service asks for it; by default LENS_API_KEY of the
        environment. It is not sent over a connection that is given as `http`.
    retries : int
        How often a request is sent again, after a pause, where the service cannot be reached or says that it
        is busy; only requests that do no harm twice. Not of a connection that is given as `http`.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        http: httpx2.Client | None = None,
        key: str | None = None,
        retries: int = RETRIES,
    ) -> None:
        if http is None:
            shown = os.environ.get(CLIENT_KEY, "") if key is None else key
            headers = {"Authorization": f"Bearer {shown}"} if shown else {}
            http = httpx2.Client(
                base_url=url, timeout=ANSWER_SECONDS, headers=headers, transport=Retrying(retries)
            )
        self._http = http

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def _save(self, address: str, target: Path, query: Query | None = None) -> Path:
        """Save what an address answers; the file appears under its name only when it is complete."""
        with self._http.stream("GET", address, params=said(query) if query else None) as answer:
            if answer.is_error:
                answer.read()
            require_success(answer)
            with atomic(target) as file:
                for piece in answer.iter_bytes():
                    file.write(piece)
        return target

    def _get(self, answer: type[M], path: str, query: Query | None = None) -> M:
        # None and not {}: empty parameters would cut off the query that an address carries already
        return read(answer, self._http.get(path, params=said(query) if query else None))

    def _pages(self, answer: type[M], path: str, query: Query | None = None) -> Iterator[Any]:
        page: Any = self._get(answer, path, query)
        yield from page.items
        while page.next is not None:
            page = self._get(answer, page.next)
            yield from page.items


def said(query: Query) -> dict[str, str | int | float | bool]:
    """Return a query without what is left open."""
    return {name: value for name, value in query.items() if value is not None}


def require_success(answer: httpx2.Response) -> httpx2.Response:
    """Return an answer that is no refusal.

    Raises
    ------
    ServiceProblemError
        If it is one.
    """
    if not answer.is_error:
        return answer
    try:
        problem = s.Problem.model_validate_json(answer.content)
    except ValidationError:  # a proxy between us and the service
        text = answer.text[:200]
        problem = s.Problem(
            title=answer.reason_phrase, status=answer.status_code, detail=text, code="no_problem"
        )
    raise ServiceProblemError(problem)


def read(model: type[M], answer: httpx2.Response) -> M:
    """Return the object that an answer holds."""
    return model.model_validate_json(require_success(answer).content)

"""Requests that may be sent again: `Idempotency-Key` repeats the answer without repeating the work.

As in the IETF draft "The Idempotency-Key HTTP Header Field": the same key with another request is refused
with 422, and with 409 while the first is being answered. Refusals are not stored, and may be tried again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, TypeVar

from fastapi import Depends, Header, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from app.http.dependencies import Call, CallDep
from app.store.access.idempotency import Given

M = TypeVar("M", bound=BaseModel)
REPLAYED = "Idempotency-Replayed"


@dataclass(frozen=True, slots=True)
class Once:
    """One request and its idempotency key, if it has one."""

    call: Call
    key: str | None

    def answer(
        self, request_body: str, work: Callable[[], M], *, status: int, resource: str | None = None
    ) -> M | Response:
        """Do the work, or repeat the answer to the same request.

        Parameters
        ----------
        request_body : str
            The body, which distinguishes this request from others at the same address.
        work : callable
            Returns the answer, and sets status and headers of the response as in any route.
        status : int
            Of the answer, where the work sets none.
        resource : str, optional
            Id of the photo that the answer describes, where that is not the answer's own `id`.
        """
        if self.key is None:
            return work()
        request, answers, owner = self.call.request, self.call.store.idempotency, self.call.owner
        fingerprint = f"{request.method} {request.url.path}?{request.url.query}\n{request_body}"
        stored = answers.begin(owner, self.key, hashlib.sha256(fingerprint.encode()).hexdigest())
        if stored is not None:
            headers = {REPLAYED: "true"} | ({} if stored.location is None else {"Location": stored.location})
            return JSONResponse(stored.body, stored.status, headers)
        try:
            result = work()
        except BaseException:
            answers.forget(owner, self.key)
            raise
        head = self.call.response
        given = Given(
            head.status_code or status, head.headers.get("Location"), result.model_dump(mode="json")
        )
        answers.finish(owner, self.key, given, resource or getattr(result, "id", None))
        return result


async def once_of(
    call: CallDep,
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=200,
            pattern=r"^[\x21-\x7e]+$",
            description="a name for this request: sent again with it, it is answered as before, for 24 hours",
        ),
    ] = None,
) -> Once:
    """Return the request with its key."""
    return Once(call, idempotency_key)


OnceDep = Annotated[Once, Depends(once_of)]

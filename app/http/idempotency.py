"""Requests that may be sent again: `Idempotency-Key` gives the same answer without doing the same twice.

As the IETF's draft "The Idempotency-Key HTTP Header Field": the same key with another request is refused with
422, with one that is being answered with 409. What was refused is not kept, and may be tried again.
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
    """One request and the key that it came with, if it came with one."""

    call: Call
    key: str | None

    def answer(
        self, asked: str, work: Callable[[], M], *, status: int, resource: str | None = None
    ) -> M | Response:
        """Do the work, or give the answer again that was given to the same request.

        Parameters
        ----------
        asked : str
            What tells this request from others at the same address: its body.
        work : callable
            Answers; sets status and headers of the response as in any route.
        status : int
            Of the answer, where the work sets none.
        resource : str, optional
            Id of what the answer speaks of, where that is not the answer's own `id`.
        """
        if self.key is None:
            return work()
        request, answers, owner = self.call.request, self.call.store.idempotency, self.call.owner
        said = f"{request.method} {request.url.path}?{request.url.query}\n{asked}"
        before = answers.begin(owner, self.key, hashlib.sha256(said.encode()).hexdigest())
        if before is not None:
            headers = {REPLAYED: "true"} | ({} if before.location is None else {"Location": before.location})
            return JSONResponse(before.body, before.status, headers)
        try:
            made = work()
        except BaseException:
            answers.forget(owner, self.key)
            raise
        head = self.call.response
        given = Given(head.status_code or status, head.headers.get("Location"), made.model_dump(mode="json"))
        answers.finish(owner, self.key, given, resource or getattr(made, "id", None))
        return made


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
    """Take the key of a request."""
    return Once(call, idempotency_key)


OnceDep = Annotated[Once, Depends(once_of)]

"""Signing in and out with a browser."""

from __future__ import annotations

from typing import Final
from urllib.parse import urlsplit

from fastapi import APIRouter, status
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from app.access.authentication import COOKIE
from app.http.dependencies import CallDep, ProbeDep
from app.routes.common import problems
from app.runtime.settings import LOOPBACK
from app.schemas.account import SessionOut, SignIn

router = APIRouter(tags=["account"])
HTTPS: Final = "https"


@router.post(
    "/session", operation_id="signIn", status_code=status.HTTP_201_CREATED, responses=problems(401, 422, 429)
)
async def sign_in(credentials: SignIn, call: ProbeDep) -> SessionOut:
    """Sign a browser in with a key; it is given a cookie that ends with the key, or some hours later."""
    gate = call.services.gate
    who, token = await run_in_threadpool(gate.sign_in, credentials.key.strip())
    call.response.set_cookie(
        COOKIE,
        token,
        max_age=int(call.settings.session_hours * 3600),
        httponly=True,
        samesite="strict",
        secure=must_be_secure(call.request),
    )
    return SessionOut.model_validate({"owner": who.owner, "scopes": who.scopes, "needed": True})


@router.get("/session", operation_id="getSession", responses=problems(401))
async def read_session(call: CallDep) -> SessionOut:
    """Return who is signed in."""
    needed = call.who.key_id is not None
    return SessionOut.model_validate({"owner": call.owner, "scopes": call.who.scopes, "needed": needed})


@router.delete(
    "/session", operation_id="signOut", status_code=status.HTTP_204_NO_CONTENT, responses=problems(422)
)
async def sign_out(call: ProbeDep) -> None:
    """Sign the browser out."""
    await run_in_threadpool(call.services.gate.sign_out, call.request)
    call.response.delete_cookie(COOKIE, httponly=True, samesite="strict", secure=must_be_secure(call.request))


def must_be_secure(request: Request) -> bool:
    """Say whether the cookie may travel by HTTPS only: everywhere but between programs of one machine."""
    if HTTPS in {request.url.scheme, request.headers.get("x-forwarded-proto", "").lower()}:
        return True
    try:
        name = urlsplit(f"//{request.headers.get('host', '')}").hostname or ""
    except ValueError:
        return True
    return name not in LOOPBACK

"""The account: signing in and out, what an owner has, all of it to take away, all of it gone."""

from __future__ import annotations

from dataclasses import asdict

from fastapi import APIRouter, Response
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import StreamingResponse

from app.access import COOKIE, SESSION
from app.blobs.account_data import erase, exported
from app.http.dependencies import CallDep, OneSession, ProbeDep
from app.http.middleware import host_name
from app.routes.common import file_answer, file_headers
from app.routes.photos import most
from app.runtime.settings import LOOPBACK
from app.schemas import AccountOut, SignIn

router = APIRouter(tags=["account"], route_class=OneSession)
# Open to strangers, of whom one may be about to sign in
sign_ins = APIRouter(tags=["account"], route_class=OneSession)


@router.get("/account")
def get_account(call: CallDep) -> AccountOut:
    """Return what the owner has, and may have."""
    usage = call.store.accounts.usage(call.owner)
    max_bytes, max_photos = most(call.settings, usage)
    told = asdict(usage) | {"max_photos": max_photos, "max_stored_bytes": max_bytes}
    told |= {"owner": call.owner, "scopes": call.who.scopes, "signed_in": call.who.key_id is not None}
    return AccountOut.model_validate(told)


@router.get(
    "/account/export",
    response_class=Response,
    responses=file_answer("application/zip", "Rows as JSON lines, originals, results"),
)
def export_account(call: CallDep) -> Response:
    """Return all that is kept of the owner as a ZIP file, which is made while it is sent."""
    headers = file_headers("lensmodel-account.zip", cache="private, no-store")
    body = exported(call.store, call.storage, call.owner)
    return StreamingResponse(body, headers=headers, media_type="application/zip")


@router.delete("/account", status_code=204)
def erase_account(call: CallDep) -> None:
    """Erase the owner: photos, lenses, samples, corrections, keys and sign-ins. There is no way back.

    Begun, it is carried through, whatever happens to this request.
    """
    call.gate.require(call.who, "admin")
    accounts = call.store.accounts
    key = accounts.begin_erasing(call.owner)
    if key is not None:
        erase(accounts, call.storage, key)
    call.response.delete_cookie(COOKIE)


@sign_ins.post("/session", status_code=204)
async def sign_in(credentials: SignIn, call: ProbeDep) -> None:
    """Sign a browser in with a key; it is given a cookie that ends with the key, or some hours later."""
    token = await run_in_threadpool(call.gate.sign_in, credentials.key.strip())
    call.response.set_cookie(
        COOKIE,
        token,
        max_age=int(SESSION.total_seconds()),
        httponly=True,
        samesite="strict",
        secure=must_be_secure(call.request),
    )


@sign_ins.delete("/session", status_code=204)
async def sign_out(call: ProbeDep) -> None:
    """Sign the browser out."""
    await run_in_threadpool(call.gate.sign_out, call.request)
    call.response.delete_cookie(COOKIE)


def must_be_secure(request: Request) -> bool:
    """Say whether the cookie may travel by HTTPS only: everywhere but between programs of one machine."""
    encrypted = "https" in {request.url.scheme, request.headers.get("x-forwarded-proto", "").lower()}
    return encrypted or host_name(request.headers.get("host", "")) not in LOOPBACK

"""The account: what an owner has, all of it to take away, all of it gone."""

from __future__ import annotations

from fastapi import APIRouter, Response, status
from starlette.responses import StreamingResponse

from app.access.authentication import COOKIE
from app.blobs.erasure import erase
from app.blobs.export import exported
from app.http.dependencies import CallDep
from app.http.middleware import ONLY_HEAD
from app.routes.common import problems
from app.routes.photos import most
from app.schemas.account import AccountOut

router = APIRouter(tags=["account"])


@router.get("/account", operation_id="getAccount", responses=problems(401))
def read_account(call: CallDep) -> AccountOut:
    """Return what the owner has, and may have."""
    has = call.store.accounts.holdings_of(call.owner)
    most_bytes, most_photos = most(call.settings, call.store.accounts.quota_of(call.owner))
    return AccountOut.model_validate(
        {
            "owner": call.owner,
            "scopes": call.who.scopes,
            "photos": has.photos,
            "max_photos": most_photos,
            "stored_bytes": has.stored_bytes,
            "max_stored_bytes": most_bytes,
            "lenses": has.lenses,
            "corrections": has.corrections,
            "created_at": has.created_at,
        }
    )


@router.get(
    "/account/export",
    operation_id="exportAccount",
    response_class=Response,
    responses=problems(
        401,
        503,
        also={
            200: {
                "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
                "description": "All that is kept of the owner: rows as JSON lines, originals, results",
            }
        },
    ),
)
def export_account(call: CallDep) -> Response:
    """Return all that is kept of the owner as a ZIP file, which is made while it is sent."""
    headers = {
        "Content-Disposition": 'attachment; filename="lensmodel-account.zip"',
        "Cache-Control": "private, no-store",
    }
    if call.request.scope.get(ONLY_HEAD):
        return Response(headers=headers, media_type="application/zip")
    body = exported(call.store, call.storage, call.owner)
    return StreamingResponse(body, headers=headers, media_type="application/zip")


@router.delete(
    "/account",
    operation_id="eraseAccount",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems(401, 403),
)
def erase_account(call: CallDep) -> None:
    """Erase the owner: photos, lenses, samples, corrections, keys and sign-ins. There is no way back.

    Begun, it is carried through, whatever happens to this request.
    """
    call.services.gate.require(call.who, "admin")
    accounts = call.store.accounts
    key = accounts.begin_erasing(call.owner)
    if key is not None:
        erase(accounts, call.storage, key)
    call.response.delete_cookie(COOKIE)

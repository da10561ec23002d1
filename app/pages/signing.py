"""The page to sign in at; whoever is not signed in is sent there."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

from app.pages.rendering import page

router = APIRouter(include_in_schema=False)


@router.get("/sign-in")
async def sign_in() -> HTMLResponse:
    """Ask for a key."""
    return page("sign_in.html")

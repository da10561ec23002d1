"""A question that is read in one go is described and refused as FastAPI would."""

from __future__ import annotations

from typing import Annotated, Any

import pytest
from fastapi import Depends, FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.testclient import TestClient

from app.http.dependencies import QueryModel
from app.schemas import FieldQuery, PsfQuery, Question

ASKED = QueryModel(PsfQuery)


def application(reads: Any) -> FastAPI:
    """One that answers what it understood, or all that it was refused for."""
    app = FastAPI()
    extra = reads.dependency.described if hasattr(reads, "dependency") else None

    def read(lens: str, at: Any) -> dict[str, Any]:
        return {"lens": lens, **at.model_dump()}

    read.__annotations__["at"] = Annotated[PsfQuery, reads]
    app.get("/psf/{lens}", openapi_extra=extra)(read)

    @app.exception_handler(RequestValidationError)
    async def refused(request: Request, error: RequestValidationError) -> JSONResponse:
        del request
        return JSONResponse([[*one["loc"], one["type"], one["msg"]] for one in error.errors()], 422)

    return app


OURS, THEIRS = application(Depends(ASKED)), application(Query())


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("r=0.5", 200),
        ("r=0.5&phi=-1.25&size=31&channel=b&strict=true&version=3", 200),
        ("r=0.5&r=0.25", 200),
        ("r=%30%2e5&channel=%72", 200),
        ("r=0.5&aperture=2.8&focal_length_mm=&channel=g", 422),
        ("r=2&size=30&channel=x", 422),
        ("", 422),
        ("r=nan", 422),
        ("r=0.5&colour=g&size=many", 422),
        ("r=0,5", 422),
    ],
)
def test_a_question_is_understood_or_refused_as_by_fastapi(query: str, status: int) -> None:
    ours, theirs = (TestClient(app).get(f"/psf/a?{query}") for app in (OURS, THEIRS))
    assert (ours.status_code, ours.json()) == (theirs.status_code, theirs.json())
    assert ours.status_code == status


def test_the_description_is_that_of_fastapi() -> None:
    ours, theirs = (app.openapi()["paths"]["/psf/{lens}"]["get"]["parameters"] for app in (OURS, THEIRS))
    assert ours == theirs
    assert {"r", "size", "version"} < {one["name"] for one in ours}


@pytest.mark.parametrize("kind", [PsfQuery, FieldQuery])
def test_no_schema_refers_to_another(kind: type[Question]) -> None:
    """References would point into the schema itself, where a document has nothing."""
    assert "$ref" not in str(QueryModel(kind).described)

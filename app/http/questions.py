"""Query parameters, validated by their schema in one call.

FastAPI validates query parameters field by field, which takes as long as a quick answer. `/openapi.json`
describes them in the same way; see `QueryModel.described`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError

from app.schemas.fields import Question

_IN: Final = "query"

Q = TypeVar("Q", bound=Question)


@dataclass(frozen=True, slots=True)
class QueryModel(Generic[Q]):
    """A dependency that reads query parameters; the last value of a repeated name counts."""

    kind: type[Q]

    async def __call__(self, request: Request) -> Q:
        """Read the parameters; raise `RequestValidationError` as FastAPI does."""
        try:
            return self.kind.model_validate(dict(request.query_params))
        except ValidationError as error:
            errors = error.errors(include_url=False)
            raise RequestValidationError(
                [{**entry, "loc": (_IN, *entry["loc"])} for entry in errors]
            ) from None

    @property
    def described(self) -> dict[str, Any]:
        """Parameters for `openapi_extra`, described as FastAPI describes its own."""
        schema = self.kind.model_json_schema()
        required = schema.get("required", ())
        parameters = []
        for name, field in schema["properties"].items():
            entry: dict[str, Any] = {"name": name, "in": _IN, "required": name in required, "schema": field}
            if "description" in field:
                entry["description"] = field["description"]
            parameters.append(entry)
        return {"parameters": parameters}

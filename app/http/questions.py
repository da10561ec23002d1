"""A question in the address, read by its schema in one go.

FastAPI reads a schema of query parameters field by field, which costs as much as the answer itself where that
is quick. What `/openapi.json` says of them stays the same; see `Asked.described`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError

from app.schemas.fields import Question

_HERE: Final = "query"

Q = TypeVar("Q", bound=Question)


@dataclass(frozen=True, slots=True)
class Asked(Generic[Q]):
    """A dependency that reads a question of some kind; of a name that is given twice the last one counts."""

    kind: type[Q]

    async def __call__(self, request: Request) -> Q:
        """Read it; `RequestValidationError` as FastAPI raises it."""
        try:
            return self.kind.model_validate(dict(request.query_params))
        except ValidationError as error:
            found = error.errors(include_url=False)
            raise RequestValidationError([{**one, "loc": (_HERE, *one["loc"])} for one in found]) from None

    @property
    def described(self) -> dict[str, Any]:
        """Parameters for `openapi_extra`, as FastAPI describes those that it reads itself."""
        schema = self.kind.model_json_schema()
        required = schema.get("required", ())
        found = []
        for name, of in schema["properties"].items():
            one: dict[str, Any] = {"name": name, "in": _HERE, "required": name in required, "schema": of}
            if "description" in of:
                one["description"] = of["description"]
            found.append(one)
        return {"parameters": found}

"""What an upload may ask for together: refused before anything is stored."""

from __future__ import annotations

from app.errors import ConflictError, InvalidParameterError
from app.schemas import UploadFields
from app.store.tables import LensRow
from lensmodel.core.errors import UnknownMethodError
from lensmodel.patches import selectors


def check_selector(fields: UploadFields) -> None:
    """Refuse a selector that is not there, or one for a photo whose patches nobody chooses."""
    if fields.selector is None:
        return
    if fields.kind is not None:
        raise InvalidParameterError(
            f"selector={fields.selector} and kind exclude each other: leave one of them out"
        )
    try:
        selectors.create(fields.selector)
    except UnknownMethodError as error:
        raise InvalidParameterError(str(error)) from error


def check_model(fields: UploadFields, lens: LensRow | None) -> None:
    """Refuse a photo that was sent for another model than its lens has."""
    if lens is not None and fields.model not in {None, lens.way}:
        raise ConflictError(
            f"model={fields.model}: lens {lens.public_id} has the model {lens.way}; PATCH /v1/lenses/"
            f'{lens.public_id} with {{"model": "{fields.model}"}}, or leave model out'
        )

"""From the words of a command line to photos and profiles."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from lensmodel.api import LensStore
from lensmodel.cli.console import UsageError, reason
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.lens import Lens
from lensmodel.photo.values import CORRECTED, ENDINGS, RAW_ENDINGS

# What phones add to the names of the files of one shot
_PART_OF_SHOT: Final = re.compile(r"\.RAW-\d+(\.[A-Z]+)*$", re.IGNORECASE)


def photos(names: Iterable[Path], note: Callable[[str], None]) -> list[Path]:
    """Turn files and folders into photos, of one shot the RAW file; note what is passed over."""
    unique: dict[Path, None] = {}
    for path in names:
        if path.is_dir():
            inside = [
                p for p in sorted(path.iterdir()) if p.name[0] != "." and not p.stem.endswith(CORRECTED)
            ]
            found = dict.fromkeys(p for p in inside if p.suffix.lower() in ENDINGS and p.is_file())
            others = Counter("folder" if p.is_dir() else p.suffix.lower() for p in inside if p not in found)
            passed_over = ", ".join(f"{kind or 'other'} {number}" for kind, number in others.items())
            if not found:
                raise UsageError(
                    f"no photo in the folder {path}; give one that holds RAW, TIFF, PNG or JPEG files itself"
                    + (f" (passed over: {passed_over})" if others else "")
                )
            if others:
                note(f"passed over in {path}: {passed_over}")
            unique.update(found)
        elif path.is_file():
            unique[path] = None
        else:
            raise UsageError(f"no photo called {path}; check the name and the folder")
    raw = {_shot(p) for p in unique if p.suffix.lower() in RAW_ENDINGS}
    return [p for p in unique if p.suffix.lower() in RAW_ENDINGS or _shot(p) not in raw]


def _shot(path: Path) -> tuple[Path, str]:
    """Name the shot of a file: IMG_1.DNG and img_1.CR2.jpg, x.RAW-02.ORIGINAL.dng and x.RAW-01.COVER.jpg."""
    inner = Path(path.stem)
    stem = inner.stem if inner.suffix.lower() in RAW_ENDINGS else path.stem
    return path.parent, _PART_OF_SHOT.sub("", stem).casefold()


def refuse_photo(target: Path, photos: Sequence[Path]) -> None:
    """Refuse a profile that would take the place of a folder or a photo."""
    if target.is_dir():
        raise UsageError(f"{target} is a folder; give the file of a lens profile")
    # a shell expands `--profile holiday/*.dng` to a profile and photos
    if target.suffix.lower() in ENDINGS or any(
        target.exists() and path.exists() and target.samefile(path) for path in photos
    ):
        raise UsageError(
            f"{target.name} is a photo; name a new file after --profile, for example my-24mm.lensprofile"
        )


def profile_at(path: Path) -> Lens:
    """Open a profile."""
    if path.is_dir():
        raise UsageError(f"{path} is a folder; give the file of a lens profile")
    if not path.exists():
        raise UsageError(
            f"no lens profile at {path}; make it with `lensmodel calibrate PHOTO... --profile {path}`"
        )
    return Lens.load(path)


class ProfileFile(LensStore):
    """The store of a lens in a file, read again when another run changed it, which loses nothing so."""

    def __init__(self, target: Path, model: str | None = None, *, force: bool = False) -> None:
        super().__init__()
        self._target, self._wanted = target, model
        self._stamp_read = _stamp(target) if force else None
        known = self.lens()
        self.model = self._wanted = model or (known.model.mode if known else "default")

    def lens(self) -> Lens | None:
        """Return the lens, read anew if another run changed the file."""
        stamp = _stamp(self._target)
        if stamp in {None, self._stamp_read}:
            return self._lens
        lens = profile_at(self._target)
        learned = lens.model.mode
        if self._wanted not in {None, learned}:  # its kernels are the other model's: both would be mixed
            raise InvalidInputError(
                f"the lens in {self._target.name} has the model {learned}, not {self._wanted}: name a new "
                "file after --profile and give its photos again, or replace the file with --force"
            )
        self._lens, self._stamp_read = lens, stamp
        return lens

    def keep(self, lens: Lens) -> None:
        """Save the lens."""
        self._target.parent.mkdir(parents=True, exist_ok=True)
        lens.save(self._target)
        self._lens, self._stamp_read = lens, _stamp(self._target)


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Return inode, size and time of a file, which change when it is replaced; None without file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def refuse_existing(*paths: Path, force: bool) -> None:
    """Make sure, before any work, that nothing is replaced that the user did not give up."""
    for path in paths:
        if path.is_dir():
            raise UsageError(f"{path} is a folder; name a file in it")
        if not force and path.exists():
            raise UsageError(f"{path} is there already; --force replaces it")


@contextmanager
def as_usage() -> Iterator[None]:
    """Turn a refused value into wrong usage: nothing was begun."""
    try:
        yield
    except InvalidInputError as error:
        raise UsageError(str(error)) from error


def failed(error: LensModelError | OSError) -> dict[str, Any]:
    """Say in a command's document that a photo could not be used, and why."""
    code = error.code if isinstance(error, LensModelError) else "unreadable"
    return {"state": "failed", "code": code, "reason": reason(error)}

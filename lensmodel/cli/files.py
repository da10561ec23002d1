"""From the words of a command line to photos and profiles."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from lensmodel.calibration import LensStore
from lensmodel.cli.ending import UsageError
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.lens import Lens
from lensmodel.model import LensProfile, load_profile
from lensmodel.photo.values import CORRECTED, ENDINGS, RAW_ENDINGS

# Endings of pictures in folders that are told of where they are passed over (docs/formats.md)
NOT_READ: Final = frozenset(
    {".heic", ".heif", ".avif", ".webp", ".jxl", ".jp2", ".gif", ".bmp", ".psd", ".exr"}
)
# What phones add to the names of the files of one shot
_PART_OF_SHOT: Final = re.compile(r"\.RAW-\d+(\.[A-Z]+)*$", re.IGNORECASE)


def photos(names: Iterable[str]) -> list[Path]:
    """Turn files, folders and patterns into a list of photos without repeats.

    Of one shot the RAW file counts, and no other picture of it. Of folders and patterns, corrected photos are
    left out.
    """
    unique: dict[Path, None] = {}
    for name in names:
        path = Path(name).expanduser()
        if path.is_dir():
            inside = (p for p in path.iterdir() if p.suffix.lower() in ENDINGS and not p.name.startswith("."))
            matches = _originals(inside)
            if not matches:
                others = passed_over([name])
                raise UsageError(
                    f"no photo in the folder {name}; give one that holds RAW, TIFF, PNG or JPEG files"
                    + (f" (passed over: {others})" if others else "")
                )
        elif path.is_file():
            matches = [path]
        else:
            matches = _originals(Path(p) for p in glob.glob(_pattern(path), recursive=True))  # noqa: PTH207 - absolute patterns too
            if not matches:
                raise UsageError(f"no photo called {name}; check the name and the folder")
        unique.update(dict.fromkeys(matches))
    raw = {_shot(p) for p in unique if p.suffix.lower() in RAW_ENDINGS}
    return [p for p in unique if p.suffix.lower() in RAW_ENDINGS or _shot(p) not in raw]


def passed_over(names: Iterable[str]) -> str:
    """Say which pictures of folders are not taken for their kind, and which folders inside hold photos."""
    folders = [path for path in (Path(name).expanduser() for name in names) if path.is_dir()]
    inside = [path for folder in folders for path in folder.iterdir() if not path.name.startswith(".")]
    kinds = Counter(path.suffix[1:].upper() for path in inside if path.suffix.lower() in NOT_READ)
    said = [f"{kind} files, which are not read: {count}" for kind, count in sorted(kinds.items())]
    deeper = [f"the photos in {path}: name it too" for path in sorted(inside) if _holds_photos(path)]
    return "; ".join([*said, *deeper])


def _holds_photos(path: Path) -> bool:
    with suppress(OSError):  # no folder, or one of the system's, as `lost+found` of a memory card
        return bool(_originals(each for each in path.iterdir() if each.suffix.lower() in ENDINGS))
    return False


def _originals(paths: Iterable[Path]) -> list[Path]:
    return sorted(p for p in paths if p.is_file() and not p.stem.endswith(CORRECTED))


def _pattern(path: Path) -> str:
    """Take the part of a pattern that is there, such as a folder "[2024] trip", by its letters."""
    there = next(parent for parent in (path, *path.parents) if parent.is_dir() or parent == parent.parent)
    rest = str(path.relative_to(there))
    if path.suffix.lower() in ENDINGS:  # cameras write them in capitals, people in small letters
        ending = (
            f"[{letter.lower()}{letter.upper()}]" if letter.isalpha() else letter for letter in path.suffix
        )
        rest = rest.removesuffix(path.suffix) + "".join(ending)
    return str(Path(glob.escape(str(there))) / rest)


def _shot(path: Path) -> tuple[Path, str]:
    """Name the shot of a file: IMG_1.DNG and img_1.jpg, x.RAW-02.ORIGINAL.dng and x.RAW-01.COVER.jpg."""
    stem = path.stem
    if Path(stem).suffix.lower() in RAW_ENDINGS:  # IMG_1.CR2.jpg
        stem = Path(stem).stem
    return path.parent, _PART_OF_SHOT.sub("", stem).casefold()


def named(profile: Path | None) -> Path:
    """Where the lens is written; it has no usual place, since a person may have several."""
    if profile is None:
        raise UsageError(
            "add --profile and the name of a file, for example --profile my-24mm.lensprofile: "
            "what is learned of the lens is written there"
        )
    return profile


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


def profile_at(path: Path, *, replaceable: bool = False) -> LensProfile:
    """Open a profile; one that is not `replaceable` is only read."""
    if path.is_dir():
        raise UsageError(f"{path} is a folder; give the file of a lens profile")
    if not path.exists():
        raise UsageError(
            f"no lens profile at {path}; make it with `lensmodel calibrate PHOTO... --profile {path}`"
        )
    try:
        return load_profile(path)
    except InvalidInputError as error:
        if not replaceable:
            raise
        with path.open("rb") as file:
            damaged = file.read(2) == b"PK"  # a ZIP file, as profiles are
        remedy = "--force replaces the file" if damaged else "name a new file after --profile"
        raise InvalidInputError(f"{error}; {remedy}") from error


class ProfileFile(LensStore):
    """The store of a lens in a file.

    Another run may add to the same file meanwhile: the profile is read again whenever the file has
    changed, so that no run drops what another one learned.
    """

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
        lens = Lens(profile_at(self._target, replaceable=True))
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


def refuse_existing(*paths: Path | None, force: bool) -> None:
    """Make sure, before any work, that nothing is replaced that the user did not give up."""
    for path in paths:
        if path is not None and not force and path.exists():
            raise UsageError(f"{path} is there already; --force replaces it")


@contextmanager
def as_usage() -> Iterator[None]:
    """Turn a refused value into wrong usage: nothing was begun."""
    try:
        yield
    except InvalidInputError as error:
        raise UsageError(str(error)) from error


def reason(error: Exception) -> str:
    """Say why a file could not be used; the system's errors in words."""
    if isinstance(error, OSError) and error.strerror:
        return (
            f"{error.strerror[:1].lower()}{error.strerror[1:]}; check the file, its folder and their rights"
        )
    return str(error)


def failed(error: LensModelError | OSError) -> dict[str, Any]:
    """Say in a command's document that a photo could not be used, and why."""
    code = error.code if isinstance(error, LensModelError) else "unreadable"
    return {"state": "failed", "code": code, "reason": reason(error)}

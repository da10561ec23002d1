"""Photo files in and out: RAW, DNG, TIFF, PNG, JPEG; EXIF, ICC; which lens it was."""

from lensmodel.photo.containers import HEAD_BYTES as HEAD_BYTES
from lensmodel.photo.containers import sniff as sniff
from lensmodel.photo.development import develop as develop
from lensmodel.photo.development import inspect as inspect
from lensmodel.photo.values import ColorSpace as ColorSpace
from lensmodel.photo.values import Encoding as Encoding
from lensmodel.photo.values import LensIdentity as LensIdentity
from lensmodel.photo.values import Limits as Limits
from lensmodel.photo.values import LinearPhoto as LinearPhoto
from lensmodel.photo.values import OutputFormat as OutputFormat
from lensmodel.photo.values import PhotoInfo as PhotoInfo
from lensmodel.photo.values import PhotoMetadata as PhotoMetadata
from lensmodel.photo.writing import shown as shown
from lensmodel.photo.writing import upright as upright
from lensmodel.photo.writing import write_image as write_image

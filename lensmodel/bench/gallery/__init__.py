"""Pictures to look at: real and simulated ones, corrected by default and measured from outside."""

from lensmodel.bench.gallery.page import PAGE, text, write_page
from lensmodel.bench.gallery.pictures import Picture, chosen, real_pictures, simulated_pictures
from lensmodel.bench.gallery.run import CACHE, Entry, hang
from lensmodel.bench.gallery.work import Wishes

__all__ = [
    "CACHE",
    "PAGE",
    "Entry",
    "Picture",
    "Wishes",
    "chosen",
    "hang",
    "real_pictures",
    "simulated_pictures",
    "text",
    "write_page",
]

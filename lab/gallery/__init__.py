"""Pictures to look at: real and simulated ones, corrected by default and measured from outside."""

from lab.gallery.page import PAGE, text, write_page
from lab.gallery.pictures import Picture, chosen, real_pictures, simulated_pictures
from lab.gallery.run import CACHE, GalleryEntry, hang
from lab.gallery.work import Wishes

__all__ = [
    "CACHE",
    "PAGE",
    "GalleryEntry",
    "Picture",
    "Wishes",
    "chosen",
    "hang",
    "real_pictures",
    "simulated_pictures",
    "text",
    "write_page",
]

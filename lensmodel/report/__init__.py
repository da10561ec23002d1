"""What a lens model says in words, numbers and pictures, and how to take it elsewhere."""

from lensmodel.report.advice import Advice, Wish, advice
from lensmodel.report.places import direction_in_words, place_in_words

__all__ = ["Advice", "Wish", "advice", "direction_in_words", "place_in_words"]

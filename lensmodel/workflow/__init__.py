"""The parts at work together: photos to samples to a lens, a lens and a photo to a corrected one.

The folder of the third step is called `correction` because a module `lensmodel.correct` would hide the
function of that name.
"""

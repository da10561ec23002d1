"""Learns the blur of one copy of a lens from ordinary photos, and removes it.

    import lensmodel

    lens = lensmodel.calibrate(["a.dng", "b.dng"])
    kernel = lens.psf(r=0.9, phi=0.6).kernel
    photo = lensmodel.correct("c.dng", lens, "c.tif")
    lens.save("my-24mm.lensprofile")

The public names are those of `__init__.pyi`; each is imported when it is first used, so that importing the
package costs nothing. docs/library.md shows them at work.

`patches` chooses patches of photos, `blind.sampling` and `measured` make samples of a PSF of them, `model`
makes these a function of place and settings, by default with the network of `neural`, and `correction`
applies it; `api` joins them in a `lens`. Photos come in and go out through `photo`;
`quality` judges, `report` describes, `simulate` makes photos whose truth is known, `core` has what all share,
and `cli` is the command.
CONTRIBUTING.md says where a method is added.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

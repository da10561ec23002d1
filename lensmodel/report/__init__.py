"""What a lens model says in words and numbers (`lens_report`, `centring`) and pictures (`plots`, matplotlib).

`export` writes it, and the PSFs of the model, for other programs.
"""

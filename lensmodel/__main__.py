"""`python -m lensmodel`: the command `lensmodel`, for where its folder is not on the path.

The command stands above the library, which imports nothing of it: here it is run by its name.
"""

import runpy

if __name__ == "__main__":
    runpy.run_module("app.cli", run_name="__main__", alter_sys=True)

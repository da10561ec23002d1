"""`lensmodel` with the light worker beside this file."""

if __name__ == "__main__":
    import os
    from pathlib import Path

    from app.runtime import supervisor
    from lensmodel.cli import main as cli

    here = str(Path(__file__).parent)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    supervisor.WORKER = "light_worker"
    cli.main()
